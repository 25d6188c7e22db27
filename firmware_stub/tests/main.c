#include <stdio.h>

#include "check.h"

unsigned check_count;
unsigned check_failures;

#define MOST_TOLD (20u)

void check_that(bool holds, const char *what, const char *file, int line)
{
    check_count++;
    if (holds) {
        return;
    }
    check_failures++;
    if (check_failures <= MOST_TOLD) {
        printf("%s:%d: not so: %s\n", file, line, what);
    }
}

void check_near(float found, float expected, float tolerance, const char *what, const char *file, int line)
{
    const float apart = (found > expected) ? found - expected : expected - found;
    check_that(apart <= tolerance, what, file, line);
    if (!(apart <= tolerance) && check_failures <= MOST_TOLD) {
        /* microunits: printf of a float needs a libc with floating-point formats, and double */
        printf("    found %ld e-6, expected %ld e-6\n", (long)(found * 1e6f), (long)(expected * 1e6f));
    }
}

int main(void)
{
#ifdef WITH_BUDGET
    budget();
#endif
    test_vectors();
    test_angle();
    test_e2e();
    test_sender();
    test_receiver();
    test_probing();
    test_drive();
    printf("%u checks, %u failures\n", check_count, check_failures);
    return (check_failures == 0u) ? 0 : 1;
}

/* Command line of drive_stub. */
#ifndef OPTIONS_H
#define OPTIONS_H

#include <stdbool.h>
#include <stdint.h>

struct options {
    const char *interface;
    uint8_t node;
    bool fd;
    double rate;     /* [Hz] */
    double rpm;      /* of the shaft */
    double load;     /* [N m] */
    double noise;    /* [A rms] */
    double limit;    /* probing [V peak] */
    double duration; /* [s], 0 until told to end */
    double tick;     /* [s] */
};

/* Fill in the options.  -1 to go on, else the exit code: 0 after --help, 2 after one sentence on what was wrong. */
int options_parse(struct options *options, int argc, char **argv);

#endif

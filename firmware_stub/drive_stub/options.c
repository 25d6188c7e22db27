#define _GNU_SOURCE /* getopt_long under -std=c11 */
#include "options.h"

#include <getopt.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "ipmsm_can/probing.h"

static const char help[] =
    "drive_stub INTERFACE [options]\n"
    "\n"
    "A drive on SocketCAN that runs on the C library: a simulated motor at constant speed, in real time. It obeys\n"
    "InjectionCommands. Prints one JSON object a line: what changes when it does, counts every second and at the end.\n"
    "\n"
    "  --node N        0 to 15 (default 0)\n"
    "  --fd            CAN FD blocks of seven samples, and 10 kHz unless --rate is given\n"
    "  --rate HZ       samples per second, 1000 to 20000 (default 5000)\n"
    "  --rpm RPM       speed of the shaft (default 300)\n"
    "  --load NM       torque (default 0)\n"
    "  --noise A       of the current sensors, rms (default 0.02)\n"
    "  --limit V       largest probing voltage, peak; the library's own limit holds above it\n"
    "  --duration S    end after so many seconds; else on SIGINT or SIGTERM\n"
    "  --tick MS       time between two looks at the bus, 0.1 to 20 (default 1); a tick's samples leave at once\n"
    "\n"
    "example: drive_stub vcan0 --rpm 100 --duration 60\n"
    "exit codes: 0 ended, 1 the bus cannot be used, 2 bad input\n";

static bool number(const char *name, const char *text, double low, double high, double *out)
{
    char *end;
    const double value = strtod(text, &end);
    if (end == text || *end != '\0' || !(value >= low && value <= high)) {
        fprintf(stderr, "drive_stub: --%s is '%s'; allowed is a number from %g to %g\n", name, text, low, high);
        return false;
    }
    *out = value;
    return true;
}

int options_parse(struct options *options, int argc, char **argv)
{
    static const struct option names[] = {
        {"node", required_argument, NULL, 0},  {"rate", required_argument, NULL, 1},
        {"rpm", required_argument, NULL, 2},   {"load", required_argument, NULL, 3},
        {"noise", required_argument, NULL, 4}, {"limit", required_argument, NULL, 5},
        {"duration", required_argument, NULL, 6}, {"tick", required_argument, NULL, 7},
        {"fd", no_argument, NULL, 'f'},        {"help", no_argument, NULL, 'h'},
        {NULL, 0, NULL, 0},
    };
    double node = 0.0;
    double tick_ms = 1.0;
    *options = (struct options){.rpm = 300.0, .noise = 0.02, .limit = (double)IPMSM_PROBING_LIMIT};
    double *const into[] = {&node, &options->rate, &options->rpm, &options->load, &options->noise,
                            &options->limit, &options->duration, &tick_ms};
    static const double low[] = {0.0, 1e3, -10e3, -100.0, 0.0, 0.0, 0.0, 0.1};
    static const double high[] = {15.0, 20e3, 10e3, 100.0, 10.0, 1e3, 1e6, 20.0};
    int found;
    int which = 0;
    opterr = 0;
    while ((found = getopt_long(argc, argv, "h", names, &which)) != -1) {
        if (found == 'h') {
            fputs(help, stdout);
            return 0;
        }
        if (found == 'f') {
            options->fd = true;
        } else if (found == '?') {
            fprintf(stderr, "drive_stub: the option '%s' is unknown or lacks its value; --help lists them\n",
                    argv[optind - 1]);
            return 2;
        } else if (!number(names[which].name, optarg, low[found], high[found], into[found])) {
            return 2;
        }
    }
    if (optind != argc - 1) {
        fprintf(stderr, "drive_stub: %d interfaces were given; allowed is one, such as vcan0\n", argc - optind);
        return 2;
    }
    if (node != floor(node)) {
        fprintf(stderr, "drive_stub: --node is %g; allowed is a whole number from 0 to 15\n", node);
        return 2;
    }
    options->node = (uint8_t)node;
    options->interface = argv[optind];
    options->tick = 1e-3 * tick_ms;
    if (options->rate <= 0.0) {
        options->rate = options->fd ? 10e3 : 5e3;
    }
    return -1;
}

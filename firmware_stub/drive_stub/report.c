#include "report.h"

#include <inttypes.h>
#include <stdio.h>

static const char *const verdicts[] = {"usable", "missing", "invalid", "uncertain", "doubtful"};

static void begin(const struct facts *facts, const char *event)
{
    printf("{\"event\": \"%s\", \"t\": %.6f, \"sample\": %" PRIu64, event, facts->now_s, facts->samples);
}

static void end(void)
{
    printf("}\n");
    fflush(stdout);
}

void report_start(const struct facts *facts, uint8_t node, double rate, bool fd)
{
    begin(facts, "start");
    printf(", \"node\": %u, \"rate\": %g, \"fd\": %s", (unsigned)node, rate, fd ? "true" : "false");
    end();
}

void report_probing(const struct facts *facts, uint8_t waveform)
{
    begin(facts, "probing");
    printf(", \"waveform\": %u, \"samples_since_command\": %" PRIu64 ", \"us_since_command\": %" PRIu32,
           (unsigned)waveform, facts->samples - facts->command_sample, facts->now_us - facts->command_us);
    end();
}

void report_angle(const struct facts *facts, enum ipmsm_angle_verdict verdict)
{
    begin(facts, "angle");
    printf(", \"verdict\": \"%s\"", verdicts[verdict]);
    end();
}

static void print_stream(const char *name, const struct ipmsm_stream *stream)
{
    static const char *const names[IPMSM_E2E_STATUSES] = {"ok", "some_lost", "repeated", "wrong_sequence",
                                                          "wrong_crc"};
    printf(", \"%s\": {", name);
    for (uint32_t k = 0; k < IPMSM_E2E_STATUSES; k++) {
        printf("\"%s\": %" PRIu32 ", ", names[k], stream->counts[k]);
    }
    printf("\"lost\": %" PRIu32, stream->sequence.lost);
}

void report_counts(const struct facts *facts, const struct ipmsm_drive *drive, const char *event)
{
    const struct ipmsm_receiver *receiver = &drive->receiver;
    const uint32_t *refused = receiver->commands.counts;
    begin(facts, event);
    printf(", \"sent\": %" PRIu64 ", \"dropped\": %" PRIu32 ", \"errors\": %" PRIu32 ", \"slips\": %" PRIu64,
           facts->sent, drive->dropped, facts->errors, facts->slips);
    print_stream("estimates", &receiver->estimates);
    printf(", \"late\": %" PRIu32 "}", receiver->late);
    print_stream("commands", &receiver->commands);
    printf(", \"rejected\": %" PRIu32 ", \"not_executable\": %" PRIu32 ", \"beyond_limit\": %" PRIu32 "}",
           drive->rejected,
           drive->rejected - refused[IPMSM_E2E_REPEATED] - refused[IPMSM_E2E_WRONG_SEQUENCE]
               - refused[IPMSM_E2E_WRONG_CRC],
           facts->beyond_limit);
    printf(", \"probing\": %u, \"probe_peak\": %.3f, \"usable\": %" PRIu64 ", \"error_deg\": %.3f",
           (unsigned)drive->probing.waveform, facts->probe_peak, facts->usable, facts->error_deg);
    end();
}

/* What comes from the companion: PositionEstimate and InjectionCommand, checked end to end.
 *
 * Nothing on the wire can make these functions fail; what is not right is counted and dropped.
 */
#ifndef IPMSM_RECEIVER_H
#define IPMSM_RECEIVER_H

#include "ipmsm_can/can_hal.h"
#include "ipmsm_can/e2e.h"
#include "ipmsm_can/probing.h"

/* Largest step of a counter that is taken for loss.  A larger one is an old frame that was held up
 * somewhere; after a loss that long it costs one frame more. */
#define IPMSM_FRAMES_MISSED (7u)

enum ipmsm_received {
    IPMSM_RECEIVED_NOTHING = 0,  /* not a frame for this drive */
    IPMSM_RECEIVED_ESTIMATE = 1, /* taken over */
    IPMSM_RECEIVED_COMMAND = 2,  /* intact and in sequence; the caller decides whether it can be executed */
    IPMSM_RECEIVED_BAD_ESTIMATE = 3,
    IPMSM_RECEIVED_BAD_COMMAND = 4
};

enum ipmsm_angle_verdict {
    IPMSM_ANGLE_USABLE = 0,
    IPMSM_ANGLE_MISSING = 1,   /* no estimate yet, or the last one has grown too old */
    IPMSM_ANGLE_INVALID = 2,   /* the companion says valid, locked or polarity_known is not so */
    IPMSM_ANGLE_UNCERTAIN = 3, /* its one-sigma is unknown or beyond the limit */
    /* Not valid, but locked, of known polarity and its one-sigma within the limit.  A control that runs on the
     * companion's angle may go on with it; none may begin with it. */
    IPMSM_ANGLE_DOUBTFUL = 4
};

/* Frames of one message. */
struct ipmsm_stream {
    struct ipmsm_e2e_sequence sequence;
    uint32_t counts[IPMSM_E2E_STATUSES]; /* by enum ipmsm_e2e_status */
};

struct ipmsm_estimate {
    float theta_e;     /* [rad electrical] */
    float omega_e;     /* [rad/s electrical] */
    float sigma_theta; /* one standard deviation [deg electrical] */
    uint32_t sample;   /* counter of the sample it belongs to */
    uint32_t arrived_us;
    bool sigma_known, valid, locked, polarity_known, injecting;
    bool held; /* there is one, and it has not grown too old */
};

struct ipmsm_receiver {
    float period; /* control period [s] */
    float sigma_limit;
    uint32_t max_age;    /* of an estimate, in samples */
    uint32_t max_age_us; /* since its arrival */
    uint8_t node;
    struct ipmsm_stream estimates, commands;
    uint32_t late;    /* estimates that were too old when they came, or came too early after the start */
    uint32_t warm_up; /* control periods until estimates are taken */
    struct ipmsm_estimate estimate;
};

/* sigma_limit [deg]; time_to_live of an estimate [us], from the sample it belongs to as well as from its
 * arrival.  false if node is above 15, or the time to live is not 1 to 1023 samples: an estimate names its
 * sample by ten bits. */
bool ipmsm_receiver_init(struct ipmsm_receiver *receiver, uint8_t node, float sample_rate, float sigma_limit,
                         uint32_t time_to_live_us);

/* Look at a frame.  sample: counter of the drive's latest sample; command: filled in if one is received. */
enum ipmsm_received ipmsm_receiver_take(struct ipmsm_receiver *receiver, const struct ipmsm_frame *frame,
                                        uint32_t sample, uint32_t now_us, struct ipmsm_command *command);

/* Once in every control period: forget an estimate that has grown too old, so that no clock wraps unseen.
 *
 * For the first 1024 control periods no estimate is taken: the companion may still speak of samples of the
 * drive's last run, and ten bits do not tell them from the new ones. */
void ipmsm_receiver_expire(struct ipmsm_receiver *receiver, uint32_t sample, uint32_t now_us);

/* Whether the angle may be used for control at sample `sample`. */
enum ipmsm_angle_verdict ipmsm_receiver_verdict(const struct ipmsm_receiver *receiver, uint32_t sample,
                                                uint32_t now_us);

/* The rotor angle `ahead` periods after t_k of sample `sample`: 0..2 pi [rad electrical].  Meaningful only
 * where the verdict is IPMSM_ANGLE_USABLE or IPMSM_ANGLE_DOUBTFUL. */
float ipmsm_receiver_theta(const struct ipmsm_receiver *receiver, uint32_t sample, float ahead);

#endif

/* Angles: phases as 32-bit fractions of a turn, which wrap by themselves, and extrapolation of a rotor angle. */
#ifndef IPMSM_ANGLE_H
#define IPMSM_ANGLE_H

#include <stdint.h>

#define IPMSM_TWO_PI (6.28318530717958648f)

/* The same angle within 0..2 pi [rad], 2 pi excluded; 0 for what is no angle (NaN, beyond 8 million turns). */
float ipmsm_wrap(float angle);

/* Angle [rad] as a fraction of a turn, 2^32 being one turn. */
uint32_t ipmsm_to_turn(float angle);

/* Cosine and sine of a fraction of a turn; error below 1.3e-7. */
void ipmsm_cos_sin(uint32_t turn, float *cosine, float *sine);

/* Where a rotor at theta [rad] with speed omega [rad/s] is after elapsed [s]: 0..2 pi [rad]. */
float ipmsm_extrapolate(float theta, float omega, float elapsed);

#endif

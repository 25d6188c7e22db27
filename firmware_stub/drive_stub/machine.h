/* An interior-magnet machine at an imposed speed, its current control and its current sensors.
 *
 * Stator flux in the stationary frame, as in the paper (Section 2), integrated with RK4:
 *     lambda' = v - R i,    i = L(theta_e)^-1 (lambda - psi_m c(theta_e)),    theta_e' = omega_e
 * Peak, amplitude-invariant quantities; double precision, because this is the plant and not the firmware.
 */
#ifndef MACHINE_H
#define MACHINE_H

#include <stdint.h>

struct machine_parameters {
    double pole_pairs, psi_m, l_d, l_q, r; /* psi_m [Wb], l [H], r [ohm] */
};

/* The paper's experiment motor (Table 1, second column). */
extern const struct machine_parameters machine_m2;

struct machine {
    struct machine_parameters parameters;
    double period;           /* [s] */
    double omega_e;          /* [rad/s electrical] */
    double i_q_reference;    /* [A] */
    double noise;            /* of the sensors, rms [A] */
    double theta_e;          /* at t_k [rad electrical], 0..2 pi */
    double flux[2];          /* at t_k [Wb] */
    double v_ended[2];       /* mean voltage of the interval that ended at t_k [V] */
    double v_begins[2];      /* of the one that begins there */
    double integrator[2];    /* of the current control, d and q [V] */
    double measured[2];      /* current sampled at t_k [A] */
    uint64_t random;
};

/* A rotor at omega_e [rad/s] and theta_e [rad] that carries no current yet; torque [N m] is what the control
 * makes from then on, with i_d = 0. */
void machine_init(struct machine *machine, const struct machine_parameters *parameters, double sample_rate,
                  double omega_e, double theta_e, double torque, double noise);

/* Sample the current at t_k, into measured. */
void machine_sample(struct machine *machine);

/* Decide the voltage of t_(k+1) to t_(k+2), probing voltage [V] included, and go on to t_(k+1). */
void machine_advance(struct machine *machine, double probe_alpha, double probe_beta);

#endif

#include "machine.h"

#include <math.h>

#define TWO_PI (6.283185307179586)
#define SUBSTEPS (4)
#define BANDWIDTH (TWO_PI * 200.0) /* of the current control [rad/s] */
#define SLOWEST_INTEGRATOR (0.1)   /* share of it below which the integrator's corner never falls */
#define V_MAX (540.0 / 1.7320508075688772)

const struct machine_parameters machine_m2 = {.pole_pairs = 3.0, .psi_m = 0.59, .l_d = 7.6e-3, .l_q = 12.9e-3,
                                              .r = 1.059};

static void to_rotor(double theta, const double in[2], double out[2])
{
    out[0] = cos(theta) * in[0] + sin(theta) * in[1];
    out[1] = cos(theta) * in[1] - sin(theta) * in[0];
}

static void to_stator(double theta, const double in[2], double out[2])
{
    to_rotor(-theta, in, out);
}

static void current(const struct machine_parameters *p, const double flux[2], double theta, double out[2])
{
    double dq[2];
    to_rotor(theta, flux, dq);
    dq[0] = (dq[0] - p->psi_m) / p->l_d;
    dq[1] /= p->l_q;
    to_stator(theta, dq, out);
}

static void derivative(const struct machine *m, const double flux[2], double theta, double out[2])
{
    double i[2];
    current(&m->parameters, flux, theta, i);
    for (int axis = 0; axis < 2; axis++) {
        out[axis] = m->v_begins[axis] - m->parameters.r * i[axis];
    }
}

static void integrate(struct machine *m)
{
    const double h = m->period / SUBSTEPS;
    for (int step = 0; step < SUBSTEPS; step++) {
        const double middle = m->theta_e + 0.5 * h * m->omega_e;
        const double end = m->theta_e + h * m->omega_e;
        double k[4][2];
        double at[2];
        derivative(m, m->flux, m->theta_e, k[0]);
        for (int stage = 1; stage < 4; stage++) {
            const double ahead = (stage == 3) ? h : 0.5 * h;
            for (int axis = 0; axis < 2; axis++) {
                at[axis] = m->flux[axis] + ahead * k[stage - 1][axis];
            }
            derivative(m, at, (stage == 3) ? end : middle, k[stage]);
        }
        for (int axis = 0; axis < 2; axis++) {
            m->flux[axis] += h / 6.0 * (k[0][axis] + 2.0 * k[1][axis] + 2.0 * k[2][axis] + k[3][axis]);
        }
        m->theta_e = end - TWO_PI * floor(end / TWO_PI);
    }
}

/* Voltage for the next interval, which lies 1.5 periods ahead in the middle; i_d = 0. */
static void control(struct machine *m, double out[2])
{
    const struct machine_parameters *p = &m->parameters;
    const double l[2] = {p->l_d, p->l_q};
    double i[2];
    double v[2];
    to_rotor(m->theta_e, m->measured, i);
    const double error[2] = {-i[0], m->i_q_reference - i[1]};
    const double speed_voltage[2] = {-m->omega_e * p->l_q * i[1], m->omega_e * (p->l_d * i[0] + p->psi_m)};
    for (int axis = 0; axis < 2; axis++) {
        const double kp = BANDWIDTH * l[axis];
        v[axis] = kp * error[axis] + m->integrator[axis] + speed_voltage[axis];
        m->integrator[axis] += m->period * BANDWIDTH * fmax(p->r, SLOWEST_INTEGRATOR * kp) * error[axis];
    }
    to_stator(m->theta_e + 1.5 * m->omega_e * m->period, v, out);
}

static double noise(struct machine *m)
{
    double sum = -2.0; /* of four uniform numbers, less their mean: variance 1/3 */
    for (int n = 0; n < 4; n++) {
        m->random ^= m->random << 13;
        m->random ^= m->random >> 7;
        m->random ^= m->random << 17;
        sum += (double)(m->random >> 11) / 9007199254740992.0;
    }
    return 1.7320508075688772 * sum * m->noise;
}

void machine_init(struct machine *machine, const struct machine_parameters *parameters, double sample_rate,
                  double omega_e, double theta_e, double torque, double noise_rms)
{
    *machine = (struct machine){
        .parameters = *parameters,
        .period = 1.0 / sample_rate,
        .omega_e = omega_e,
        .i_q_reference = torque / (1.5 * parameters->pole_pairs * parameters->psi_m),
        .noise = noise_rms,
        .theta_e = theta_e,
        .random = 0x9E3779B97F4A7C15u,
    };
    /* As after a catch of a spinning machine: the voltage before and at the start is the magnet's. */
    const double magnet[2] = {parameters->psi_m, 0.0};
    const double induced[2] = {0.0, omega_e * parameters->psi_m};
    to_stator(theta_e, magnet, machine->flux);
    to_stator(theta_e - 0.5 * omega_e * machine->period, induced, machine->v_ended);
    to_stator(theta_e + 0.5 * omega_e * machine->period, induced, machine->v_begins);
}

void machine_sample(struct machine *machine)
{
    current(&machine->parameters, machine->flux, machine->theta_e, machine->measured);
    machine->measured[0] += noise(machine);
    machine->measured[1] += noise(machine);
}

void machine_advance(struct machine *machine, double probe_alpha, double probe_beta)
{
    double v[2];
    control(machine, v);
    v[0] += probe_alpha;
    v[1] += probe_beta;
    const double size = hypot(v[0], v[1]);
    const double scale = (size > V_MAX) ? V_MAX / size : 1.0;
    integrate(machine);
    for (int axis = 0; axis < 2; axis++) {
        machine->v_ended[axis] = machine->v_begins[axis];
        machine->v_begins[axis] = scale * v[axis];
    }
}

/* The equations of ipmsm_can.estimation.regression and .observers.ges, in C, as a yardstick.
 *
 * Same statements in the same order as the compiled Python; built with cc -O2.
 */
#include <math.h>
#include <stddef.h>

typedef struct {
    double T_s, R, L_q, L_0, ell, alpha, decay, previous, present, gamma, epsilon;
} parameters_t;

typedef struct {
    double i_a, i_b, fe_a, fe_b, fi_a, fi_b, product, f_product;
    double lambda_a, lambda_b, kick_a, kick_b, s, f_s;
    long started;
} state_t;

static double along(double i_a, double i_b, double x_a, double x_b, double epsilon)
{
    double size = sqrt(x_a * x_a + x_b * x_b);
    return size >= epsilon ? (i_a * x_a + i_b * x_b) / size : 0.0;
}

/* samples (4, n), out (6, n): lambda, x, innovation, gain; both row by row. */
void observe(const double *samples, size_t n, const parameters_t *p, state_t *s, double *out)
{
    const double held = 1.0 - p->decay, ell_alpha = p->ell * p->alpha, half = 0.5 * p->gamma * p->T_s;
    for (size_t k = 0; k < n; k++) {
        double new_a = samples[k], new_b = samples[n + k], dl_a = 0.0, dl_b = 0.0;
        int started = (int)s->started;
        if (started) {
            double e_a = samples[2 * n + k] - 0.5 * p->R * (s->i_a + new_a);
            double e_b = samples[3 * n + k] - 0.5 * p->R * (s->i_b + new_b);
            s->fe_a = p->decay * s->fe_a + held * e_a;
            s->fe_b = p->decay * s->fe_b + held * e_b;
            s->fi_a = p->decay * s->fi_a + p->previous * s->i_a + p->present * new_a;
            s->fi_b = p->decay * s->fi_b + p->previous * s->i_b + p->present * new_b;
            dl_a = p->T_s * e_a;
            dl_b = p->T_s * e_b;
        } else {
            s->fi_a = new_a;
            s->fi_b = new_b;
            s->started = 1;
        }
        s->i_a = new_a;
        s->i_b = new_b;
        double h_a = p->alpha * (new_a - s->fi_a), h_b = p->alpha * (new_b - s->fi_b);
        double om1_a = s->fe_a - p->L_q * h_a, om1_b = s->fe_b - p->L_q * h_b;
        double om2_a = om1_a - p->L_0 * h_a, om2_b = om1_b - p->L_0 * h_b;
        double product = om2_a * om1_a + om2_b * om1_b;
        s->f_product = p->decay * s->f_product + p->previous * s->product + p->present * product;
        s->product = product;
        double y = p->L_0 * (s->fi_a * om1_a + s->fi_b * om1_b)
                 + (om1_a * om1_a + om1_b * om1_b + s->f_product) / p->alpha;
        double phi_a = om1_a + om2_a, phi_b = om1_b + om2_b;

        if (started) {
            s->lambda_a += s->kick_a + dl_a;
            s->lambda_b += s->kick_b + dl_b;
        }
        double x_a = s->lambda_a - p->L_q * new_a, x_b = s->lambda_b - p->L_q * new_b;
        double s_new = along(new_a, new_b, x_a, x_b, p->epsilon);
        double f_open = started ? p->decay * s->f_s + p->previous * s->s : (1.0 - p->present) * s_new;
        double size2 = phi_a * phi_a + phi_b * phi_b, z = half * size2, shrink, gain;
        if (z > 1e-12) {
            shrink = expm1(-z);
            gain = -shrink / size2;
        } else {
            shrink = -z;
            gain = half;
        }
        double open = y - (phi_a * x_a + phi_b * x_b);
        double innovation = open + ell_alpha * (s_new - (f_open + p->present * s_new));
        double c = gain * innovation;
        s->s = along(new_a, new_b, x_a + c * phi_a, x_b + c * phi_b, p->epsilon);
        s->f_s = f_open + p->present * s->s;
        c = gain * (open + ell_alpha * (s->s - s->f_s));
        s->lambda_a += c * phi_a;
        s->lambda_b += c * phi_b;
        c *= 1.0 + shrink;
        s->kick_a = c * phi_a;
        s->kick_b = c * phi_b;
        out[k] = s->lambda_a;
        out[n + k] = s->lambda_b;
        out[2 * n + k] = s->lambda_a - p->L_q * new_a;
        out[3 * n + k] = s->lambda_b - p->L_q * new_b;
        out[4 * n + k] = innovation;
        out[5 * n + k] = gain * (2.0 + shrink);
    }
}

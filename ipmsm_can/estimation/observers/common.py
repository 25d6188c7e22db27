"""What all observers share: their kinds, one record of parameters, one record of state, the rows they put out.

Every observer is a kernel `(samples, regression, parameters, state, out)` over a block, so that one compiled
call can choose among them; each uses the fields it needs.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ipmsm_can._jit import kernel
from ipmsm_can.estimation.filters import filter_coefficients
from ipmsm_can.estimation.observers.kinds import INJECTION_EXTRACTION, NON_SALIENT, WINDOW_CAPACITY
from ipmsm_can.estimation.observers.voltage_errors import BIASES, Uncertainty, keeps
from ipmsm_can.motor import Motor

_MOST_PERIODS = 16
_FILTER_PERIODS = 2.0
"""Time constant of each of the demodulation's two low-passes, in periods of the probing signal."""

FLUX_STATES = 2 + BIASES
"""States of `riccati`: stator flux and what may be wrong with the voltage."""

PARAMETERS = np.dtype([
    ("kind", "i8"),
    ("T_s", "f8"), ("L_q", "f8"), ("psi_m", "f8"), ("ell", "f8"), ("gamma", "f8"), ("epsilon", "f8"),
    ("alpha", "f8"), ("decay", "f8"), ("previous", "f8"), ("present", "f8"),
    # The inverse inductance L^-1 = mean I - difference exp(2j theta) conj(.), in 1/H; the current noise in A.
    ("mean", "f8"), ("difference", "f8"), ("noise", "f8"),
    # Probing signal: rad per sample, half its cotangent, samples in the window, filter coefficients.
    ("step", "f8"), ("half_cot", "f8"), ("window", "i8"), ("slow", "f8"), ("average", "f8"),
    # ges and riccati: pole of the loop that gives the speed; ges: whether the gain follows it.
    ("pole", "f8"), ("scheduled", "i8"),
    # riccati: 1-sigma of what is uncertain [V], [ohm], share of L_q; states of the voltage's error.
    ("L_d", "f8"), ("L_0", "f8"), ("residual", "f8"), ("residual_R", "f8"), ("volts", "f8"), ("spread_R", "f8"),
    ("spread_L", "f8"), ("zone", "f8"), ("corner", "f8"), ("rated", "f8"), ("tilt", "f8"), ("saturated", "f8"),
    ("prior", "f8", (BIASES,)), ("keep", "f8", (BIASES,)),
])

STATE = np.dtype([
    ("started", "i8"),
    ("lambda_a", "f8"), ("lambda_b", "f8"),
    ("kick_a", "f8"), ("kick_b", "f8"),
    ("s", "f8"), ("f_s", "f8"), ("x_a", "f8"), ("x_b", "f8"),
    ("u_a", "f8"), ("u_b", "f8"), ("f_u_a", "f8"), ("f_u_b", "f8"),
    # Injection: last angle [rad], whether it was ever seen, phase of the reference [rad].
    ("theta", "f8"), ("known", "i8"), ("phase", "f8"), ("count", "i8"), ("slot", "i8"),
    ("slow_i", "c16"), ("slow_d", "c16"), ("bins", "c16", (8,)),
    ("sums", "c16", (7,)), ("fresh", "c16", (7,)), ("ring", "c16", (WINDOW_CAPACITY, 3)),
    # ges with a scheduled gain, and riccati: a phase-locked loop of their own, as `speed` has it.
    ("pll_started", "i8"), ("pll_hat", "f8"), ("pll_theta", "f8"), ("pll_omega", "f8"), ("pll_difference", "f8"),
    # riccati: covariance, voltage errors, what these put into the regression, and what it judges itself by.
    ("P", "f8", (FLUX_STATES, FLUX_STATES)), ("bias", "f8", (BIASES,)),
    ("unit", "f8", (BIASES, 2)), ("product", "f8", (BIASES,)), ("f_product", "f8", (BIASES,)),
    ("square", "f8"), ("f_square", "f8"), ("off_a", "f8"), ("off_b", "f8"),
    ("missed", "f8"),
    ("last", "f8", (4,)), ("step", "f8", (4,)),
    ("i_a", "f8"), ("i_b", "f8"), ("memory", "f8"), ("clear", "f8", (3,)), ("test", "f8"),
    ("polarity", "i8"), ("lost", "i8"),
])

# Rows of the array that an observer puts out: estimated stator flux [Wb]; active flux [Wb]; innovation [V Wb],
# which is |Phi| times the flux innovation [Wb]; and the gain of the correction over the interval [1/V^2].
# Where the gain is no number, the row holds a 1-sigma [rad], pi = unknown: of the axis for the kinds in MODULO_PI,
# of the angle for RICCATI, which says in the last row what it thinks of it: bits FITS and POLARITY, else 0.
LAMBDA_A, LAMBDA_B, X_A, X_B, INNOVATION, GAIN, OPINION = range(7)
ROWS = 7
FITS, POLARITY = 1, 2


def assumed_motor(kind: int, motor: Motor) -> Motor:
    """The machine as an observer of this kind takes it: the kinds in NON_SALIENT know L_s only."""
    return replace(motor, L_d=motor.L_s, L_q=motor.L_s) if kind in NON_SALIENT else motor


def window_length(frequency: float, sample_rate: float) -> int:
    """Samples that hold whole periods of the probing signal; 0 where the window cannot.

    The fewest periods, up to 16, that are a whole number of samples within 0.1 %, else the best there is.
    frequency, sample_rate in Hz; 0 for a frequency of half the sample rate or more, and for one whose period is
    longer than WINDOW_CAPACITY samples.
    """
    period = sample_rate / frequency
    if not 2.0 < period <= WINDOW_CAPACITY:
        return 0
    best, best_miss = 0, math.inf
    for periods in range(1, _MOST_PERIODS + 1):
        n = round(periods * period)
        miss = abs(n - periods * period) / n
        if n > WINDOW_CAPACITY:
            break
        if miss < best_miss - 1e-12:
            best, best_miss = n, miss
        if miss < 1e-3:
            break
    return best


def parameters(kind: int, motor: Motor, alpha: float, gamma: float, epsilon: float, sample_rate: float,
               injection_frequency: float = 400.0, current_noise: float = 0.02,
               uncertainty: Uncertainty | None = None) -> NDArray[np.void]:
    """Record array (1,) of PARAMETERS for a motor as `assumed_motor` gives it.

    alpha [1/s]; gamma as in the observer's own equation, [1/(V^2 s)], for the gradients on the flux's length
    [1/(Wb^2 s)]; epsilon [Wb]; sample_rate, injection_frequency [Hz]; current_noise [A rms].
    uncertainty: what `riccati` weighs; None for its defaults.
    """
    u = uncertainty or Uncertainty(current=current_noise)
    f = filter_coefficients(alpha, 1.0 / sample_rate)
    p = np.zeros(1, PARAMETERS)
    product = motor.L_d * motor.L_q
    step = 2.0 * math.pi * injection_frequency / sample_rate
    values = {
        "kind": kind, "T_s": 1.0 / sample_rate, "L_q": motor.L_q, "psi_m": motor.psi_m, "ell": motor.ell,
        "gamma": gamma, "epsilon": epsilon,
        "alpha": alpha, "decay": f.decay, "previous": f.previous, "present": f.present,
        "mean": motor.L_s / product, "difference": 0.5 * motor.L_0 / product, "noise": current_noise,
        "step": step, "half_cot": 0.5 / math.tan(0.5 * step),
        "window": window_length(injection_frequency, sample_rate),
        "slow": -math.expm1(-step / 8.0), "average": -math.expm1(-step / (2.0 * math.pi * _FILTER_PERIODS)),
        "L_d": motor.L_d, "L_0": motor.L_0, "residual": u.residual, "residual_R": u.residual_resistance(motor),
        "volts": u.voltage,
        "spread_R": u.resistance * motor.R, "spread_L": u.inductance, "zone": u.dead_zone(motor),
        "corner": u.corner(motor), "rated": motor.rated_current, "tilt": u.tilt, "saturated": u.saturated,
        "prior": u.priors(motor), "keep": keeps(sample_rate),
    }
    for name, value in values.items():
        p[0][name] = value
    return p


def injection_delay(kind: int, injection_frequency: float, sample_rate: float) -> float:
    """Age [s] of the angle of a kind in MODULO_PI: half the window, or the low-passes' time constants."""
    if kind == INJECTION_EXTRACTION:
        return 0.5 * window_length(injection_frequency, sample_rate) / sample_rate
    return 2.0 * _FILTER_PERIODS / injection_frequency


def new_state(lambda_a: float, lambda_b: float, theta: float) -> NDArray[np.void]:
    """Record array (1,) of STATE before the first sample: stator flux [Wb] and, for MODULO_PI, angle [rad]."""
    state = np.zeros(1, STATE)
    state["lambda_a"] = lambda_a
    state["lambda_b"] = lambda_b
    state["theta"] = theta
    return state


def stand_still(state: NDArray[np.void], i: complex, filtered: complex, x: complex, epsilon: float) -> None:
    """Give the filters of d the past of a rotor that has always stood at the angle of x [Wb].

    i, filtered: current [A peak] and F[i] as the regression has it.  For a fixed direction c the filters take
    F[i^T c] = F[i]^T c, and the same for the gradient of i^T sigma(x).
    """
    o = state[0]
    size = abs(x)
    direction = x / size if size > epsilon else 0j
    across = direction * 1j / size if size > epsilon else 0j
    o["s"] = (i * direction.conjugate()).real
    o["f_s"] = (filtered * direction.conjugate()).real
    u = (i * direction.conjugate()).imag * across
    f_u = (filtered * direction.conjugate()).imag * across
    o["u_a"], o["u_b"], o["f_u_a"], o["f_u_b"] = u.real, u.imag, f_u.real, f_u.imag


@kernel
def along(i_a: float, i_b: float, x_a: float, x_b: float, epsilon: float) -> float:
    """i^T sigma(x): the current along the estimated rotor axis [A peak], 0 where |x| < epsilon."""
    size = math.sqrt(x_a * x_a + x_b * x_b)
    if size >= epsilon:
        return (i_a * x_a + i_b * x_b) / size
    return 0.0

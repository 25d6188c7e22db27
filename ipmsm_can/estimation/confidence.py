"""How far to trust the angle: its 1-sigma, lock, and whether the magnetic polarity is known.

Covariance.  For a correction gain g along Phi the flux error obeys
x~' = (I - g Phi Phi^T) x~ + g Phi n + T_s dv, so its covariance P follows a Lyapunov recursion, whatever law
chose the gain.  dv is the error of the reported mean voltage (`voltage_uncertainty`, correlated over
CORRELATION_TIME); n is the error of the regression: current noise, 2 alpha psi_m L_s i_n, and the same
voltage error once more through the filters, 2 psi_m |F[dv]|.  The angle's 1-sigma is the standard deviation
of x_hat across its own direction, divided by |x_hat|.

Lock.  The squared innovation over its predicted variance is averaged over INNOVATION_TIME.  An angle is
locked while that mean is small and sigma is below the limit asked for; an innovation far outside its
variance says that P is wrong, and everything learned so far is given up.

Polarity.  At standstill (theta, lambda) and (theta + pi, lambda - 2 psi_m c) give the same voltages and
currents, whatever is injected: there y = Phi^T x + d is zero.  Only rotation tells the two apart.  So
polarity counts as known once the observer has contracted by exp(-POLARITY_CONTRACTION) during time in which y
stood clear of anything that d or the voltage error can make of it; the slower pole of the rotating error
dynamics, s^2 + k s + w^2 with k = g |Phi|^2 / T_s, is the rate.

That is the theory of `ges`; of the other observers it describes

    spmsm_gradient(_max)  the linearised error, with the regressor 2 alpha psi_m x_hat/|x_hat| and no filter for
                          the voltage error to pass.  What turns with the rotor is added, times 1 + k/|w|, which
                          the slow pole makes of an error in length: the voltage error over |w|, as dead time
                          causes it, and a salient machine's (L_0/2) |i|.
                          Held to the circle, spmsm_gradient turns off by phi' = w (cos phi - 1) - (w^2/k) phi: what
                          pushes it beyond phi = w/(2k) makes it slip round, so a larger sigma means unknown
    spmsm_regression      the same linear error; (L_0/2) |i| across the axis is added
    both regressions      without d: |l| |H[i]|, which bounds it, acts as measurement noise correlated over 1/alpha
    chonam                the error along Phi; Lambda is taken as |l| |H[i]|/|x_hat| in an unknown direction, so a
                          correction spreads that much in every direction
    riccati               nothing: it brings its own covariance, innovation test and polarity (`observers.riccati`).
                          An observer that loses its lock again and again does not describe the machine, and its
                          covariance cannot be believed: each loss keeps `valid` off for longer
                          Added here is whether the speed is plausible: |Phi| against that of a rotor that turns as
                          fast as the angle does.
                          While the rotor turns, what is wrong with voltage and motor data points everywhere in
                          turn, and 2 sigma are rarely passed; at standstill all of it may stay at its worst and
                          point the same way, 3 sigma and more.  So an angle has to be surer to be valid there, and
                          surer still, and for a while, to become so
    injection_*           nothing: they bring the 1-sigma of their own fit, to which |w| times the age of the angle
                          is added.  They see an axis, not its north: polarity is not known unless `take_angle`
                          has told them; and none of their angles is valid, for a single window may be far off
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ipmsm_can._jit import kernel
from ipmsm_can.estimation.observers import kinds
from ipmsm_can.estimation.observers.common import FITS, POLARITY, assumed_motor, injection_delay
from ipmsm_can.motor import Motor

Floats = NDArray[np.float64]

CORRELATION_TIME = 0.01
"""Time [s] over which a voltage error is taken as constant."""
INNOVATION_TIME = 0.01
"""Averaging time [s] of the innovation test."""
MODEL_ERROR = 0.1
"""Error of psi_m and the inductances allowed for in the innovation test, relative to psi_m."""
POLARITY_CONTRACTION = 3.0
_LOCK_BELOW = 4.0
_LOST_ABOVE = 9.0
_SIGMA_HYSTERESIS = 1.5
_POLARITY_SIGMA = math.radians(45.0)
_UNKNOWN_AXIS = math.pi / 2.0
_PROBATION = 0.1
"""Time [s] after a loss of lock in which no angle is valid; twice as long for each further one that is not yet
forgotten, at most _LONGEST_PROBATION."""
_LONGEST_PROBATION = 3.2
_FORGIVEN = 1.0
"""Time [s] after which one loss of lock is forgotten."""
_SPEED_ERROR = 0.5
"""How far the speed of the angle and that behind |Phi| may be apart, relative to the larger."""

_SLOW_ENTERS, _FAST_ENTERS, _SLOW_STAYS = 0.6, 0.87, 0.75
"""Share of the largest valid 1-sigma at which an angle becomes valid at standstill and at speed, and up to which it
stays so at standstill; at speed it stays up to all of it.  In between, entering goes with the speed, staying with
its square: the errors of a slow rotor last as long as those of one that stands."""
_FAST_EMF = 7.0
"""Back-EMF over the voltage's uncertainty from which on the rotor counts as fast."""
_SURE = 0.005
"""Time [s] for which an angle has to be sure before it is valid: the first samples that it fits are no proof."""
_SURE_AGAIN, _LONGEST_SURE = 2.0, 0.2
"""Angle [rad electrical] that the rotor has to turn, or longest time [s], for which an angle has to be sure before
it is valid again, once it was too unsure for _SURE: what the filter took the voltage for while it went astray makes
a wrong angle fit, until the rotor stands differently."""
_CALMING = 0.1
"""Time constant [s] of the speed that counts for becoming valid: an angle put right looks like a turning rotor."""

LOCKED = 1
POLARITY_KNOWN = 2
VALID = 4
WITHHELD = 8
"""Not valid for a reason that sigma knows nothing of: on the wire it is unknown then, or a drive might go on."""

STATE = np.dtype([
    ("started", "i8"), ("T_s", "f8"), ("alpha", "f8"), ("psi_m", "f8"), ("ell", "f8"), ("epsilon", "f8"),
    ("process", "f8"), ("voltage", "f8"), ("white", "f8"), ("sigma_limit", "f8"),
    ("p_aa", "f8"), ("p_ab", "f8"), ("p_bb", "f8"),
    ("test", "f8"), ("contraction", "f8"), ("locked", "i8"), ("polarity", "i8"), ("lost", "i8"),
    # What the kind of observer adds; zeros for ges.
    ("own", "i8"), ("L_0", "f8"), ("volts", "f8"),
    ("axis_only", "i8"), ("delay", "f8"), ("radial", "i8"), ("slips", "i8"), ("rate", "f8"), ("L", "f8"),
    ("across", "f8"), ("neglected", "f8"), ("spread", "f8"),
    # riccati: losses of lock that are not yet forgotten, for how long [s] nothing is valid, and what was said last;
    # again: 1 it was valid, 2 and has been too unsure for _SURE since.
    ("losses", "f8"), ("probation", "f8"), ("valid", "i8"), ("calm", "f8"), ("sure", "f8"), ("again", "i8"),
])


def new_state(motor: Motor, alpha: float, epsilon: float, voltage_uncertainty: float, current_noise: float,
              sigma_limit: float, sample_rate: float, kind: int = kinds.GES,
              injection_frequency: float = 400.0) -> NDArray[np.void]:
    """Record array (1,) of STATE for the real motor, whatever an observer of this kind takes it for.

    alpha [1/s]; epsilon [Wb]; voltage_uncertainty [V]; current_noise [A rms]; sigma_limit: largest 1-sigma
    [rad electrical] at which an angle counts as locked; sample_rate, injection_frequency [Hz].
    """
    state = np.zeros(1, STATE)
    st = state[0]
    st["T_s"] = 1.0 / sample_rate
    st["alpha"] = alpha
    st["psi_m"] = motor.psi_m
    st["ell"] = abs(motor.ell)
    st["epsilon"] = epsilon
    st["process"] = 2.0 * voltage_uncertainty**2 * CORRELATION_TIME / sample_rate
    st["voltage"] = 2.0 * motor.psi_m * voltage_uncertainty
    st["white"] = (2.0 * alpha * motor.psi_m * motor.L_s * current_noise) ** 2
    st["sigma_limit"] = sigma_limit
    st["L"] = assumed_motor(kind, motor).L_q
    st["radial"] = kind in (kinds.SPMSM_GRADIENT, kinds.SPMSM_GRADIENT_MAX)
    st["slips"] = kind == kinds.SPMSM_GRADIENT
    if kind in kinds.NON_SALIENT:
        st["across"] = 0.5 * abs(motor.L_0)
    if kind in (kinds.SPMSM_REGRESSION, kinds.ACTIVE_FLUX_REGRESSION):
        st["neglected"] = abs(motor.ell)
    if kind == kinds.CHONAM:
        st["spread"] = abs(motor.ell)
    st["own"] = kind == kinds.RICCATI
    st["L_0"] = abs(motor.L_0)
    st["volts"] = voltage_uncertainty
    if kind in kinds.MODULO_PI:
        st["axis_only"] = 1
        st["delay"] = injection_delay(kind, injection_frequency, sample_rate)
    return state


def forget(state: NDArray[np.void]) -> None:
    """Give up lock, polarity and covariance: the next sample starts from nothing."""
    for name in ("started", "test", "contraction", "locked", "polarity", "valid", "sure", "again"):
        state[name] = 0


def withhold(flags: NDArray[np.uint8], where: NDArray[np.bool_]) -> None:
    """Put WITHHELD for VALID into flags (N,) where (N,) the samples themselves are in doubt."""
    flags[where] = flags[where] & np.uint8(0xFF ^ VALID) | np.uint8(WITHHELD)


def widen(state: NDArray[np.void], flux_variance: float) -> None:
    """Add flux_variance [Wb^2] in every direction: a gap in the samples went by."""
    state["p_aa"] += flux_variance
    state["p_bb"] += flux_variance


def take_angle(state: NDArray[np.void], x_hat: complex, measured: complex, sigma: float) -> complex:
    """Take in an active flux measured by its direction, polarity known: returns what x_hat has to be put right by.

    x_hat, measured [Wb]; sigma: 1-sigma of the direction [rad electrical].  Where polarity was unknown, x_hat
    becomes what was measured, else it is corrected across that by the Kalman gain of its covariance.
    """
    st = state[0]
    north = measured / abs(measured)
    psi_m = float(st["psi_m"])
    if not st["polarity"]:
        across2, along2 = (psi_m * sigma) ** 2, (MODEL_ERROR * psi_m) ** 2
        st["p_aa"] = along2 * north.real**2 + across2 * north.imag**2
        st["p_bb"] = along2 * north.imag**2 + across2 * north.real**2
        st["p_ab"] = (along2 - across2) * north.real * north.imag
        st["started"], st["polarity"], st["test"] = 1, 1, 1.0
        return measured - x_hat
    off = (north * x_hat.conjugate()).imag  # how far x_hat would have to move across the measured direction
    e_a, e_b = -north.imag, north.real
    pe_a = float(st["p_aa"] * e_a + st["p_ab"] * e_b)
    pe_b = float(st["p_ab"] * e_a + st["p_bb"] * e_b)
    expected = e_a * pe_a + e_b * pe_b + (abs(x_hat) * sigma) ** 2
    if not expected > 0.0:
        return 0j
    st["p_aa"] -= pe_a * pe_a / expected
    st["p_ab"] -= pe_a * pe_b / expected
    st["p_bb"] -= pe_b * pe_b / expected
    return complex(pe_a, pe_b) * off / expected


@kernel
def _axis_block(flux: Floats, speed: Floats, state: NDArray[np.void], sigma: Floats,
                flags: NDArray[np.uint8]) -> None:
    """Judge a block of an observer that puts out an axis and its 1-sigma, in the row of the gain.

    One misfit may be small by chance: its mean square over INNOVATION_TIME counts if it is larger.
    """
    st = state[0]
    smoothing = 1.0 - math.exp(-st.T_s / INNOVATION_TIME)
    locked = st.locked
    polarity = st.polarity
    test = st.test if st.started else _UNKNOWN_AXIS**2
    st.started = 1
    for k in range(flux.shape[1]):
        s = flux[5, k]
        if s < math.pi:
            late = st.delay * speed[2, k]
            s2 = s * s + late * late
            test += smoothing * (min(s2, _UNKNOWN_AXIS**2) - test)
            s = math.sqrt(max(s2, test))
        else:
            test += smoothing * (_UNKNOWN_AXIS**2 - test)
            s = math.pi
        if not s < math.pi:
            s = math.pi
        locked = 1 if s < (_SIGMA_HYSTERESIS if locked else 1.0) * st.sigma_limit else 0
        if s > _POLARITY_SIGMA:
            polarity = 0  # the rotor may have turned over meanwhile
        sigma[k] = s
        flags[k] = LOCKED * locked + POLARITY_KNOWN * polarity
    st.test = test
    st.locked = locked
    st.polarity = polarity


@kernel
def _own_block(regression: Floats, flux: Floats, speed: Floats, state: NDArray[np.void], sigma: Floats,
               flags: NDArray[np.uint8]) -> None:
    """Judge a block of `riccati`, which puts out its 1-sigma and its own opinion."""
    st = state[0]
    smoothing = 1.0 - math.exp(-st.T_s / INNOVATION_TIME)
    test = st.test if st.started else 2.0  # of the speed nothing is known yet
    st.started = 1
    locked = st.locked
    lost = st.lost
    losses = st.losses
    probation = st.probation
    valid = st.valid
    calm = st.calm
    sure = st.sure
    again = st.again
    steadying = 1.0 - math.exp(-st.T_s / _CALMING)
    for k in range(flux.shape[1]):
        s = flux[5, k]
        opinion = int(flux[6, k])
        omega = speed[2, k]
        phi = math.sqrt(regression[1, k] ** 2 + regression[2, k] ** 2)
        h = math.sqrt(regression[5, k] ** 2 + regression[6, k] ** 2)
        turning = 2.0 * st.alpha * st.psi_m * abs(omega) / math.sqrt(omega * omega + st.alpha * st.alpha)
        allowed = _SPEED_ERROR * max(phi, turning) + 4.0 * st.volts + 2.0 * st.L_0 * h
        off = abs(phi - turning) / max(allowed, 1e-30)
        if not off < 100.0:
            off = 100.0
        test += smoothing * (off - test)
        fits = opinion & FITS and test < 1.0
        losses = max(losses - st.T_s / _FORGIVEN, 0.0)
        probation = max(probation - st.T_s, 0.0)
        if locked:
            if not fits:
                lost += 1
                locked = 0
                probation = min(_PROBATION * 2.0**losses, _LONGEST_PROBATION)
                losses += 1.0
            elif s > _SIGMA_HYSTERESIS * st.sigma_limit:
                locked = 0
        elif fits and s < st.sigma_limit:
            locked = 1
        polarity = 1 if opinion & POLARITY else 0
        sigma[k] = s
        calm += steadying * (omega - calm)
        turning = abs(omega) if valid else min(abs(omega), abs(calm))
        fast = min(st.psi_m * turning / max(_FAST_EMF * st.volts, 1e-9), 1.0)
        if valid:
            share = _SLOW_STAYS + (1.0 - _SLOW_STAYS) * fast * fast
        else:
            share = _SLOW_ENTERS + (_FAST_ENTERS - _SLOW_ENTERS) * fast
        if not (locked and polarity and probation == 0.0):
            sure = 0.0
            valid = 0
        elif s <= share * st.sigma_limit:
            needed = _SURE
            if again == 2:
                needed = min(max(_SURE_AGAIN / max(abs(calm), 1e-9), _SURE), _LONGEST_SURE)
            sure = min(sure + st.T_s, needed + st.T_s)
            if sure > needed:
                valid = 1
                again = 0
        else:
            # Too unsure for a moment, it has to be sure again for as long, no longer.
            sure = max(sure - st.T_s, 0.0)
            if valid:
                again = 1
            if again == 1 and sure == 0.0:
                again = 2
            valid = 0
        flags[k] = LOCKED * locked + POLARITY_KNOWN * polarity + (VALID if valid else 0)
        if probation > 0.0:
            flags[k] |= WITHHELD
    st.test = test
    st.locked = locked
    st.lost = lost
    st.losses = losses
    st.probation = probation
    st.valid = valid
    st.calm = calm
    st.sure = sure
    st.again = again


@kernel
def confidence_block(regression: Floats, flux: Floats, speed: Floats, state: NDArray[np.void], sigma: Floats,
                     flags: NDArray[np.uint8]) -> None:
    """Judge a block.

    regression: float64 (7, N); flux: float64 (7, N) from an observer; speed: float64 (3, N).
    sigma: float64 (N,), 1-sigma of theta_hat [rad electrical], at most pi, which means unknown.
    flags: uint8 (N,), bits LOCKED, POLARITY_KNOWN, VALID, WITHHELD.
    """
    st = state[0]
    if st.axis_only:
        _axis_block(flux, speed, state, sigma, flags)
        return
    if st.own:
        _own_block(regression, flux, speed, state, sigma, flags)
        return
    T_s = st.T_s
    alpha = st.alpha
    psi_m = st.psi_m
    process = st.process
    correlated = 2.0 * CORRELATION_TIME / T_s
    smoothing = 1.0 - math.exp(-T_s / INNOVATION_TIME)
    model2 = (MODEL_ERROR * psi_m) ** 2
    p_aa = st.p_aa
    p_ab = st.p_ab
    p_bb = st.p_bb
    test = st.test
    contraction = st.contraction
    locked = st.locked
    polarity = st.polarity
    started = st.started
    lost = st.lost
    for k in range(flux.shape[1]):
        x_a = flux[2, k]
        x_b = flux[3, k]
        x2 = x_a * x_a + x_b * x_b
        if not started:
            started = 1
            unknown = (psi_m + math.sqrt(x2)) ** 2
            p_aa = unknown
            p_bb = unknown
            p_ab = 0.0
        phi_a = regression[1, k]
        phi_b = regression[2, k]
        innovation = flux[4, k]
        gain = flux[5, k]
        if st.radial:
            size = math.sqrt(phi_a * phi_a + phi_b * phi_b)
            to_radial = 2.0 * alpha * psi_m
            innovation = innovation / size * to_radial if size > 0.0 else 0.0
            to_radial = to_radial / math.sqrt(x2) if x2 > st.epsilon * st.epsilon else 0.0
            phi_a = to_radial * x_a
            phi_b = to_radial * x_b
        phi2 = phi_a * phi_a + phi_b * phi_b
        h = math.sqrt(regression[5, k] ** 2 + regression[6, k] ** 2)
        omega = speed[2, k]
        voltage2 = st.voltage * st.voltage * (alpha * alpha / (alpha * alpha + omega * omega))
        filtered2 = 0.0 if st.radial else voltage2
        neglected2 = (st.neglected * h) ** 2
        # Predict, test the innovation against its own variance, correct.
        p_aa += process
        p_bb += process
        b_a = p_aa * phi_a + p_ab * phi_b
        b_b = p_ab * phi_a + p_bb * phi_b
        seen = b_a * phi_a + b_b * phi_b
        expected = seen + st.white + filtered2 + model2 * phi2 + neglected2
        test += smoothing * (innovation * innovation / max(expected, 1e-30) - test)
        spread = gain * gain * (seen + st.white + filtered2 * correlated + neglected2 * (2.0 / (alpha * T_s)))
        p_aa += -2.0 * gain * phi_a * b_a + spread * phi_a * phi_a
        p_bb += -2.0 * gain * phi_b * b_b + spread * phi_b * phi_b
        p_ab += -gain * (phi_a * b_b + phi_b * b_a) + spread * phi_a * phi_b
        if st.spread > 0.0 and x2 > st.epsilon * st.epsilon:
            everywhere = spread * (st.spread * h) ** 2 / x2
            p_aa += everywhere
            p_bb += everywhere
        ceiling = 4.0 * psi_m * psi_m + x2
        if p_aa > ceiling or p_bb > ceiling:
            # Nothing is known of this direction; without a ceiling P would grow for ever at standstill.
            shrink = ceiling / max(p_aa, p_bb)
            p_aa *= shrink
            p_ab *= shrink
            p_bb *= shrink
        if test > _LOST_ABOVE:
            p_aa = ceiling
            p_bb = ceiling
            p_ab = 0.0
            test = 1.0
            contraction = 0.0
            polarity = 0
            if locked:
                lost += 1
            locked = 0
        # Angle uncertainty across the direction of x_hat.
        if x2 > st.epsilon * st.epsilon:
            across = (x_b * x_b * p_aa - 2.0 * x_a * x_b * p_ab + x_a * x_a * p_bb) / x2
            s = math.sqrt(max(across, 0.0) / x2)
            if st.across > 0.0 or st.radial:
                i2 = ((flux[0, k] - x_a) ** 2 + (flux[1, k] - x_b) ** 2) / (st.L * st.L)
                bias2 = st.across * st.across * i2
                if st.radial:
                    if gain > 0.0:
                        st.rate = gain * phi2 / T_s
                    turning = max(abs(omega), 1e-9)
                    bias2 = (bias2 + (st.voltage / (2.0 * psi_m * turning)) ** 2) * (1.0 + st.rate / turning) ** 2
                s = math.sqrt(s * s + bias2 / x2)
            if st.slips and 2.0 * st.rate * s > abs(omega):
                s = math.pi
        else:
            s = math.pi
        if not s < math.pi:  # as well where an absurd sample made it NaN
            s = math.pi
        # Polarity: contraction gathered while y cannot be explained by standstill.
        if regression[0, k] > 4.0 * st.ell * h + 2.0 * math.sqrt(voltage2):
            rate = gain * phi2 / T_s
            if rate > 0.0:
                contraction += T_s * min(0.5 * rate, omega * omega / rate)
        if s > _POLARITY_SIGMA:
            polarity = 0
        elif contraction > POLARITY_CONTRACTION and test < _LOCK_BELOW:
            polarity = 1
        if s >= _POLARITY_SIGMA and contraction > POLARITY_CONTRACTION:
            contraction = 0.0
        if locked:
            if s > _SIGMA_HYSTERESIS * st.sigma_limit:
                locked = 0
        elif s < st.sigma_limit and test < _LOCK_BELOW:
            locked = 1
        sigma[k] = s
        valid = locked and polarity and s <= st.sigma_limit
        flags[k] = LOCKED * locked + POLARITY_KNOWN * polarity + (VALID if valid else 0)
    st.p_aa = p_aa
    st.p_ab = p_ab
    st.p_bb = p_bb
    st.test = test
    st.contraction = contraction
    st.locked = locked
    st.polarity = polarity
    st.started = started
    st.lost = lost

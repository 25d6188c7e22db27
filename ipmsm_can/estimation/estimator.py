"""The estimator: samples in, angle, speed, flux, excitation and trust out, block by block."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ipmsm_can._jit import kernel
from ipmsm_can.estimation import confidence, excitation, regression, speed, timing
from ipmsm_can.estimation.confidence import confidence_block
from ipmsm_can.estimation.excitation import excitation_block
from ipmsm_can.estimation.observers import common, forgetting, handover
from ipmsm_can.estimation.observers.dispatch import observer_block
from ipmsm_can.estimation.observers.kinds import KINDS, MODULO_PI, RICCATI
from ipmsm_can.estimation.observers.voltage_errors import Uncertainty
from ipmsm_can.estimation.regression import regression_block
from ipmsm_can.estimation.speed import speed_block
from ipmsm_can.estimation.timing import align_block, carry_block
from ipmsm_can.motor import Motor

Floats = NDArray[np.float64]
Records = NDArray[np.void]

FORGET_AFTER = 0.5
"""A gap in the samples longer than this [s] starts everything anew."""
_SPEED_DOUBT = 0.1
"""How wrong the extrapolation over a gap may be, relative to the angle turned meanwhile."""
_TORQUE_DOUBT = 0.25
"""1-sigma of the torque on the shaft that nobody saw change in a gap, as a share of the rated torque."""


@dataclass(frozen=True, slots=True)
class EstimatorSettings:
    """What the estimator needs to know besides the motor; the defaults live in the configuration model.

    kind: name of the observer, a key of `observers.kinds.KINDS`.  alpha [1/s], gamma in the unit of the
    observer's own equation, initial_flux [Wb, Wb], epsilon [Wb];
    excitation_window [s]; speed_bandwidth [Hz]; voltage_uncertainty [V]; current_noise [A rms];
    valid_sigma: largest 1-sigma of a valid angle [deg electrical]; injection_frequency [Hz].
    For riccati: 1-sigma of the resistance and the inductances as shares of them; by how
    much L_d falls at rated current, as a share; and which errors of the voltage
    are estimated.  scheduled: whether the gain of ges follows the speed.
    voltage_delay: how late the reported voltage is [samples], -2..2; None: 0 until another one is found.
    """

    kind: str
    alpha: float
    gamma: float
    initial_flux: tuple[float, float]
    epsilon: float
    excitation_window: float
    speed_bandwidth: float
    voltage_uncertainty: float
    current_noise: float
    valid_sigma: float
    injection_frequency: float = 400.0
    resistance_uncertainty: float = 0.12
    inductance_uncertainty: float = 0.06
    adapt_voltage: bool = True
    adapt_resistance: bool = True
    scheduled: bool = False
    voltage_delay: float | None = None
    saturation_uncertainty: float = 0.2

    @property
    def uncertainty(self) -> Uncertainty:
        """What `riccati` weighs."""
        return Uncertainty(self.voltage_uncertainty, self.current_noise, self.resistance_uncertainty,
                           self.inductance_uncertainty, self.adapt_voltage, self.adapt_resistance,
                           self.saturation_uncertainty)


@dataclass(frozen=True, slots=True)
class EstimateBlock:
    """Result of a block of N samples; all arrays belong to the same samples in the same order.

    regression (7, N): y [V Wb], Phi [V], lambda increment [Wb], H[i] [A/s].
    flux (7, N): lambda_hat [Wb], x_hat [Wb], innovation [V Wb], and the rest as in `observers.common`.
    angle (3, N): theta_hat, smoothed theta [rad electrical, -pi..pi], omega [rad/s electrical].
    excitation (N,): smallest eigenvalue of the windowed integral of Phi Phi^T [V^2 s].
    sigma (N,): 1-sigma of theta_hat [rad electrical], pi = unknown.
    flags (N,): bits LOCKED, POLARITY_KNOWN, VALID, WITHHELD of `confidence`.
    """

    regression: Floats
    flux: Floats
    angle: Floats
    excitation: Floats
    sigma: Floats
    flags: NDArray[np.uint8]

    @classmethod
    def empty(cls, n: int) -> EstimateBlock:
        """Room for n samples."""
        return cls(np.empty((regression.ROWS, n)), np.empty((common.ROWS, n)), np.empty((speed.ROWS, n)),
                   np.empty(n), np.empty(n), np.empty(n, np.uint8))


@kernel
def estimate_block(samples: Floats, regression_parameters: Records, regression_state: Records,
                   observer_parameters: Records, observer_state: Records, speed_state: Records,
                   excitation_state: Records, confidence_state: Records, regressed: Floats, flux: Floats,
                   angle: Floats, excited: Floats, sigma: Floats, flags: NDArray[np.uint8]) -> None:
    """All steps over a block in one call: on a live bus the calls cost more than the work."""
    aligned = np.empty(samples.shape)
    ahead = np.empty(samples.shape[1], np.int64)
    align_block(samples, regression_state["timing"], aligned, ahead)
    regression_block(aligned, regression_parameters, regression_state, regressed)
    observer_block(aligned, regressed, observer_parameters, observer_state, flux)
    speed_block(flux, speed_state, angle)
    excitation_block(regressed, excitation_state, excited)
    confidence_block(regressed, flux, angle, confidence_state, sigma, flags)
    carry_block(samples, ahead, regression_state["timing"], flux, angle)


class Estimator:
    """Regression, observer, phase-locked loop, excitation and confidence of one drive, with their state.

    Any partition of the same samples into blocks gives the same bits.
    """

    def __init__(self, motor: Motor, sample_rate: float, settings: EstimatorSettings) -> None:
        self.motor = motor
        self.sample_rate = sample_rate
        self.settings = settings
        s = settings
        kind = KINDS[s.kind]
        self._assumed = common.assumed_motor(kind, motor)
        self._regression_parameters = regression.parameters(self._assumed, s.alpha, sample_rate)
        self._regression = np.zeros(1, regression.STATE)
        self._regression["timing"] = timing.new_state(self._assumed, s.voltage_delay, s.injection_frequency,
                                                      sample_rate, s.uncertainty, s.speed_bandwidth)
        self._observer_parameters = common.parameters(kind, self._assumed, s.alpha, s.gamma, s.epsilon, sample_rate,
                                                      s.injection_frequency, s.current_noise, s.uncertainty)
        self._observer_parameters["pole"] = speed.pole(s.speed_bandwidth, sample_rate)
        self._observer_parameters["scheduled"] = s.scheduled
        self._observer = self._from_the_start()
        self._speed = speed.new_state(s.speed_bandwidth, s.epsilon, sample_rate)
        self._excitation = excitation.new_state(s.excitation_window, sample_rate)
        self._confidence = confidence.new_state(
            motor, s.alpha, s.epsilon, s.voltage_uncertainty, s.current_noise,
            math.radians(s.valid_sigma), sample_rate, kind, s.injection_frequency)

    def _from_the_start(self) -> Records:
        a, b = self.settings.initial_flux
        return common.new_state(a, b, math.atan2(b, a))

    @property
    def records(self) -> tuple[Records, ...]:
        """Parameters and states in the order that `estimate_block` takes them."""
        return (self._regression_parameters, self._regression, self._observer_parameters, self._observer,
                self._speed, self._excitation, self._confidence)

    @property
    def lost_locks(self) -> int:
        """How often lock was given up because the innovation did not fit."""
        return int(self._confidence["lost"][0])

    @property
    def voltage_delay(self) -> timing.VoltageDelay:
        """How late the voltage is against the current: set right, and found."""
        return timing.known(self._regression["timing"])

    @property
    def polarity_known(self) -> bool:
        """Whether north is told from south as of the last sample."""
        state = self._observer if KINDS[self.settings.kind] == RICCATI else self._confidence
        return bool(state[0]["polarity"])

    def process(self, samples: Floats, gap: NDArray[np.int64] | None = None) -> EstimateBlock:
        """Run a block.

        samples: float64 (4, N), C-contiguous: i_alpha, i_beta [A peak], v_alpha, v_beta [V peak, mean of the
        interval that ended at the sample].
        gap: int64 (N,), number of samples missing right before each one, or None for none at all; a gap
        restarts the filters and carries flux and angle over it with the last speed.  Negative: the samples
        before turn out to have been dated wrong by so many; angle and speed are kept, but doubted.
        """
        n = samples.shape[1]
        out = EstimateBlock.empty(n)
        if gap is None or not gap.any():
            self._segment(samples, out)
            return out
        starts = np.flatnonzero(gap).tolist()
        edges = [0, *(k for k in starts if k), n]
        for begin, end in pairwise(edges):
            missing = int(gap[begin])
            if missing:
                self._restart(missing, samples[:, begin])
            part = EstimateBlock.empty(end - begin)
            self._segment(np.ascontiguousarray(samples[:, begin:end]), part)
            span = slice(begin, end)
            out.regression[:, span] = part.regression
            out.flux[:, span] = part.flux
            out.angle[:, span] = part.angle
            out.excitation[span] = part.excitation
            out.sigma[span] = part.sigma
            out.flags[span] = part.flags
        return out

    def take_angle(self, theta: float, sigma: float) -> None:
        """Take in an angle of known polarity for the last sample, while the rotor stands still.

        theta, sigma: angle and its 1-sigma [rad electrical].  An observer of flux is corrected by its covariance,
        or set where its polarity was unknown; one of the kinds in MODULO_PI is put on the branch of theta.
        """
        o, c, r, pll = self._observer[0], self._confidence[0], self._regression[0], self._speed[0]
        kind = KINDS[self.settings.kind]
        if kind in MODULO_PI:
            own = float(o["theta"]) if o["known"] else theta
            o["theta"], o["known"] = own + math.pi * round((theta - own) / math.pi), 1
            c["polarity"] = 1
            return
        unknown = not self.polarity_known
        i = complex(r["i_a"], r["i_b"])
        x = complex(o["lambda_a"], o["lambda_b"]) - self._assumed.L_q * i
        before = x
        north = complex(math.cos(theta), math.sin(theta))
        measured = (self._assumed.psi_m + self._assumed.L_0 * (i * north.conjugate()).real) * north
        if kind == RICCATI:
            x += handover.take_angle(self._observer, self._assumed.psi_m, self._observer_parameters[0]["prior"], x,
                                    measured, sigma)
        else:
            x += confidence.take_angle(self._confidence, x, measured, sigma)
        flux = x + self._assumed.L_q * i
        o["lambda_a"], o["lambda_b"], o["x_a"], o["x_b"] = flux.real, flux.imag, x.real, x.imag
        if unknown:
            o["kick_a"] = o["kick_b"] = 0.0
            pll["theta"] = pll["theta_hat"] = o["pll_theta"] = o["pll_hat"] = math.atan2(x.imag, x.real)
            pll["omega"] = pll["omega_difference"] = o["pll_omega"] = o["pll_difference"] = 0.0
        else:
            # An angle put right is no rotation: the loops go on from it with the speed that they had.
            moved = math.atan2((x * before.conjugate()).imag, (x * before.conjugate()).real)
            for record, name in ((pll, "theta"), (pll, "theta_hat"), (o, "pll_theta"), (o, "pll_hat")):
                record[name] = math.remainder(float(record[name]) + moved, 2.0 * math.pi)
        common.stand_still(self._observer, i, complex(r["fi_a"], r["fi_b"]), x, self.settings.epsilon)

    def doubt(self) -> None:
        """Give up all trust in the angle, but not the angle: it has to be found anew from the samples to come."""
        confidence.forget(self._confidence)
        if KINDS[self.settings.kind] == RICCATI:
            forgetting.doubt(self._observer_parameters, self._observer)

    def _segment(self, samples: Floats, out: EstimateBlock) -> None:
        estimate_block(samples, self._regression_parameters, self._regression, self._observer_parameters,
                       self._observer, self._speed, self._excitation, self._confidence, out.regression,
                       out.flux, out.angle, out.excitation, out.sigma, out.flags)

    def _restart(self, missing: int, first: Floats) -> None:
        """Start the filters anew before the sample `first` (4,), `missing` samples after the last one."""
        s = self.settings
        # The observer stands at the current that was handed on last, which may be older than the last reported.
        elapsed = (max(missing, 0) + 1 + int(self._regression["timing"]["ahead"][0])) / self.sample_rate
        timing.restart(self._regression["timing"])
        self._regression["started"] = 0
        old = self._observer[0]
        if elapsed > FORGET_AFTER or not self._speed["started"][0]:
            self._speed = speed.new_state(s.speed_bandwidth, s.epsilon, self.sample_rate)
            self._excitation = excitation.new_state(s.excitation_window, self.sample_rate)
            confidence.forget(self._confidence)
            fresh = self._from_the_start()
        else:
            # The rotor went on turning: carry |x_hat| at the angle it must have now.
            pll = self._speed
            turned = float(pll["omega"][0]) * elapsed
            angle = float(pll["theta"][0]) + turned
            # The acceleration may have ended in the gap, or begun: a load step is not announced.
            bent = 0.0
            one_step_back, lag = angle - float(pll["omega"][0]) / self.sample_rate, 0.0
            own = KINDS[s.kind] == RICCATI
            unseen = _TORQUE_DOUBT * self.motor.pole_pairs * self.motor.rated_torque / self.motor.J
            if own:
                bent = 0.5 * unseen * elapsed**2
            if own and self._confidence["locked"][0]:
                speed_before = float(pll["omega"][0])
                angle, omega, lag = speed.carried(pll, elapsed)
                accelerated = (omega - speed.carried(pll, 0.0)[1]) / elapsed
                bent = math.hypot(bent, 0.5 * accelerated * elapsed**2)
                turned = angle - float(pll["theta_hat"][0])
                one_step_back = angle - omega / self.sample_rate
                # The loop goes on with the lag that it had.
                pll["omega"] = speed_before + omega - speed.carried(pll, 0.0)[1]
            size = self.motor.psi_m
            held = float(np.hypot(old["x_a"], old["x_b"]))
            if held > s.epsilon:
                size = held
            fresh = common.new_state(size * math.cos(angle) + self._assumed.L_q * float(first[0]),
                                     size * math.sin(angle) + self._assumed.L_q * float(first[1]), angle)
            fresh["known"] = old["known"]
            pll["theta_hat"] = math.remainder(one_step_back, 2.0 * math.pi)
            pll["theta"] = math.remainder(one_step_back - lag, 2.0 * math.pi)
            if missing < 0:
                # What was taken for one stretch of time was two, or the other way round.  How fast the rotor turned
                # in between the speed loop has forgotten by now where the seam did not fit.
                seam = abs(missing) / self.sample_rate
                off = math.hypot(seam * float(pll["omega"][0]), 0.5 * unseen * seam**2)
                doubt = size * (min(off, math.pi) if self._confidence["locked"][0] else math.pi)
            else:
                doubt = size * min(math.hypot(_SPEED_DOUBT * turned, bent), math.pi)
            drift = s.voltage_uncertainty * elapsed
            confidence.widen(self._confidence, doubt**2 + drift**2)
            for name in ("pll_started", "pll_omega", "pll_difference"):
                fresh[name] = old[name]
            fresh["pll_hat"] = pll["theta_hat"]
            fresh["pll_theta"] = pll["theta"]
            fresh["x_a"], fresh["x_b"] = old["x_a"], old["x_b"]
            if own:
                handover.carry_over(self._observer, fresh, turned, doubt**2 + drift**2)
        self._observer = fresh

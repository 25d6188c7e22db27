"""The paper in continuous time: machine, control, filters and observer as one differential equation.

Nothing here calls the package's mathematics (only `Motor`, for the parameters): the right-hand side is written
from the paper's equations and integrated by SciPy's DOP853.  Space vectors are complex, a^T b = Re(conj(a) b).

The sampled estimator is then fed with what a perfect drive would report: the current at t_k and the exact mean
voltage over the interval before, from the integral of v carried along as a state.

Start of the filters.  The paper leaves their initial states open and drops the decaying term epsilon_t that they
cause.  The package starts them as if the machine had stood with the first sample's current for ever, F[i] = i(0),
F[v - R i] = 0, product filter 0, F[i^T sigma] = i^T sigma(x_hat) at 0.  With `clean` the same start is taken here,
so both solve the same initial-value problem; without it every filter starts from 0.
"""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from ipmsm_can.motor import Motor

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]


def current(motor: Motor, flux: complex, theta: float) -> complex:
    """i from lambda: the inverse of (ipmsm2), lambda = [L_s I + L_0/2 Q(2 theta)] i + psi_m c(theta)."""
    u = flux - motor.psi_m * cmath.exp(1j * theta)
    # Q(2 theta) a = exp(2j theta) conj(a), and Q Q = I.
    reflected = cmath.exp(2j * theta) * u.conjugate()
    return (motor.L_s * u - 0.5 * motor.L_0 * reflected) / (motor.L_d * motor.L_q)


def constitutive(motor: Motor, i: complex, theta: float) -> complex:
    """lambda = L_q i + (L_0 i^T c + psi_m) c, equation (lamithe)."""
    c = cmath.exp(1j * theta)
    return motor.L_q * i + (motor.L_0 * (i.conjugate() * c).real + motor.psi_m) * c


class Plant(Protocol):
    """A machine and what drives it.  States of its own come first: lambda_alpha, lambda_beta, ..."""

    @property
    def motor(self) -> Motor:
        """The machine."""

    @property
    def kinks(self) -> tuple[float, ...]:
        """Times [s] at which the right-hand side is not smooth; the integrator stops there."""

    def start(self) -> list[float]:
        """States at t = 0."""

    def drive(self, t: float, s: Floats, after: float) -> tuple[complex, complex, list[float]]:
        """Current [A], voltage [V], derivatives of the states after lambda; `after`: last kink up to t, or 0."""

    def theta(self, states: Floats) -> Floats:
        """Electrical angle [rad] from states (n, N)."""


@dataclass(frozen=True)
class SpeedRamp:
    """Fig. 1: field-oriented speed control with decoupling, reference held, ramped, held; constant load.

    Speeds mechanical [rad/s], load [N m]; bandwidths [rad/s].  It starts in the steady state of the first speed.
    """

    motor: Motor
    slow: float = 10.0
    fast: float = 100.0
    begin: float = 0.5
    end: float = 1.5
    load: float = 0.5
    theta_0: float = 0.3
    speed_bandwidth: float = 2 * math.pi * 15
    current_bandwidth: float = 2 * math.pi * 200

    @property
    def kinks(self) -> tuple[float, ...]:
        return (self.begin, self.end)

    def start(self) -> list[float]:
        m = self.motor
        i_q = self.load / (1.5 * m.pole_pairs * m.psi_m)
        flux = constitutive(m, 1j * i_q * cmath.exp(1j * self.theta_0), self.theta_0)
        return [flux.real, flux.imag, self.slow, self.theta_0, self.load]

    def drive(self, t: float, s: Floats, after: float) -> tuple[complex, complex, list[float]]:
        m = self.motor
        flux, omega_m, theta, held_torque = complex(s[0], s[1]), float(s[2]), float(s[3]), float(s[4])
        i = current(m, flux, theta)
        share = min(max((t - self.begin) / (self.end - self.begin), 0.0), 1.0)
        error = self.slow + share * (self.fast - self.slow) - omega_m
        gain = m.J * self.speed_bandwidth
        wanted = 1j * (gain * error + held_torque) / (1.5 * m.pole_pairs * m.psi_m)
        # In the rotor frame: lambda_dq' = v - R i - j w lambda; the coupling is cancelled exactly.
        back = cmath.exp(-1j * theta)
        i_dq, flux_dq = i * back, flux * back
        pull = wanted - i_dq
        v_dq = (m.R * i_dq + 1j * m.pole_pairs * omega_m * flux_dq
                + self.current_bandwidth * complex(m.L_d * pull.real, m.L_q * pull.imag))
        torque = 1.5 * m.pole_pairs * (flux.conjugate() * i).imag
        return i, v_dq / back, [(torque - self.load) / m.J, m.pole_pairs * omega_m,
                                0.25 * gain * self.speed_bandwidth * error]

    def theta(self, states: Floats) -> Floats:
        return np.asarray(states[3])


@dataclass(frozen=True)
class Standstill:
    """A locked rotor without current; from `begin` [s] on a rotating voltage, amplitude [V peak], frequency [Hz].

    pwm_rate [Hz]: the voltage is a staircase, held for a period at the mean that the rotating one has there, which
    is how an inverter gives it (and `injection/waveform.py` asks for it); None: the smooth rotating voltage itself.
    """

    motor: Motor
    amplitude: float
    frequency: float = 400.0
    begin: float = 0.05
    theta_0: float = 0.7
    pwm_rate: float | None = 5000.0
    last: float = 1.0

    @property
    def kinks(self) -> tuple[float, ...]:
        if self.pwm_rate is None:
            return (self.begin,)
        first, last = round(self.begin * self.pwm_rate), round(self.last * self.pwm_rate)
        return tuple(k / self.pwm_rate for k in range(first, last))

    def start(self) -> list[float]:
        flux = self.motor.psi_m * cmath.exp(1j * self.theta_0)
        return [flux.real, flux.imag]

    def drive(self, t: float, s: Floats, after: float) -> tuple[complex, complex, list[float]]:
        i = current(self.motor, complex(s[0], s[1]), self.theta_0)
        if after < self.begin - 1e-9:
            return i, 0j, []
        turning = 2j * math.pi * self.frequency
        if self.pwm_rate is None:
            return i, self.amplitude * cmath.exp(turning * (t - self.begin)), []
        half = 0.5 * turning / self.pwm_rate
        middle = cmath.exp(turning * (after - self.begin) + half)
        return i, self.amplitude * middle * (cmath.sinh(half) / half), []

    def theta(self, states: Floats) -> Floats:
        return np.full(states.shape[1], self.theta_0)


@dataclass(frozen=True)
class Gains:
    """alpha [1/s], gamma [1/(V^2 s)], lambda_hat(0) [Wb], epsilon [Wb] of Proposition 1."""

    alpha: float
    gamma: float
    initial_flux: complex
    epsilon: float


@dataclass(frozen=True)
class Solution:
    """N instants k / rate: i [A], the integral of v [V s], true theta [rad], x and x_hat [Wb], Phi [V]."""

    rate: float
    i: Complexes
    volt_seconds: Complexes
    theta: Floats
    x: Complexes
    x_hat: Complexes
    phi: Complexes

    def samples(self, every: int = 1) -> tuple[Complexes, Complexes]:
        """Current and mean voltage of every so-many-th instant; 0 for the first voltage, which nobody knows."""
        integral = self.volt_seconds[::every]
        v = np.concatenate([[0.0], np.diff(integral) * (self.rate / every)])
        return self.i[::every], v


def solve(plant: Plant, gains: Gains, duration: float, rate: float, clean: bool = True) -> Solution:
    """Integrate plant, the filters of Lemma 1 and the observer (equation (observer)) together."""
    m = plant.motor
    R, L_q, L_0, ell = m.R, m.L_q, m.L_0, m.psi_m * (m.L_d - m.L_q)
    alpha, gamma = gains.alpha, gains.gamma
    own = len(plant.start())

    def sigma(x: complex) -> complex:
        return x / abs(x) if abs(x) >= gains.epsilon else 0j

    def regressor(i: complex, f_e: complex, f_i: complex) -> tuple[complex, complex]:
        omega_1 = f_e - L_q * alpha * (i - f_i)
        return omega_1, omega_1 - L_0 * alpha * (i - f_i)

    def derivative(t: float, s: Floats, after: float) -> list[float]:
        i, v, rest = plant.drive(t, s, after)
        f_e, f_i = complex(s[own + 2], s[own + 3]), complex(s[own + 4], s[own + 5])
        f_product, f_along = float(s[own + 6]), float(s[own + 7])
        x_hat = complex(s[own + 8], s[own + 9]) - L_q * i
        emf = v - R * i
        omega_1, omega_2 = regressor(i, f_e, f_i)
        phi = omega_1 + omega_2
        # 1/(p + alpha) [u] is its own state here: g' = -alpha g + u.
        y = L_0 * (f_i.conjugate() * omega_1).real + abs(omega_1) ** 2 / alpha + f_product
        along = (i.conjugate() * sigma(x_hat)).real
        d_hat = -ell * alpha * (along - f_along)
        d_flux_hat = emf + gamma * phi * (y - (phi.conjugate() * x_hat).real - d_hat)
        d_e, d_i = alpha * (emf - f_e), alpha * (i - f_i)
        return [emf.real, emf.imag, *rest, v.real, v.imag, d_e.real, d_e.imag, d_i.real, d_i.imag,
                (omega_2.conjugate() * omega_1).real - alpha * f_product, alpha * (along - f_along),
                d_flux_hat.real, d_flux_hat.imag]

    begin = plant.start()
    i_0 = plant.drive(0.0, np.array(begin), 0.0)[0]
    f_i = i_0 if clean else 0j
    f_along = (i_0.conjugate() * sigma(gains.initial_flux - L_q * i_0)).real if clean else 0.0
    state = [*begin, 0.0, 0.0, 0.0, 0.0, f_i.real, f_i.imag, 0.0, f_along,
             gains.initial_flux.real, gains.initial_flux.imag]
    instants = np.arange(round(duration * rate) + 1) / rate
    pieces = []
    edges = [0.0, *(t for t in plant.kinks if t < duration), float(instants[-1])]
    for first, last in pairwise(edges):
        inside = instants[(instants >= first - 1e-9) & (instants < last - 1e-9)]
        out = solve_ivp(derivative, (first, last), state, method="DOP853", rtol=1e-10, atol=1e-13,
                        t_eval=np.append(inside, last), args=(first,))
        assert out.success, out.message
        state = out.y[:, -1].tolist()
        pieces.append(out.y[:, :-1])
    s = np.concatenate([*pieces, np.array(state)[:, None]], axis=1)

    def vector(row: int) -> Complexes:
        return np.asarray(s[row] + 1j * s[row + 1])

    flux, theta = vector(0), plant.theta(s[:own])
    i = np.array([current(m, complex(f), float(a)) for f, a in zip(flux, theta, strict=True)])
    omega_1 = vector(own + 2) - L_q * alpha * (i - vector(own + 4))
    return Solution(rate, i, vector(own), theta, flux - L_q * i, vector(own + 8) - L_q * i,
                    2.0 * omega_1 - L_0 * alpha * (i - vector(own + 4)))

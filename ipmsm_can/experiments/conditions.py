"""Conditions C1, C2, C3 of Proposition 2, and Assumption 3 itself, as checks over recorded samples.

Each condition says that a signal u(t) in the plane is persistently exciting (PE): there are T and delta > 0 with

    integral from t to t + T of u u^T ds  >=  delta I      for all t.

Proposition 2: if one of these is, so is Phi, and that is what Assumption 3 asks for (the paper's Section 4 prints
"Assumption 2", which is boundedness).

    C1   u = v - R i - L_s p[i]                                        what the terminals show
    C2   u = p[-(L_0/2) i + (L_0 i^T c(theta) + psi_m) c(theta)]       the same with the rotor's position
    C3   u = p[i], at standstill                                       what an injected current must do
    A3   u = Phi

A record is finite and sampled.  So T is given, every window of that length within the record is judged, and the
level is the smallest eigenvalue over all of them; the condition holds if the level reaches the given delta.

Derivatives.  Nothing is differentiated at a point: the mean of p[i] over an interval is the difference of the
currents at its ends, the mean of v is what a sample carries, and R i is taken by the trapezoid rule.  An integral
of u u^T is never less than that of interval means (Cauchy-Schwarz), so a level found here is one that u itself
has.

One unit.  With theta constant C2's signal is L_0 (c c^T - I/2) p[i], and c c^T - I/2 is half a reflection.  So p[i]
times L_0/2 has exactly the levels of C1 and C2, and C3 is judged like that, in V^2 s as the rest.  The paper
leaves out that L_0 must not be 0: then p[i] may be PE and Phi is 0 all the same; here the level is 0, too.

What the level is worth.  Phi = 2 alpha/(p + alpha)[u]: a part of u at the frequency w has 4 alpha^2/(w^2 + alpha^2)
of its level in Phi, and the observer's error shrinks in T by about exp(-gamma level of Phi) while gamma is small.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ipmsm_can.motor import Motor

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

_NOISE_SIGMAS = 3.0
STANDSTILL = math.radians(1.0)
"""How far a rotor may move in the whole record and still count as standing [rad electrical]."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """Outcome of one check.

    condition: C1, C2, C3 or A3.  applies: False where the condition says nothing (C3 while the rotor turns).
    level: smallest eigenvalue over all windows [V^2 s].  noise: how much of it current noise alone can make
    [V^2 s].  required: the delta asked for [V^2 s].  window [s].
    weakest_at: where the weakest window begins [s after the first sample].
    """

    condition: str
    applies: bool
    level: float
    noise: float
    required: float
    window: float
    weakest_at: float

    @property
    def margin(self) -> float:
        """(level - noise) / required; 1 or more is enough."""
        return (self.level - self.noise) / self.required

    @property
    def holds(self) -> bool:
        """Whether the condition applies and every window has the level required."""
        return self.applies and self.margin >= 1.0

    def __str__(self) -> str:
        if not self.applies:
            return f"{self.condition} does not apply: the rotor turns"
        return (f"{self.condition} {'holds' if self.holds else 'fails'}: weakest {self.window:g} s window at "
                f"{self.weakest_at:.3f} s has {self.level:.3g} V^2 s ({self.noise:.3g} of it may be noise), "
                f"required is {self.required:.3g}")


def check_c1(i: ArrayLike, v: ArrayLike, sample_rate: float, motor: Motor, *, window: float, required: float,
             current_noise: float = 0.0, samples_per_mean: int = 1) -> Verdict:
    """C1: v - R i - L_s p[i] is PE.

    i: current at the samples [A peak], (N, 2) or complex (N,).  v: mean voltage of the interval before each [V
    peak], same shape; the first is not used.  sample_rate [Hz].  window: T [s].  required: delta [V^2 s].
    current_noise [A rms per axis]: differences of samples turn it into a large white u, which is PE by itself
    and means nothing; its share is taken off the level.  samples_per_mean: means over so many intervals, which
    divides that share by its square; the probing period should hold five of them at least.

    Raises ValueError for arrays that do not fit, values that are not finite, and a record shorter than T.
    """
    current = _vectors("i", i)
    voltage = _vectors("v", v, len(current))
    dt, n = _grid(sample_rate, samples_per_mean, window, required, current_noise, len(current))
    emf = voltage[1:] - 0.5 * motor.R * (current[1:] + current[:-1])
    signal = _means(emf, samples_per_mean) - motor.L_s * np.diff(current[::samples_per_mean]) / dt
    variance = (motor.R**2 + 2.0 * (motor.L_s / dt) ** 2) * current_noise**2
    return _judge("C1", signal, dt, n, window, required, variance)


def check_c2(i: ArrayLike, theta: ArrayLike, sample_rate: float, motor: Motor, *, window: float,
             required: float, current_noise: float = 0.0, samples_per_mean: int = 1) -> Verdict:
    """C2: p[-(L_0/2) i + (L_0 i^T c + psi_m) c] is PE.

    theta: rotor angle at the samples [rad electrical], (N,).  With the true angle and the right parameters the
    level is that of C1; with an estimated one the check says no more than the estimate does.  The rest and
    the errors raised: as for `check_c1`.
    """
    current = _vectors("i", i)
    angle = _angles(theta, len(current))
    dt, n = _grid(sample_rate, samples_per_mean, window, required, current_noise, len(current))
    axis = np.exp(1j * angle)
    length = motor.L_0 * (current.conj() * axis).real + motor.psi_m
    inner = length * axis - 0.5 * motor.L_0 * current
    signal = np.diff(inner[::samples_per_mean]) / dt
    return _judge("C2", signal, dt, n, window, required, 0.5 * (motor.L_0 * current_noise / dt) ** 2)


def check_c3(i: ArrayLike, theta: ArrayLike, sample_rate: float, motor: Motor, *, window: float,
             required: float, current_noise: float = 0.0, samples_per_mean: int = 1) -> Verdict:
    """C3: at standstill, p[i] is PE; judged as (L_0/2) p[i], in V^2 s.

    theta: rotor angle at the samples [rad electrical], (N,), to see whether the rotor stands: it must stay
    within STANDSTILL over the whole record, or the condition does not apply.  The rest and the errors raised:
    as for `check_c1`.
    """
    current = _vectors("i", i)
    angle = np.unwrap(_angles(theta, len(current)))
    dt, n = _grid(sample_rate, samples_per_mean, window, required, current_noise, len(current))
    signal = 0.5 * motor.L_0 * np.diff(current[::samples_per_mean]) / dt
    stands = bool(np.ptp(angle) <= STANDSTILL)
    return _judge("C3", signal, dt, n, window, required, 0.5 * (motor.L_0 * current_noise / dt) ** 2, stands)


def check_phi(phi: ArrayLike, sample_rate: float, *, window: float, required: float,
              noise: float = 0.0) -> Verdict:
    """Assumption 3: Phi is PE, with Phi [V] (N, 2) or complex (N,) as `estimate` gives it.

    noise: what current noise s_i [A rms per axis] leaves in Phi, 2 alpha L_s s_i [V rms per axis]; its share is
    taken off the level.  Errors raised: as for `check_c1`.
    """
    signal = _vectors("phi", phi)
    dt, n = _grid(sample_rate, 1, window, required, noise, len(signal) + 1)
    return _judge("A3", signal, dt, n, window, required, noise**2)


def window_levels(signal: Complexes, dt: float, n: int) -> Floats:
    """Smallest eigenvalue of dt * sum of u u^T over every window of n values.

    signal: u as complex (M,), a value for each interval of length dt [s]; 1 <= n <= M.  Returns (M - n + 1,), in
    the unit of u squared times s; good to some 1e-16 of the whole record's integral.
    """
    a, b = signal.real, signal.imag
    sums = np.zeros((3, len(signal) + 1))
    np.cumsum([a * a, a * b, b * b], axis=1, out=sums[:, 1:])
    aa, ab, bb = dt * (sums[:, n:] - sums[:, :-n])
    return np.asarray(np.maximum(0.0, 0.5 * (aa + bb) - np.hypot(0.5 * (aa - bb), ab)))


def _judge(condition: str, signal: Complexes, dt: float, n: int, window: float, required: float,
           variance: float, applies: bool = True) -> Verdict:
    levels = window_levels(signal, dt, n)
    weakest = int(np.argmin(levels))
    # Neighbouring differences share a sample, so the mean square of n of them scatters by sqrt(3/n) of itself.
    noise = variance * n * dt * (1.0 + _NOISE_SIGMAS * math.sqrt(3.0 / n))
    return Verdict(condition, applies, float(levels[weakest]), noise, required, window, weakest * dt)


def _grid(sample_rate: float, samples_per_mean: int, window: float, required: float, noise: float,
          n: int) -> tuple[float, int]:
    """Length of an interval [s] and intervals in a window, for n samples."""
    for name, value, unit in (("sample_rate", sample_rate, "Hz"), ("window", window, "s"),
                              ("required", required, "V^2 s")):
        if not (math.isfinite(value) and value > 0.0):
            raise ValueError(f"{name} is {value!r}; allowed is a finite number above 0, in {unit}")
    if not (math.isfinite(noise) and noise >= 0.0):
        raise ValueError(f"the noise is {noise!r}; allowed is a finite rms value of 0 or more")
    if not (isinstance(samples_per_mean, int) and samples_per_mean >= 1):
        raise ValueError(f"samples_per_mean is {samples_per_mean!r}; allowed is a whole number of 1 or more")
    dt = samples_per_mean / sample_rate
    intervals = round(window / dt)
    if intervals < 2:
        raise ValueError(f"window is {window!r}; allowed is two intervals of {dt:g} s or more")
    if intervals > (n - 1) // samples_per_mean:
        longest = (n - 1) / sample_rate
        raise ValueError(f"window is {window!r}; allowed is at most the record's length, {longest:g} s")
    return dt, intervals


def _means(values: Complexes, size: int) -> Complexes:
    whole = len(values) // size * size
    return np.asarray(values[:whole].reshape(-1, size).mean(axis=1))


def _vectors(name: str, given: ArrayLike, n: int | None = None) -> Complexes:
    """Complex (N,) from (N, 2) or complex (N,)."""
    array = np.asarray(given)
    if array.ndim == 2 and array.shape[1] == 2 and not np.iscomplexobj(array):
        array = array[:, 0] + 1j * array[:, 1]
    if array.ndim != 1 or not np.iscomplexobj(array) or array.shape[0] != (n or array.shape[0]):
        wanted = "N" if n is None else str(n)
        raise ValueError(f"{name} has shape {array.shape}; allowed is ({wanted}, 2) or complex ({wanted},)")
    return _finite(name, array)


def _angles(given: ArrayLike, n: int) -> Floats:
    array = np.asarray(given, dtype=np.float64)
    if array.shape != (n,):
        raise ValueError(f"theta has shape {array.shape}; allowed is ({n},), one angle a sample")
    _finite("theta", array.astype(np.complex128))
    return array


def _finite(name: str, array: NDArray[np.complex128]) -> Complexes:
    wrong = np.flatnonzero(~np.isfinite(array))
    if wrong.size:
        raise ValueError(f"{name}[{wrong[0]}] is {array[wrong[0]]!s}; allowed are finite numbers")
    return array

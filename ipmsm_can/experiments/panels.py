"""The diagrams that several experiments share: angle, angle error, active flux, current, speed."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

from ipmsm_can.drive.profile import RPM
from ipmsm_can.experiments.draw import Curve, Plot, angle_curves, unjoined
from ipmsm_can.experiments.rig import Track

_TIME = "t [s]"


def _cut(track: Track, begin: float, end: float) -> NDArray[np.bool_]:
    return (track.time >= begin) & (track.time <= end)


def _named(tracks: Mapping[str, Track] | Track) -> dict[str, Track]:
    return {"estimate": tracks} if isinstance(tracks, Track) else dict(tracks)


def pick(tracks: Mapping[str, Track], names: Iterable[str]) -> dict[str, Track]:
    """Some of the runs, by name, in that order."""
    return {name: tracks[name] for name in names}


def angle(tracks: Mapping[str, Track] | Track, begin: float, end: float,
          title: str = "Rotor angle and estimate") -> Plot:
    """theta and theta_hat [deg electrical] over a stretch of time [s]; all runs must share one drive."""
    named = _named(tracks)
    first = next(iter(named.values()))
    cut = _cut(first, begin, end)
    curves = angle_curves(first.time[cut], first.truth.theta_e[cut], [(t.theta[cut], n) for n, t in named.items()])
    return Plot(title, _TIME, "angle [° electrical]", curves, (begin, end), (-180.0, 180.0))


def error(tracks: Mapping[str, Track] | Track, begin: float = 0.0, end: float = math.inf,
          limit: float | None = None, title: str = "Error of the angle", most: float | None = None) -> Plot:
    """theta_hat - theta [deg electrical]; limit: margin, drawn on either side; most: half height of the axis."""
    named = _named(tracks)
    curves = []
    for k, (name, t) in enumerate(named.items()):
        inside = (t.reference_time >= begin) & (t.reference_time <= end)
        x, y = unjoined(t.reference_time[inside], t.error[inside])
        curves.append(Curve(x, y, f"c{k}", name if len(named) > 1 else ""))
    last = min(end, max(float(t.time[-1]) for t in named.values()))
    if limit is not None:
        ends = np.array([begin, last])
        curves += [Curve(ends, np.full(2, limit), "limit", "margin"), Curve(ends, np.full(2, -limit), "limit")]
    return Plot(title, _TIME, "error [° electrical]", tuple(curves), (begin, last),
                None if most is None else (-most, most))


def active_flux(track: Track, begin: float, end: float, title: str = "Active flux and estimate") -> Plot:
    """Both components of x and x_hat [Wb]."""
    cut = _cut(track, begin, end)
    t = track.time[cut]
    x = (track.truth.active_flux * np.exp(1j * track.truth.theta_e))[cut]
    hat = track.x[cut]
    curves = (Curve(t, x.real, "truth", "x, α and β"), Curve(t, x.imag, "truth"),
              Curve(t, hat.real, "c0", "estimate, α"), Curve(t, hat.imag, "c1", "estimate, β"))
    return Plot(title, _TIME, "active flux [Wb]", curves, (begin, end))


def current_q(track: Track, title: str = "Torque-producing current") -> Plot:
    """i_q [A peak], which stands for the load as in the paper's figures."""
    curves = (Curve(track.time, track.truth.i_q, "c0"),)
    return Plot(title, _TIME, "i_q [A peak]", curves, (0.0, float(track.time[-1])))


def shaft_speed(track: Track, unit: str = "rpm") -> Plot:
    """Speed of the shaft and its reference."""
    scale = 1.0 / RPM if unit == "rpm" else 1.0
    speed = track.truth.omega_e / track.run.setup.machine.pole_pairs
    curves = (Curve(track.time, scale * track.truth.speed_reference, "truth", "reference"),
              Curve(track.time, scale * speed, "c0", "shaft"))
    return Plot("Speed of the shaft", _TIME, f"speed [{unit} mechanical]", curves, (0.0, float(track.time[-1])))


def plane(values: Mapping[str, NDArray[np.complex128]], title: str, x_label: str, y_label: str,
          truth: str = "", dots: bool = False) -> Plot:
    """Curves in the alpha-beta plane with equal axes; `truth`: the name that is drawn as such; dots: samples."""
    roles = iter(("c0", "c1", "c2", "c3"))
    curves = tuple(Curve(v.real, v.imag, "truth" if name == truth else next(roles), name if len(values) > 1 else "",
                         dots)
                   for name, v in values.items())
    return Plot(title, x_label, y_label, curves, equal=True)


def components(time: NDArray[np.float64], values: NDArray[np.complex128]) -> tuple[Curve, ...]:
    """Both components of a vector over time as curves."""
    return Curve(time, values.real, "c0", "α"), Curve(time, values.imag, "c1", "β")

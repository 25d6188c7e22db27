"""What an experiment is: runs of a drive, observers on them, a claim, what is measured, and how it is judged."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import TYPE_CHECKING

from ipmsm_can.drive.parameters import DriveNodeSettings, DriveParameters
from ipmsm_can.drive.profile import Profile
from ipmsm_can.motor import PRESETS, Motor

if TYPE_CHECKING:
    from ipmsm_can.experiments.draw import Plot
    from ipmsm_can.experiments.rig import Track


@dataclass(frozen=True)
class Probing:
    """The operator's order to inject, carried out by the companion's InjectionCommand frames.

    waveform: rotating or pulsating.  amplitude [V peak].  frequency [Hz].  axis: fixed angle in the stationary
    frame [deg electrical].  begin: time at which the order is given [s].
    """

    amplitude: float
    frequency: float
    waveform: str = "rotating"
    axis: float = 0.0
    begin: float = 0.0


@dataclass(frozen=True)
class Setup:
    """A drive and what it does.

    motor: of the preset's name.  profile: speed and load.  drive, node: its imperfections and its messages.
    probing: the injected signal, None for none.  theta_0: rotor angle at the start [rad electrical].
    against_encoder: whether errors are taken against the encoder's frames, as on a test bench, or against
    the simulated rotor.  seed: of the current noise.
    """

    motor: str
    profile: Profile
    drive: DriveParameters
    node: DriveNodeSettings = field(default_factory=DriveNodeSettings)
    probing: Probing | None = None
    theta_0: float = 0.0
    against_encoder: bool = False
    seed: int = 1
    salient: bool = True

    @property
    def machine(self) -> Motor:
        """The motor's true parameters; with salient = False both inductances are their mean."""
        motor = PRESETS[self.motor]
        return motor if self.salient else replace(motor, L_d=motor.L_s, L_q=motor.L_s)


@dataclass(frozen=True)
class Watcher:
    """An observer and what it is told.

    kind, alpha [1/s] and gamma (None: the configuration's default for the kind).  start: initial flux [Wb, Wb], or
    start_off: degrees electrical by which the initial flux psi_m c(theta) misses the rotor; one of the two.
    scale: factors on the motor parameters the observer is told, by name.
    """

    kind: str = "ges"
    alpha: float | None = 10.0
    gamma: float | None = 50.0
    start: tuple[float, float] | None = None
    start_off: float = 0.0
    scale: tuple[tuple[str, float], ...] = ()


@dataclass(frozen=True)
class Run:
    """One observer on one drive; name: how the page calls it."""

    name: str
    setup: Setup
    watcher: Watcher


class Status(Enum):
    """How an experiment ended."""

    REPRODUCED = "reproduced"
    CONDITION = "reproduced with a condition"
    NOT = "not reproduced"


@dataclass(frozen=True)
class Verdict:
    """status, and why: one or two sentences that name the figures it rests on."""

    status: Status
    why: str


@dataclass(frozen=True)
class Figure:
    """A measured number; margin: what noise, quantisation or dead time of that run can make of it, if any."""

    name: str
    value: float
    unit: str
    margin: float | None = None


Tracks = Mapping[str, "Track"]
"""What the runs gave, by the run's name."""
Figures = Mapping[str, Figure]


@dataclass(frozen=True)
class Experiment:
    """An experiment of the paper, or one that settles a question the paper leaves open.

    name: for --only.  figure: of the paper ("Fig. 2"), or "" for a finding of this project.  title: what one
    sees.  claim: the paper's claim in one sentence.  setting: what was chosen here because the paper does not say.
    runs.  measure: figures from the runs.  judge: verdict from the figures alone.  plots: what to draw.
    """

    name: str
    figure: str
    title: str
    claim: str
    setting: str
    runs: tuple[Run, ...]
    measure: Callable[[Tracks], list[Figure]]
    judge: Callable[[Figures], Verdict]
    plots: Callable[[Tracks], list[Plot]]

    def __post_init__(self) -> None:
        names = [run.name for run in self.runs]
        if len(set(names)) < len(names):
            raise ValueError(f"experiment {self.name} has runs {names}; allowed are different names")

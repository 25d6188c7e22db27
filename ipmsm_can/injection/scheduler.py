"""When to probe, how strong, and why: the state machine behind every InjectionCommand.

Injection starts at low speed or on poor excitation and ends at speed, with hysteresis; or the estimate's own sigma
says when, and how much (`by_sigma`).  The amplitude ramps up and down and is cut back in proportion where the
measured high-frequency current exceeds its limit.  The scheduler has no clock: it is asked once per command period,
with the time of the samples; while it `rests` it need not be asked.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from ipmsm_can.injection.by_sigma import SigmaRule
from ipmsm_can.wire.protocol import InjectionReason, InjectionState, Waveform

OFF_REPEATS = 3
"""How often "off" is said after injection ended, so that one lost frame does not matter."""
SETTLING = 0.06
"""How long after polarity pulses the measured current is not that of the waveform [s]."""
ASTRAY = math.radians(20.0)
"""1-sigma [rad electrical] beyond which the d-axis is not known well enough to probe along it."""
_PATIENCE = 0.1
"""How long the angle may be valid no more before another waveform is tried, which begins from nothing [s]."""
_ROOM = 0.6
_RECOVERY = 0.1
"""Share of the way back to full amplitude per second once the current is below its limit again."""


@dataclass(frozen=True, slots=True)
class InjectionSettings:
    """Settings of the scheduler; the defaults live in the configuration model.

    waveform; amplitude [V peak]; frequency [Hz]; speed_on, speed_off [rad/s electrical]; excitation_on,
    excitation_off [V^2 s], both 0 = not used; ramp [V/s]; current_limit [A peak]; time_to_live, period [s];
    axis: fixed angle [rad electrical] in the stationary frame, None: along the estimated d-axis.
    sigma_target: 1-sigma [rad electrical] that the amplitude is to keep the angle below, 0 = always the whole
    amplitude; emf_speed [rad/s electrical]: where the back-EMF alone should do that, 0 = the speeds above say when
    to inject; floor: least amplitude [V peak].  along_d: pulsating along the d-axis while the angle is valid.
    """

    enabled: bool
    waveform: Waveform
    amplitude: float
    frequency: float
    speed_on: float
    speed_off: float
    excitation_on: float
    excitation_off: float
    ramp: float
    current_limit: float
    time_to_live: float
    period: float
    axis: float | None = None
    sigma_target: float = 0.0
    emf_speed: float = 0.0
    floor: float = 0.0
    along_d: bool = False


@dataclass(frozen=True, slots=True)
class Command:
    """One InjectionCommand: amplitude [V peak], frequency [Hz], axis_angle [rad electrical], time_to_live [s]."""

    waveform: Waveform
    amplitude: float
    frequency: float
    axis_angle: float
    time_to_live: float


class InjectionScheduler:
    """State, reason and command of one drive's injection.

    state, reason: as in CompanionStatus; the reason is why the state was last entered.
    """

    def __init__(self, settings: InjectionSettings, transmit: bool) -> None:
        self.use(settings)
        self.amplitude = 0.0
        self._wanted = False
        self._share = 1.0
        self._along, self._along_below, self._unsure = False, math.pi, 0.0
        self._off_left = 0
        self._settling = 0.0
        self._operator: bool | None = None
        self.state = InjectionState.OFF
        self.reason = InjectionReason.NONE
        if not settings.enabled:
            self._enter(InjectionState.DISABLED, InjectionReason.DISABLED_BY_CONFIGURATION)
        elif not transmit:
            self._enter(InjectionState.DISABLED, InjectionReason.TRANSMIT_NOT_ENABLED)

    def use(self, settings: InjectionSettings) -> None:
        """Go on with other settings: the sample rate has become known."""
        self.settings = settings
        self._rule = SigmaRule(settings.sigma_target, settings.emf_speed, settings.floor / settings.amplitude)

    def _enter(self, state: InjectionState, reason: InjectionReason) -> None:
        self.state = state
        self.reason = reason

    def operator(self, wanted: bool | None) -> None:
        """The operator's word: True on, False off, None back to automatic."""
        self._operator = wanted

    @property
    def rests(self) -> bool:
        """Whether it has no command to give, and none to prepare, as long as the drive stays `calm`."""
        if self.state is InjectionState.DISABLED:
            return True
        return (self.state is InjectionState.OFF and not self._wanted and self._off_left == 0
                and self._operator is not True)

    @property
    def calm(self) -> tuple[float, float, float]:
        """Speed [rad/s electrical] below which a resting scheduler must be asked again if sigma is above the third
        [rad electrical], and excitation [V^2 s] below which it must be in any case."""
        s = self.settings
        if self.state is InjectionState.DISABLED or self._operator is not None:
            return 0.0, 0.0, 0.0
        if self._rule.decides:
            speed, sigma = self._rule.calm
            return speed, 0.0, sigma
        return s.speed_on, s.excitation_on, -1.0

    def update(self, elapsed: float, omega: float, excitation: float, theta: float, current: float,
               fresh: bool, running: bool = True, pulses: Command | None = None,
               unknowable: bool = False, sigma: float = math.pi, valid: bool = False,
               locked: bool = True) -> Command | None:
        """Decide for the next period; returns the command to send, None for silence.

        elapsed: time since the last call [s].  omega [rad/s electrical], excitation [V^2 s], theta [rad
        electrical] of the estimate.  current: measured high-frequency current [A peak].  fresh: samples
        are coming in.  running: the inverter applies the voltage it reports, as far as is known.
        pulses: polarity pulses, asked for instead of the waveform where that may be injected.  unknowable: the
        polarity was asked for in vain.  sigma: 1-sigma of the angle [rad electrical], pi = unknown, or still to be
        found by the start-up.  valid: the angle is.  locked: the observer is; before, omega says nothing.
        """
        s = self.settings
        if self.state is InjectionState.DISABLED:
            return None
        reason = self._decide(abs(omega), excitation, fresh, running, sigma, elapsed, locked)
        if pulses is not None and self._wanted:
            self._off_left = OFF_REPEATS
            self._settling = SETTLING
            self._enter(InjectionState.POLARITY_PULSES, InjectionReason.POLARITY_UNKNOWN)
            return pulses
        if unknowable and reason is InjectionReason.LOW_SPEED:
            reason = InjectionReason.POLARITY_UNKNOWABLE
        if self._settling > 0.0:
            self._settling -= elapsed
            current = 0.0  # what is measured now may still be the pulses'
        allowed = self._limit(current, elapsed)
        # Whoever asks for it gets what is configured, neither less nor another waveform.
        asked = self._operator is True
        needed = 1.0 if asked else self._rule.share(sigma, elapsed, allowed < 1.0)
        target = s.amplitude * min(allowed, needed) if self._wanted else 0.0
        step = s.ramp * elapsed
        before = self.amplitude
        if not (fresh and running):
            self.amplitude = 0.0
        elif self.amplitude < target:
            self.amplitude = min(target, self.amplitude + step)
        else:
            self.amplitude = max(target, self.amplitude - step)
        self._follow(before, target, reason)
        if self.amplitude > 0.0:
            self._off_left = OFF_REPEATS
            axis = theta if s.axis is None else s.axis
            self._unsure = 0.0 if valid else self._unsure + elapsed
            if self._along and (sigma > ASTRAY or self._unsure > _PATIENCE):
                # Rotating shows the axis somewhat better; back only where there is room, or it would go to and fro.
                self._along, self._along_below = False, _ROOM * min(sigma, ASTRAY)
            # What pulses have just shown is known, though it takes a moment until it is valid: another waveform in
            # between would begin from nothing, twice.
            sure = (valid or self._settling > 0.0) and sigma < self._along_below
            self._along = s.along_d and not asked and (self._along or sure)
            waveform = Waveform.PULSATING if self._along else s.waveform
            return Command(waveform, self.amplitude, s.frequency, axis, s.time_to_live)
        if self._off_left > 0:
            self._off_left -= 1
            return Command(Waveform.OFF, 0.0, s.frequency, 0.0, s.time_to_live)
        return None

    def _decide(self, speed: float, excitation: float, fresh: bool, running: bool,
                sigma: float, elapsed: float, locked: bool) -> InjectionReason:
        s = self.settings
        by_excitation = s.excitation_off > 0.0
        if not fresh:
            self._wanted = False
            return InjectionReason.NO_SAMPLES
        if not running:
            self._wanted = False
            return InjectionReason.DRIVE_NOT_RUNNING
        if self._operator is not None:
            self._wanted = self._operator
            return InjectionReason.OPERATOR
        if self._rule.decides:
            before, self._wanted = self._wanted, self._rule.is_wanted(self._wanted, speed, sigma, elapsed)
            if self._wanted == before:
                return self.reason
            return InjectionReason.LOW_SPEED if self._wanted else InjectionReason.SPEED_HIGH_ENOUGH
        if not self._wanted:
            if speed < s.speed_on:
                self._wanted = True
                return InjectionReason.LOW_SPEED
            if by_excitation and excitation < s.excitation_on:
                self._wanted = True
                return InjectionReason.POOR_EXCITATION
        elif locked and speed > s.speed_off and not (by_excitation and excitation < s.excitation_off):
            self._wanted = False
            return InjectionReason.SPEED_HIGH_ENOUGH
        return self.reason

    def _limit(self, current: float, elapsed: float) -> float:
        """Share of the amplitude that the current limit leaves, 0..1."""
        limit = self.settings.current_limit
        if not math.isfinite(current):
            self._share = 0.0  # nobody knows how much it is: no injection until it can be measured again
        elif current > limit and self.amplitude > 0.0:
            # In proportion, from what is injected now: the machine is linear in the small.
            self._share = min(self._share, self.amplitude / self.settings.amplitude * limit / current)
        elif current < 0.9 * limit:
            self._share = min(1.0, self._share + _RECOVERY * elapsed)
        return self._share

    def _follow(self, before: float, target: float, reason: InjectionReason) -> None:
        """Name the state that the amplitude is in now."""
        if not self._wanted:
            state = InjectionState.RAMP_DOWN if self.amplitude > 0.0 else InjectionState.OFF
        elif self._share < 1.0 and self.amplitude >= target:
            state, reason = InjectionState.LIMITED, InjectionReason.CURRENT_LIMIT
        elif self.amplitude < target:
            state = InjectionState.RAMP_UP
        else:
            state = InjectionState.ON
        if state is not InjectionState.LIMITED and reason in (InjectionReason.CURRENT_LIMIT,
                                                              InjectionReason.POLARITY_UNKNOWN):
            reason = InjectionReason.LOW_SPEED
        self._enter(state, reason)

"""How much probing the angle needs: on, off and the share of the amplitude, from the estimate's own 1-sigma.

Amplitude.  Torque ripple grows with the amplitude, loss with its square; so the least that keeps sigma below the
target is wanted.  Above RAISE of the target the share rises, below LOWER it falls, four times as slowly as it
rises and more slowly than the covariance follows; between it rests.  Beyond DOUBTFUL of the target it is whole at
once.

Off.  A back-EMF of |omega| psi_m turns the angle that rotation gives by e/(|omega| psi_m), e being what the voltage
is wrong by; `emf_speed` is where that reaches the target.  Above it injection ends.  Where the whole amplitude has
not brought sigma below the target for FRUITLESS, ending it is tried from half of that speed on: injection also
brings the inductances' uncertainty into the filter, and can do harm.  At OUT_OF_REACH of that speed and above there
is no injection: nothing that it adds could be seen beside the back-EMF.

On again.  When sigma comes near the target (RAISE).  That happened at some speed; up to AGAIN times that, the
back-EMF is not trusted to suffice again until the rotor has been beyond OUT_OF_REACH.  So each failure moves the
speed at which injection ends, and it cannot go on and off for ever.
"""

from __future__ import annotations

import math

RAISE = 0.9
LOWER = 0.75
DOUBTFUL = 2.0
FRUITLESS = 1.0
"""[s]"""
OUT_OF_REACH = 4.0
AGAIN = 1.25
DWELL = 0.1
"""How long the speed must be enough [s]: what corrects the angle at standstill shows as speed for a moment."""
RISE_TIME = 0.5
"""From nothing to the whole amplitude [s]."""
FALL_TIME = 4.0 * RISE_TIME
_SMOOTHING = 0.05
"""Time constant [s] of the sigma that the amplitude follows."""
_TRY_FROM = 0.5


class SigmaRule:
    """State of the rule.

    target [rad electrical]; emf_speed [rad/s electrical], 0: something else says when to inject; floor: least
    share of the amplitude, 0..1.
    """

    def __init__(self, target: float, emf_speed: float, floor: float) -> None:
        self.target = target
        self.emf_speed = emf_speed
        self.floor = floor
        self.level = 1.0
        self._smooth = math.pi
        self._failed = 0.0
        self._fruitless = 0.0
        self._enough = 0.0

    @property
    def decides(self) -> bool:
        """Whether it says when to inject, not only how much."""
        return self.target > 0.0 and self.emf_speed > 0.0

    @property
    def calm(self) -> tuple[float, float]:
        """Injection may begin below this speed [rad/s electrical], once sigma is above this [rad electrical]."""
        return OUT_OF_REACH * self.emf_speed, RAISE * self.target

    def is_wanted(self, before: bool, speed: float, sigma: float, elapsed: float) -> bool:
        """Whether to inject; before: whether it was wanted; speed: |omega| [rad/s electrical]; sigma [rad
        electrical]; elapsed: since the last call [s]."""
        within, wake = self.calm
        if not before:
            if speed >= within or sigma <= wake:
                return False
            # What is not known at all says nothing about the back-EMF.
            self._failed = max(self._failed, speed if sigma < math.pi else 0.0)
            self.level, self._smooth, self._fruitless, self._enough = 1.0, math.pi, 0.0, 0.0
            return True
        needed = (_TRY_FROM if self._fruitless >= FRUITLESS else 1.0) * self.emf_speed
        enough = speed > max(needed, AGAIN * self._failed) and sigma < DOUBTFUL * self.target
        self._enough = self._enough + elapsed if enough or speed >= within else 0.0
        if self._enough < DWELL:
            return True
        if speed >= within:
            self._failed = 0.0
        return False

    def share(self, sigma: float, elapsed: float, limited: bool) -> float:
        """Share of the amplitude, 0..1.

        sigma: of the angle [rad electrical], pi = unknown; elapsed: since the last call [s]; limited: something
        else holds the amplitude down.
        """
        if not self.target > 0.0:
            return 1.0
        if sigma > DOUBTFUL * self.target:
            self.level, self._smooth = 1.0, sigma
        else:
            self._smooth += (1.0 - math.exp(-elapsed / _SMOOTHING)) * (min(sigma, self._smooth + self.target)
                                                                       - self._smooth)
            if self._smooth > RAISE * self.target:
                self.level = min(1.0, self.level + elapsed / RISE_TIME)
            elif self._smooth < LOWER * self.target:
                self.level = max(self.floor, self.level - elapsed / FALL_TIME)
        in_vain = (self.level >= 1.0 or limited) and self._smooth > self.target and sigma < math.pi
        self._fruitless = self._fruitless + elapsed if in_vain else 0.0
        return self.level

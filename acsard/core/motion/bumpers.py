"""Monitors the bumpers that the board reports, and decides which motion they allow.

A press sets the command to zero without a ramp. With `safety.bumper = "stop"` it latches a stop.
With "away" each sender must send a zero, and until the release the robot drives only straight away,
at `AWAY_SPEED`: in a turn, a corner could sweep into the obstacle, and no motion leads away from a
side. A board that stops reporting them latches a stop in both cases. Bumpers are no safety
function, because the status line may be lost or late.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

from acsard.core.codes import Reason, reason, sentence
from acsard.core.config.settings import EstopUse, Place, SafetyConfig
from acsard.core.formatting import many
from acsard.core.link.board_status import BoardStatus
from acsard.core.motion.emergency_stop import SILENCE_TIMEOUT_S, TRANSITIONS, BoardInput, Sign
from acsard.core.values import REST, EstopState, EventName, Twist

AWAY_SPEED = 0.1  # m/s

# Sign of the speed away from a bumper; 0 if no straight motion leads away.
DIRECTIONS: dict[Place, int] = {"front": -1, "rear": 1, "left": 0, "right": 0}

ALLOWED = {-1: "backwards", 1: "forwards"}

SILENT_REASON = reason("bumpers_silent", seconds=SILENCE_TIMEOUT_S)


def missing_reason(safety: SafetyConfig) -> Reason:
    count = len(safety.bumpers)
    places, bumpers = many(count, "place"), many(count, "bumper")
    return sentence("bumpers_missing", places=places, bumpers=bumpers, dots="." * count)


def pressed_words(places: Sequence[Place], pressed: Sequence[bool]) -> str:
    """Return a text that names the pressed bumpers by place, or by number from 1 without places."""
    numbers = [i for i, on in enumerate(pressed) if on]
    if not places:
        joined = " and ".join(str(i + 1) for i in numbers)
        return f"bumper{'s' * (len(numbers) > 1)} {joined} pressed"
    named = dict.fromkeys(places[i] for i in numbers)
    return f"{' and '.join(named)} bumper{'s' * (len(named) > 1)} pressed"


class Bumpers(BoardInput):
    """The state of all bumpers, and the motion that they allow."""

    # In contrast to `TRANSITIONS`, silence changes the state even while a bumper is pressed,
    # because a silent board cannot report the press of another bumper.
    table: ClassVar[dict[tuple[EstopState, Sign], EstopState]] = TRANSITIONS | {
        ("pressed", "silence"): "silent"
    }
    silent: ClassVar[Reason] = SILENT_REASON
    events: ClassVar[tuple[EventName, EventName]] = ("bumper_pressed", "bumper_released")

    count: int = 0  # in the last status line that reported bumpers

    def limiting(self, safety: SafetyConfig) -> bool:
        """Return whether a pressed bumper limits the motion now and does not latch a stop."""
        return self.state == "pressed" and _drives_away(safety)

    def latching(self, safety: SafetyConfig) -> bool:
        """Return whether a pressed bumper latches a stop; with "away", only a silent one."""
        return self.state == "silent" or not _drives_away(safety)

    def clear_refusal(self, safety: SafetyConfig) -> Reason | None:
        """Return why `clear` must not release a stop now; None if the bumpers allow it."""
        return self.why(safety) if self.latching(safety) else None

    def away(self, twist: Twist, safety: SafetyConfig) -> Twist | None:
        """Return the allowed part of `twist` (rest, or straight away at `AWAY_SPEED`), or None."""
        if twist == REST:
            return REST
        direction = self._direction(safety)
        speed = twist.linear * direction
        return Twist(direction * min(speed, AWAY_SPEED)) if speed > 0.0 else None

    def limit(self, safety: SafetyConfig) -> Reason:
        """Return a reason that names the pressed bumpers, with the allowed motion as the advice."""
        bumpers = self.pressed_reason(safety).text
        allowed = ALLOWED.get(self._direction(safety))
        if allowed is None:
            return reason("bumper_blocks", bumpers=bumpers)
        return reason("bumper_away", bumpers=bumpers, direction=allowed, speed=AWAY_SPEED)

    def use(self, safety: SafetyConfig) -> EstopUse:
        if safety.bumper == "off":
            return "off"
        return "required" if safety.bumpers else "auto"

    def read(self, status: BoardStatus, safety: SafetyConfig) -> tuple[bool, ...] | None:
        # A line with an unexpected number of bumpers may lack a pressed one, so it is not used.
        # Expected are the places, or else the last number; a press counts with any number then.
        bumpers = status.bumpers
        if bumpers is None:
            return None
        expected = len(safety.bumpers) or self.count
        self.count = len(bumpers)
        if len(bumpers) == expected or (any(bumpers) and not safety.bumpers):
            return bumpers
        return None

    def pressed_reason(self, safety: SafetyConfig) -> Reason:
        words = pressed_words(safety.bumpers, self.pressed or ())
        return reason("bumper", words, bumpers=words)

    def advice(self, why: Reason, safety: SafetyConfig) -> str:
        if self.limiting(safety):
            return self.limit(safety).advice
        return super().advice(why, safety)

    def released(self, before: EstopState, safety: SafetyConfig) -> str:
        if not before:
            count = len(self.pressed or ())
            return f"the board reports {many(count, 'bumper')}, and none is pressed"
        if before == "pressed" and _drives_away(safety):
            return "the bumpers are released and allow every direction again"
        return "the bumpers are released; a latched stop lasts until `acsard call clear`"

    def _direction(self, safety: SafetyConfig) -> int:
        pressed = zip(safety.bumpers, self.pressed or (), strict=True)
        signs = {DIRECTIONS[place] for place, on in pressed if on}
        return signs.pop() if len(signs) == 1 else 0


def _drives_away(safety: SafetyConfig) -> bool:
    return safety.bumper == "away" and len(safety.bumpers) > 0

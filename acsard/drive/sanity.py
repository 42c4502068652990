"""Can this feedback be true, and do the wheels do what they are told?

Two questions to every feedback line. `impossible`: no wheel turns that fast or changes that
quickly; such a line is not folded, and several in a row are a fault. `watch`: over half a second
the wheels' feedback contradicts what they were sent; the fault names the wheel.

What a healthy wheel does is modelled as a first-order lag behind its command. Between the model
and the feedback there is room for load, slip and coarse encoders: only what no healthy wheel does
counts as evidence, and evidence must last.
"""

from __future__ import annotations

from acsard.config.settings import FeedbackConfig
from acsard.mcu.feedback import Feedback
from acsard.values import WHEELS, WheelSpeeds

REPEATED = 3
"""Impossible lines in a row that make a fault: 30 ms at 100 Hz."""

SLACK = 2.0
"""rad/s; below this coarse encoders and a robot pushed by hand look like anything."""


class _Wheel:
    """What one wheel should be doing, and for how long it has not."""

    def __init__(self) -> None:
        self.expected = 0.0
        self.seen = 0.0
        self.evidence = dict.fromkeys(_FAULTS, 0.0)


_FAULTS = {
    "dead": "does not turn, or its encoder is dead: look at cable, motor and encoder",
    "reversed": "turns against its command: look at the motor's leads and its sign in mcu.wheels",
    "runaway": "turns faster than commanded: the motor driver or its encoder is at fault",
    "stuck": "reports one and the same speed: its encoder is stuck",
}


class Sanity:
    """Judges feedback line by line; remembers the last possible one and each wheel's evidence."""

    def __init__(self, feedback: FeedbackConfig) -> None:
        self._settings = feedback
        self._last: WheelSpeeds | None = None
        self._since = 0.0
        self._impossible = 0
        self._wheels = tuple(_Wheel() for _ in WHEELS)

    def forget(self) -> None:
        """Start over: the link was gone, or a fault has been cleared."""
        self._last, self._since, self._impossible = None, 0.0, 0
        self._wheels = tuple(_Wheel() for _ in WHEELS)

    @property
    def doubtful(self) -> bool:
        """So many impossible lines in a row that the feedback cannot be trusted."""
        return self._impossible >= REPEATED

    def impossible(self, feedback: Feedback) -> str:
        """Why no robot can have sent this line, "" when one can.

        A slew is judged against the last possible line and the time since, so that a real step
        is believed as soon as it could have happened.
        """
        self._since += feedback.dt
        if feedback.gap:
            self._last = None
        why = self._objection(feedback.speeds)
        if why:
            self._impossible += 1
            return why
        self._last, self._since, self._impossible = feedback.speeds, 0.0, 0
        return ""

    def _objection(self, speeds: WheelSpeeds) -> str:
        settings = self._settings
        before = speeds if self._last is None else self._last
        most = settings.wheel_acceleration * self._since + SLACK
        for name, now, then in zip(WHEELS, speeds.as_tuple(), before.as_tuple(), strict=True):
            if abs(now) > settings.wheel_speed:
                return f"{name} {now:.2f} rad/s is over feedback.wheel_speed"
            if abs(now - then) > most:
                return f"{name} from {then:.2f} to {now:.2f} rad/s is over its acceleration"
        return ""

    def watch(self, sent: WheelSpeeds, seen: WheelSpeeds, dt: float) -> str:
        """The fault that `dt` s more of this make, naming the wheel; "" while all is well.

        `sent` is what the wheels are told, `seen` what they report, rad/s.
        """
        settings = self._settings
        if not settings.fault_time:
            return ""
        share = dt / (settings.response_time + dt) if dt else 0.0
        rows = zip(WHEELS, self._wheels, sent.as_tuple(), seen.as_tuple(), strict=True)
        for name, wheel, told, speed in rows:
            wheel.expected += (told - wheel.expected) * share
            signs = _signs(wheel.expected, told, speed, constant=speed == wheel.seen)
            wheel.seen = speed
            for kind, bad in zip(_FAULTS, signs, strict=True):
                lasted = wheel.evidence[kind] + dt if bad else 0.0
                wheel.evidence[kind] = lasted
                if lasted > settings.fault_time:
                    return f"{name} wheel {_FAULTS[kind]} (told {told:.1f}, saw {speed:.1f} rad/s)"
        return ""


def _signs(
    expected: float, told: float, speed: float, *, constant: bool
) -> tuple[bool, bool, bool, bool]:
    """Whether this looks dead, reversed, running away, stuck: in the order of `_FAULTS`."""
    size, most = abs(expected), max(abs(expected), abs(told))
    moving = size > SLACK and expected * told > 0
    return (
        moving and abs(speed) < 0.1 * size,
        moving and speed * expected < 0 and abs(speed) > 0.3 * size,
        abs(speed) > 1.5 * most + SLACK,
        constant and speed != 0.0 and abs(speed - expected) > SLACK + 0.3 * most,
    )

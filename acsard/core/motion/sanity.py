"""Checks whether feedback is possible and whether the wheels obey their commands.

Each feedback line is checked twice. `impossible` rejects a line that shows a wheel turning or
changing faster than any wheel can; the line is not used, and several in a row are a fault. More
than one in a hundred cause a warning: either the wire is bad or the bound is, and true lines are
lost. `watch` compares the feedback with the commands over half a second and reports a fault of a
named wheel.

The model of a healthy wheel is a first-order lag behind its command. The bounds around it leave
room for load, slip and coarse encoders. Only behaviour that no healthy wheel shows is evidence, and
evidence must last.

A wheel that keeps turning when it should stand is a runaway, unless it is slowing down. If it has
been at rest since, something else than its command turns it: a hand, or a slope. That is reported
but is never a fault, because a fault could only send the zero that is being sent anyway.
"""

from __future__ import annotations

import math
from operator import sub

from acsard.core.config.motion_rules import LINES_OF_EVIDENCE
from acsard.core.config.settings import FeedbackConfig
from acsard.core.link.feedback import Feedback
from acsard.core.values import WHEELS, Event, WheelSpeeds

REPEATED = 3
"""Impossible lines in a row that make a fault: 30 ms at 100 Hz."""

WINDOW = 1000
"""Lines in which the impossible ones are counted: 10 s at 100 Hz."""

SHARE = 0.01
"""Share of a window's lines that causes a warning if they are impossible, once per window."""

SLACK = 2.0
"""rad/s. Below this, coarse encoders and a robot at rest look like any fault."""

STEPS = 2
"""Counts by which two reports may differ besides the wheel's motion: each may be off by one."""

SHORTEST_S = 0.004
"""Time between two lines of a host that catches up after a stall, s. One count in it is a high
speed."""

LEAST = 0.005
"""rad/s. A line reports a smaller speed as zero."""

ROLLED_S = 0.2
"""Seconds that wheels must turn by hand before it is reported. A robot that rocks to rest is
not."""

TOLD_AGAIN_S = 1.0
"""Least time between two reports of a push, s."""


_FAULTS = {
    "dead": "does not turn, or its encoder is dead: check cable, motor and encoder, and for "
    "motor d also mcu.trailing_comma",
    "reversed": "turns against its command: check the motor's leads, the A and B lines of its "
    "encoder, and its sign in mcu.wheels",
    "runaway": "turns faster than commanded: the motor driver or its encoder is at fault",
    "stuck": "reports one and the same speed: its encoder is stuck",
}


class _Wheel:
    """The expected motion of one wheel, and how long it has deviated."""

    def __init__(self) -> None:
        self.driven = False
        """Whether the wheel turned on command and has not come to rest since the command ended."""
        self.forget()

    def forget(self) -> None:
        """Start over. A wheel that has not come to rest yet still must."""
        self.expected = 0.0
        self.seen = 0.0
        self.evidence = dict.fromkeys(_FAULTS, 0.0)
        self.suspected = False
        """Whether there is evidence of any kind."""
        # Infinity lets the first line count as slowing down. With 0, a wheel that was already too
        # fast would never count as slowing down: slow motors latched "runaway" that way.
        self.slowest = math.inf
        """Slowest speed since the wheel became too fast, rad/s."""
        self._fast = False
        """Whether the last line showed the wheel too fast."""

    def signs(self, told: float, speed: float, share: float, still: bool) -> tuple[bool, ...]:
        """Return whether the wheel shows each of the `_FAULTS`, in their order.

        `share` is the part of the way to its command that it should have covered in this line.
        `still` means that all wheels should stand.
        """
        expected = self.expected = self.expected + (told - self.expected) * share
        size, turns = abs(expected), abs(speed)
        driven = self.driven = not still or (self.driven and turns > SLACK)
        constant, self.seen = speed == self.seen, speed
        most = max(size, abs(told))
        fast = driven and turns > 1.5 * most + SLACK
        slowing = turns < self.slowest - SLACK
        if slowing or not fast:
            self.slowest = turns
        elif not self._fast:
            self.slowest = max(self.slowest, turns)
        self._fast = fast
        moving = size > SLACK and expected * told > 0
        # A wheel that slows down to its command sooner than `response_time` says is not dead.
        least = min(size, abs(told))
        constant = constant and driven and speed != 0.0
        return (
            moving and least > SLACK and turns < 0.1 * least,
            moving and speed * expected < 0 and turns > 0.3 * size,
            fast and not slowing,
            constant and min(abs(speed - expected), abs(speed - told)) > SLACK + 0.3 * most,
        )


class Sanity:
    """The judgement of feedback, line by line.

    It remembers the last possible line and the evidence against each wheel.
    """

    def __init__(self, feedback: FeedbackConfig) -> None:
        self._settings = feedback
        self._last: WheelSpeeds | None = None
        self._since = 0.0
        self._impossible = 0
        self._lines = self._dropped = 0
        """Lines of the present window, and the impossible ones among them."""
        self.warning: Event | None = None
        """The warning of the last line about too many impossible ones, if it was due."""
        self._wheels = tuple(_Wheel() for _ in WHEELS)
        self._rolled = 0.0
        self._untold = TOLD_AGAIN_S
        self.turned = ""
        """The message of the last `watch` about wheels turned by hand, or ""."""

    def forget(self) -> None:
        """Start over, because the link was lost or a fault has been cleared."""
        self._last, self._since, self._impossible = None, 0.0, 0
        for wheel in self._wheels:
            wheel.forget()

    @property
    def doubtful(self) -> bool:
        """Whether so many impossible lines came in a row that the feedback cannot be trusted."""
        return self._impossible >= REPEATED

    def impossible(self, feedback: Feedback) -> str:
        """Return why no robot can have sent this line, "" if one can.

        A change of speed is judged against the last possible line and the time since, so a real
        step is believed as soon as it could have happened.
        """
        self._since += max(feedback.dt, feedback.since)
        if feedback.gap:
            self._last = None
        why = self._objection(feedback)
        self._count(why)
        if why:
            self._impossible += 1
            return why
        self._last, self._since, self._impossible = feedback.speeds, 0.0, 0
        return ""

    def _count(self, why: str) -> None:
        """Count a line in the window, with the reason if it is impossible; make a due warning."""
        self._lines += 1
        self.warning = None
        if why:
            self._dropped += 1
            if self._dropped == int(SHARE * WINDOW) + 1:
                self.warning = Event("lines_implausible", self._words(why), "warning")
        if self._lines == WINDOW:
            self._lines = self._dropped = 0

    def _words(self, why: str) -> str:
        return (
            f"{self._dropped} of {self._lines} lines were dropped, because no wheel can do "
            f"what they report; the last: {why}. If a wheel really does that, raise the setting. "
            "Otherwise lines arrive damaged: check cable and ground; firmware that supports "
            'mcu.link_check = "auto" protects each line with a checksum'
        )

    def _objection(self, line: Feedback) -> str:
        speeds, fastest = line.speeds, self._settings.wheel_speed
        before = speeds if self._last is None else self._last
        most = self._settings.wheel_acceleration * self._since + SLACK
        wheels, then_wheels = speeds.as_tuple(), before.as_tuple()
        changes = map(abs, map(sub, wheels, then_wheels))
        if max(map(abs, wheels)) <= fastest and max(changes) <= most:
            return ""  # possible for any encoder steps, as nearly every line is
        turned = line.counted if line.turned is None else line.turned
        rows = zip(WHEELS, wheels, then_wheels, line.steps, turned or wheels, strict=True)
        for name, now, then, step, angle in rows:
            size, change = abs(now), abs(now - then)
            # Unless the steps are proven counts they allow no excess speed: a faulty encoder may
            # show any steps.
            room = 0.0
            if line.count and turned is not None:
                # Of n counts in a short time, n - 1 certainly lie in it.
                room = size * min(1.0, line.count / abs(angle)) if angle else size
                step = max(step, line.count / SHORTEST_S)
            elif turned is not None and step < math.inf:
                room = step
            if size > fastest + room:
                return f"{name} {now:.2f} rad/s is over feedback.wheel_speed"
            if change > most + STEPS * step:
                leap = f"{name} from {then:.2f} to {now:.2f} rad/s"
                return f"{leap} is over feedback.wheel_acceleration"
        return ""

    def watch(self, sent: WheelSpeeds, seen: WheelSpeeds, dt: float) -> str:
        """Add `dt` s with these speeds; return the fault that they prove, naming the wheel, or "".

        `sent` is the commanded speeds and `seen` the reported ones, rad/s.
        """
        limit, response = self._settings.fault_time, self._settings.response_time
        # After a stall of the host, one line stands for the whole stall and must prove no fault.
        most = limit / LINES_OF_EVIDENCE
        share = dt / (response + dt) if dt else 0.0
        still = max(map(abs, sent.as_tuple())) < LEAST
        self._notice(seen, dt, still)
        rows = zip(WHEELS, self._wheels, sent.as_tuple(), seen.as_tuple(), strict=True)
        for name, wheel, told, speed in rows:
            signs = wheel.signs(told, speed, share, still)
            if not (True in signs or wheel.suspected):
                continue
            wheel.suspected = True in signs
            for kind, bad in zip(_FAULTS, signs, strict=True):
                lasted = wheel.evidence[kind] + min(dt, most) if bad else 0.0
                wheel.evidence[kind] = lasted
                if limit and lasted > limit:
                    return (
                        f"{name} wheel {_FAULTS[kind]} (commanded {told:.1f}, measured "
                        f"{speed:.1f} rad/s)"
                    )
        return ""

    def _notice(self, seen: WheelSpeeds, dt: float, still: bool) -> None:
        """Report, at intervals, wheels that turn after a rest against their command."""
        fastest = 0.0
        if still:
            rows = zip(self._wheels, map(abs, seen.as_tuple()), strict=True)
            fastest = max([speed for wheel, speed in rows if not wheel.driven], default=0.0)
        self._rolled = self._rolled + dt if fastest > SLACK else 0.0
        self._untold += dt
        self.turned = ""
        if self._rolled > ROLLED_S and self._untold >= TOLD_AGAIN_S:
            self._untold = 0.0
            self.turned = (
                f"wheels turn at {fastest:.1f} rad/s without a command: is the robot being pushed?"
            )

"""Checks whether feedback is physically possible.

`Sanity` rejects a line in which a wheel turns, or changes its speed, faster than any wheel can. The
daemon does not use such a line, and several in a row are a fault. If more than one line in a
hundred is impossible, the daemon logs a warning: either the wire damages lines, or a bound is too
low and true lines are rejected. `wheel_faults.py` checks whether the wheels obey their commands.
"""

from __future__ import annotations

import math
from operator import sub

from acsard.core.config.settings import FeedbackConfig
from acsard.core.link.feedback import Feedback
from acsard.core.values import WHEELS, Event, WheelSpeeds

REPEATED = 3
"""Number of impossible lines in a row that latch a fault: 30 ms at 100 Hz."""

WINDOW = 1000
"""Number of lines in a window. The impossible lines of each window are counted. A window lasts 10 s
at 100 Hz."""

SHARE = 0.01
"""If more than this share of the lines in a window is impossible, one warning is logged."""

SLACK = 2.0
"""Allowed change of a speed, rad/s, beyond `feedback.wheel_acceleration`. Coarse encoders and a
robot at rest can cause changes of this size."""

STEPS = 2
"""Encoder counts by which two reports of a wheel at constant speed may differ, because each report
may be wrong by one count."""

SHORTEST_S = 0.004
"""Shortest time that is expected between two lines, s. Lines follow each other this quickly while
this computer catches up after a stall. A single encoder count in so short a time looks like a high
speed."""


class Sanity:
    """Compares each feedback line with the last line that was physically possible."""

    def __init__(self, feedback: FeedbackConfig) -> None:
        self._settings = feedback
        self._last: WheelSpeeds | None = None
        self._since = 0.0
        self._longest = 0.0
        """Longest time over which a recent line reports the mean speed, s. A line that covers a
        pause of t s counts as recent for t s."""
        self._impossible = 0
        self._lines = self._dropped = 0
        """Numbers of all lines and of impossible lines in the present window."""
        self.warning: Event | None = None
        """The warning of too many impossible lines. None unless the last line caused it."""

    def forget(self) -> None:
        """Start over, because the link was lost or a fault has been cleared."""
        self._last, self._since, self._longest, self._impossible = None, 0.0, 0.0, 0

    @property
    def doubtful(self) -> bool:
        """Whether so many impossible lines came in a row that the feedback cannot be trusted."""
        return self._impossible >= REPEATED

    def impossible(self, feedback: Feedback) -> str:
        """Return why no wheel can have the speeds in this line; "" if the line is possible.

        The allowed change of each speed grows with the time since the last possible line, so a real
        jump is accepted after enough time. Each speed is a mean over the time of its line, so the
        change may have lasted from the middle of one line to the middle of the next.
        """
        since = max(feedback.dt, feedback.since)
        self._since += since
        longest = max(0.0, self._longest - since)
        self._longest = max(longest, since)
        if feedback.gap:
            self._last = None
        why = self._objection(feedback, longest)
        self._count(why)
        if why:
            self._impossible += 1
            return why
        self._last, self._since, self._impossible = feedback.speeds, 0.0, 0
        return ""

    def _count(self, why: str) -> None:
        """Count a line in the window, and set the warning if it is due."""
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
            f"what they report; the last: {why}. If a wheel really does that, raise that setting. "
            "Otherwise lines arrive damaged: check cable and ground; firmware that supports "
            'mcu.link_check = "auto" protects each line with a checksum'
        )

    def _objection(self, line: Feedback, longest: float) -> str:
        speeds, fastest = line.speeds, self._settings.wheel_speed
        before = speeds if self._last is None else self._last
        seconds = max(self._since, (self._since + longest) / 2)
        most = self._settings.wheel_acceleration * seconds + SLACK
        wheels, then_wheels = speeds.as_tuple(), before.as_tuple()
        changes = map(abs, map(sub, wheels, then_wheels))
        if max(map(abs, wheels)) <= fastest and max(changes) <= most:
            return ""  # Nearly every line ends here, without regard to quantization steps.
        turned = line.counted if line.turned is None else line.turned
        rows = zip(WHEELS, wheels, then_wheels, line.steps, turned or wheels, strict=True)
        for name, now, then, step, angle in rows:
            size, change = abs(now), abs(now - then)
            # A quantization step allows excess speed only if encoder counts prove the step. A
            # faulty encoder may show any step.
            room = 0.0
            if line.count and turned is not None:
                # If the line reports n counts, n - 1 of them certainly occurred in its time.
                room = size * min(1.0, line.count / abs(angle)) if angle else size
                step = max(step, line.count / SHORTEST_S)
            elif turned is not None and step < math.inf:
                room = step
            if size > fastest + room:
                return f"{name} at {now:.2f} rad/s is over feedback.wheel_speed"
            if change > most + STEPS * step:
                leap = f"{name} jumps from {then:.2f} to {now:.2f} rad/s"
                return f"{leap}, which is over feedback.wheel_acceleration"
        return ""

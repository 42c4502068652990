"""Detects echoes: lines that the daemon writes to the serial port and then receives back.

Lines come back if TX and RX are connected to each other, or if a device at the far end sends all
bytes back. A board may be connected behind such a device. The daemon then receives both the echo
and the replies of the board. This module detects the echo of plain lines. It also detects the echo
of checked lines (lines with a checksum), if they do not ask for a sample of the encoders.
"""

from __future__ import annotations

from collections import deque

from msgspec import Struct

from acsard.core.values import WheelSpeeds

MIN_REPEATED_LINES = 20
"""Least number of successive sent lines that must come back to count as an echo. 20 lines take 0.2
s at 100 Hz."""

MAX_OTHER_REPORTS = 2
"""Largest number of genuine replies between two lines of an echo. If a board is connected behind an
adapter that echoes, the daemon receives both the echo and the replies of the board. A board that
reports by its own clock may send two replies in a row."""

MIN_TOTAL_CHANGE = 2.0
"""Least total change of the wheel speeds in an echo, rad/s. The total is a sum over all pairs of
successive lines that came back. Each pair adds the largest of its four speed changes, one per
wheel. With coarse encoders, a smaller total may be a coincidence."""

MIN_BEND = 0.025
"""Least bend in an echo, rad/s. A bend is the difference between two successive changes of a
wheel's speed, as at the start or the end of a ramp. An echo needs at least one bend above this
limit. Speeds in lines are rounded to 0.01 rad/s, so on a straight ramp two speed changes differ by
up to 0.02 rad/s. Therefore an echo may stay undetected while all ramps are gentler than 0.025 rad/s
per line. For a wheel radius of 0.05 m, this is 0.125 m/s2 at 100 Hz."""

COMPARED_LINES = 8
"""Number of the newest sent lines with which `EchoDetector` compares each received reply. At 100
Hz, an echo that comes back within 70 ms is detected."""

_Wheels = tuple[float, float, float, float]
NO_CHANGE: _Wheels = (0.0, 0.0, 0.0, 0.0)
"""Change of the four wheel speeds between two lines with equal speeds, rad/s."""


class _Run(Struct, gc=False):
    """A series of successive sent lines that came back."""

    report: int
    """Number of the last received reply that equals the last line of the run. Replies are numbered
    from 1."""
    wheels: _Wheels
    """Wheel speeds in the last line of the run, rad/s."""
    slope: _Wheels | None = None
    """Change of each wheel's speed between the last two lines of the run, rad/s. None if the run
    has only one line."""
    lines: int = 1
    """Number of lines in the run."""
    change: float = 0.0
    """Sum of the speed changes between successive lines, rad/s, as `MIN_TOTAL_CHANGE` defines
    it."""
    corner: float = 0.0
    """Largest bend in the run, rad/s. A bend is the difference between two successive speed
    changes."""


class EchoDetector:
    """Detector of an echo: received lines that only repeat the daemon's own lines.

    A report is a received reply that contains no encoder counts. A report has the same form as a
    command, so an echo looks like a board that reports exactly the commanded speeds. The received
    lines are an echo if all of these conditions hold:

    - At least `MIN_REPEATED_LINES` successive sent lines came back in order, byte for byte.
    - Between two of these lines, at most `MAX_OTHER_REPORTS` other reports came. Their speeds do
      not lie between the speeds in the two lines, as the speeds of a real motor would.
    - The speed changes from line to line add up to at least `MIN_TOTAL_CHANGE`.
    - One speed change differs by more than `MIN_BEND` from the previous speed change, as at the
      start or the end of a ramp. A motor that lags by a whole number of lines repeats a steady ramp
      exactly, but it rounds off the start and the end of the ramp.

    At rest every board looks like an echo, so lines without speed changes prove nothing. While all
    ramps are gentle (see `MIN_BEND`), no echo is detected. Some devices echo and also pass on the
    replies of a board, such as an RS-485 adapter. They are detected just as quickly as a device
    that only echoes.

    A board that reports its set points instead of measured speeds looks exactly like an echo. A
    simulator whose wheels have no lag may look like an echo too. The daemon then does not drive
    until the port is opened again, and reports the reason.
    """

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Forget all lines and reports, because the port has been opened."""
        self._sent: deque[bytes] = deque(maxlen=COMPARED_LINES + 1)
        """The last `COMPARED_LINES` sent lines, and the line before them. The older line is needed
        because a series of lines that came back may end with it, and the next reply may continue
        this series."""
        self._runs: deque[_Run | None] = deque(maxlen=COMPARED_LINES + 1)
        """For each line in `_sent`, the run that ends with this line: the series of successive sent
        lines that came back. None if this line did not come back."""
        self._reports = 0
        self._last: deque[_Wheels] = deque(maxlen=MAX_OTHER_REPORTS + 1)
        """Wheel speeds in the last received replies, rad/s."""

    def written(self, line: bytes) -> None:
        """Record that `line`, with its line end, was written to the port."""
        self._sent.append(line.removesuffix(b"\r\n"))
        self._runs.append(None)

    def report(self, line: bytes, speeds: WheelSpeeds) -> bool:
        """Process a reply without encoder counts. Return whether the last replies are an echo.

        `line` is the reply without its line end, and `speeds` are the speeds in the reply.
        """
        self._reports += 1
        wheels = speeds.as_tuple()
        self._last.append(wheels)
        if line not in self._sent:
            return False
        is_echo, sent, runs = False, self._sent, self._runs
        # The newest line is first, so that a report makes each run longer by at most one line.
        for place in range(len(sent) - 1, max(0, len(sent) - COMPARED_LINES) - 1, -1):
            if sent[place] != line:
                continue
            before, known = runs[place - 1] if place else None, runs[place]
            if known is None or (before is not None and known.lines <= before.lines):
                run = self._continued(before, wheels)
            else:
                run = known  # a continued run would not be longer
            if known is None or known.lines < run.lines:
                runs[place] = known = run
            elif known.slope == NO_CHANGE:
                # At a steady speed all lines are equal, so several reports equal the same line.
                # On a ramp only one report equals it.
                known.report = self._reports
            enough = known.lines >= MIN_REPEATED_LINES and known.change >= MIN_TOTAL_CHANGE
            is_echo = is_echo or (enough and known.corner > MIN_BEND)
        return is_echo

    def _continued(self, run: _Run | None, wheels: _Wheels) -> _Run:
        """Return `run` extended by the present reply, or a new run if the reply does not fit."""
        others = MAX_OTHER_REPORTS + 1 if run is None else self._reports - run.report - 1
        if run is None or others > MAX_OTHER_REPORTS:
            return _Run(self._reports, wheels)
        lines, change, corner = run.lines + 1, run.change, run.corner
        if run.slope == NO_CHANGE and run.wheels == wheels:
            return _Run(self._reports, wheels, NO_CHANGE, lines, change, corner)
        slope = _differences(run.wheels, wheels)
        steady = NO_CHANGE in (run.slope, slope)
        for other in [self._last[-2 - n] for n in range(others)]:
            if _between(other, run.wheels, wheels) and not (steady and other == run.wheels):
                return _Run(self._reports, wheels)
        if run.slope is not None:
            corner = max(corner, _largest(_differences(run.slope, slope)))
        return _Run(self._reports, wheels, slope, lines, change + _largest(slope), corner)


def _between(wheels: _Wheels, first: _Wheels, other: _Wheels) -> bool:
    rows = zip(wheels, first, other, strict=True)
    return all(min(a, b) <= speed <= max(a, b) for speed, a, b in rows)


def _differences(before: _Wheels, after: _Wheels) -> _Wheels:
    a, b, c, d = before
    e, f, g, h = after
    return e - a, f - b, g - c, h - d


def _largest(values: _Wheels) -> float:
    return max([abs(value) for value in values])

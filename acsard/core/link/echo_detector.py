"""Detects echoes of plain lines: the daemon's own lines come back from the serial port.

TX and RX are connected, or the far end echoes, alone or beside the replies of a board.
"""

from __future__ import annotations

from collections import deque

from msgspec import Struct

from acsard.core.values import WheelSpeeds

REPORTS = 20
"""Number of sent lines in a row that must come back to count as an echo. 20 lines take 0.2 s at
100 Hz."""

OTHERS = 2
"""Largest number of other reports between two echoes in a run. They are the replies of a board
behind an adapter that echoes. A board that reports by its own clock may send two in a row."""

CHANGE = 2.0
"""A run counts as an echo only if its speed changes add up to at least this, rad/s. The change from
one line to the next is that of the wheel with the largest change. With coarse encoders, a smaller
sum may be a coincidence."""

CORNER = 0.025
"""A run counts as an echo only if a speed change in it differs by more than this from the change
before it, rad/s. Speeds in lines are rounded to 0.01 rad/s, so on a straight ramp two changes
differ by up to 0.02 rad/s. Therefore an echo may stay undetected while all ramps are gentler than
0.025 rad/s per line, which is 0.125 m/s2 with wheels of 0.05 m at 100 Hz."""

LINES = 8
"""Number of the newest sent lines with which `EchoDetector` compares a report. At 100 Hz, this
detects an echo that comes back within 70 ms."""

_Wheels = tuple[float, float, float, float]
STEADY: _Wheels = (0.0, 0.0, 0.0, 0.0)
"""Speed change between two lines with the same speeds, rad/s."""


class _Run(Struct, gc=False):
    """A run of successive sent lines that came back, up to one line."""

    report: int
    """Number of the last report that equalled the line."""
    wheels: _Wheels
    """Speeds in the line, rad/s."""
    slope: _Wheels | None = None
    """Difference between these speeds and those in the line before, rad/s. None in the first
    line."""
    lines: int = 1
    change: float = 0.0
    """Sum of the speed changes, rad/s."""
    corner: float = 0.0
    """Largest difference between two successive speed changes, rad/s."""


class EchoDetector:
    """Detector of an echo: received lines that only repeat the daemon's own lines.

    A report is a reply without a sample. It has the same form as a command, so an echo looks like a
    board that reports exactly the commanded speeds. The rule is:

    - At least `REPORTS` successive sent lines came back in order, byte for byte.
    - At most `OTHERS` other reports came between two of them, and none of these lies between the
      speeds of the two lines, as a report of a motor on its way from one to the other does.
    - The speed changes in these lines add up to at least `CHANGE`, and at a corner of more than
      `CORNER` the change itself changed. A motor that lags by a whole number of lines repeats a
      steady ramp exactly, but it rounds off the start and the end of the ramp.

    At rest every board looks like an echo, so a run without changes proves nothing. A far end that
    echoes and also answers is detected as soon as one that only echoes, unless all ramps are gentle
    (see `CORNER`). An example is an adapter for RS-485 with a board behind it.

    A board that reports its set points looks exactly like an echo, and so may a simulator whose
    wheels have no lag. The daemon then does not drive until the port is opened again, and reports
    the reason.
    """

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Forget all lines and reports, because the port has been opened."""
        self._sent: deque[bytes] = deque(maxlen=LINES + 1)
        """The last sent lines, and the one before them, whose run the oldest of them continues."""
        self._runs: deque[_Run | None] = deque(maxlen=LINES + 1)
        """For each line in `_sent` the run up to it. None if the line did not come back."""
        self._reports = 0
        self._last: deque[_Wheels] = deque(maxlen=OTHERS + 1)
        """Speeds in the last reports."""

    def left(self, line: bytes) -> None:
        """Record that `line`, with its line end, was written to the port."""
        self._sent.append(line.removesuffix(b"\r\n"))
        self._runs.append(None)

    def report(self, line: bytes, speeds: WheelSpeeds) -> bool:
        """Process a report without its line end. Return whether the last reports are an echo."""
        self._reports += 1
        wheels = speeds.as_tuple()
        self._last.append(wheels)
        if line not in self._sent:
            return False
        found, sent, runs = False, self._sent, self._runs
        # The newest line is first, so that one report continues each run by one line only.
        for place in range(len(sent) - 1, max(0, len(sent) - LINES) - 1, -1):
            if sent[place] != line:
                continue
            run, known = self._continued(runs[place - 1] if place else None, wheels), runs[place]
            if known is None or known.lines < run.lines:
                runs[place] = known = run
            elif known.slope == STEADY:
                # Reports repeat a steady speed. A line on a ramp comes back once.
                known.report = self._reports
            enough = known.lines >= REPORTS and known.change >= CHANGE
            found = found or (enough and known.corner > CORNER)
        return found

    def _continued(self, run: _Run | None, wheels: _Wheels) -> _Run:
        """Return the run that has the line with these speeds behind the lines of `run`."""
        others = OTHERS + 1 if run is None else self._reports - run.report - 1
        if run is None or others > OTHERS:
            return _Run(self._reports, wheels)
        lines, change, corner = run.lines + 1, run.change, run.corner
        if run.slope == STEADY and run.wheels == wheels:
            return _Run(self._reports, wheels, STEADY, lines, change, corner)
        slope = _differences(run.wheels, wheels)
        steady = STEADY in (run.slope, slope)
        for other in [self._last[-2 - n] for n in range(others)]:
            if _between(other, run.wheels, wheels) and not (steady and other == run.wheels):
                return _Run(self._reports, wheels)
        if run.slope is not None:
            corner = max(corner, _largest(_differences(run.slope, slope)))
        return _Run(self._reports, wheels, slope, lines, change + _largest(slope), corner)


def _between(wheels: _Wheels, one: _Wheels, other: _Wheels) -> bool:
    """Return whether these speeds of all wheels lie between two other speeds or equal one."""
    rows = zip(wheels, one, other, strict=True)
    return all(min(a, b) <= speed <= max(a, b) for speed, a, b in rows)


def _differences(before: _Wheels, after: _Wheels) -> _Wheels:
    a, b, c, d = before
    e, f, g, h = after
    return e - a, f - b, g - c, h - d


def _largest(values: _Wheels) -> float:
    return max([abs(value) for value in values])

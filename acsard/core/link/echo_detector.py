"""Detects echoes: lines that the daemon writes to the serial port and then receives back.

TX and RX are connected, or a device at the far end sends all bytes back, maybe with a board behind
it, whose replies come too. This detects the echo of plain lines, and of checked ones that ask for
no sample.
"""

from __future__ import annotations

from collections import deque

from msgspec import Struct

from acsard.core.values import WheelSpeeds

MIN_REPEATED_LINES = 20  # successive lines that come back, 0.2 s at 100 Hz

# Genuine replies between two lines of an echo; a free-running board may send two.
MAX_OTHER_REPORTS = 2

# rad/s, summed over pairs of lines (the largest of four changes each). With coarse encoders, a
# smaller total may be a coincidence.
MIN_TOTAL_CHANGE = 2.0

# rad/s between successive changes of a speed, as at the ends of a ramp. Rounding to 0.01 gives
# 0.02. Gentler ramps (0.125 m/s2 at 100 Hz and 0.05 m radius) show no echo.
MIN_BEND = 0.025

COMPARED_LINES = 8  # newest sent lines: at 100 Hz, an echo within 70 ms is detected

_Wheels = tuple[float, float, float, float]
NO_CHANGE: _Wheels = (0.0, 0.0, 0.0, 0.0)


class _Run(Struct, gc=False):
    report: int  # number of the reply that equals the last line
    wheels: _Wheels  # in the last line
    slope: _Wheels | None = None  # change between the last two lines
    lines: int = 1  # in the run
    change: float = 0.0  # as `MIN_TOTAL_CHANGE` sums it
    corner: float = 0.0  # largest difference of successive changes


class EchoDetector:
    """Detects that received lines only repeat the daemon's own.

    An echo looks like a board that reports exactly the commanded speeds. It is one if all of these
    hold:

    - `MIN_REPEATED_LINES` successive lines came back in order, byte for byte.
    - Between two of them came at most `MAX_OTHER_REPORTS` others, with speeds that do not lie
      between theirs, as a real motor's would.
    - The changes of the speeds sum up to `MIN_TOTAL_CHANGE`: at rest every board looks like an
      echo.
    - One change differs from the previous one by `MIN_BEND`. A motor that lags by whole lines
      repeats a steady ramp exactly, but rounds off its ends.

    A board that reports its set points looks exactly like an echo, so the daemon does not drive
    until the port is opened again, and reports the reason.
    """

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        # `COMPARED_LINES` lines, and the one before them, with which a series may end that the next
        # reply continues.
        self._sent: deque[bytes] = deque(maxlen=COMPARED_LINES + 1)
        # For each line in `_sent`, the run that ends with it, if it came back.
        self._runs: deque[_Run | None] = deque(maxlen=COMPARED_LINES + 1)
        self._reports = 0
        self._last: deque[_Wheels] = deque(maxlen=MAX_OTHER_REPORTS + 1)  # of the last replies

    def written(self, line: bytes) -> None:
        self._sent.append(line.removesuffix(b"\r\n"))
        self._runs.append(None)

    def report(self, line: bytes, speeds: WheelSpeeds) -> bool:
        """Process a reply (no counts, no line end); return whether the last replies are an echo."""
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

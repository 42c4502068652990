"""The table of methods of calibration by a guided drive."""

from __future__ import annotations

from collections.abc import Callable

from msgspec import Struct

from acsard.calibration.guided import tape, tour, umbmark, wall
from acsard.calibration.guided.legs import WIDEST, Setup, Way
from acsard.calibration.guided.needs import NEEDS

TRACKS = [1.0 + 0.05 * step for step in range(round((WIDEST - 1.0) / 0.05) + 1)]
"""Ratios of effective to geometric track for which the driving time is computed.

The time is not monotonic: a smaller track lets more whole turns fit into the time allowed.
"""


class Kind(Struct, frozen=True):
    """A method of calibration."""

    needs: str
    begin: Callable[[Setup], Way]
    longest_s: Callable[[Setup, float], float]
    """Driving time in s by the setup and the ratio of effective to geometric track."""
    person: bool
    """Whether a person has to read off numbers."""

    def told(self, setup: Setup) -> str:
        """Return the longest driving time as a sentence."""
        most = max(self.longest_s(setup, track) for track in TRACKS)
        return f"It drives for at most {most:.0f} s in all."


KINDS: dict[str, Kind] = {
    "gyro": Kind(NEEDS["gyro"], tour.gyro, tour.spinning_s, False),
    "positions": Kind(NEEDS["positions"], tour.positions, tour.petals_s, False),
    "tape": Kind(NEEDS["tape"], tape.way, tape.longest_s, True),
    "wall": Kind(NEEDS["wall"], wall.way, wall.longest_s, True),
    "umbmark": Kind(NEEDS["umbmark"], umbmark.way, umbmark.longest_s, True),
}

"""Whether a silence is the board's, or of this computer, which did not run and so neither asked nor
heard it. For the person who has to find out why: the link is judged by the silence alone.
"""

from __future__ import annotations

from acsard.mcu.link_state import WORDS
from acsard.mcu.link_state import State as LinkState
from acsard.values import NS_PER_S

SHARE = 0.5
"""Of the silence that ends a link: steps so far apart are what made it."""

BUSY = "what else runs here? (`top`; as a service it goes first)"
"""The mend of a computer that is late."""

HOST = "this computer did not run for"

SIMULATOR = "the built-in simulator, a part of this program, is late"


def is_ours(words: str) -> bool:
    """These are `Lateness.words` of a silence that is of this computer."""
    return HOST in words or SIMULATOR in words


class Lateness:
    """Looks at the times of the steps."""

    def __init__(self, simulated: bool, quiet_ns: int) -> None:
        """`simulated`: the board is a part of this process; `quiet_ns` of silence end the link."""
        self._simulated, self._least_ns = simulated, SHARE * quiet_ns
        self._looked_ns: int | None = None
        self.late_s = 0.0
        """The longest time since the last good line in which there was no step; 0 for none."""
        self.step_s = 0.0
        """The time between the last two steps when that was so long, else 0."""

    def look(self, now_ns: int, good: bool) -> bool:
        """A step, and whether a good line came with it; True when the silence that this one ends
        was ours."""
        before_ns, self._looked_ns = self._looked_ns, now_ns
        passed_ns = 0 if before_ns is None else now_ns - before_ns
        self.step_s = passed_ns / NS_PER_S if passed_ns >= self._least_ns else 0.0
        late_s = max(self.late_s, self.step_s)
        self.late_s = 0.0 if good else late_s
        return good and (late_s > 0.0 or self._simulated)

    def words(self, link: LinkState) -> str:
        """How the link is, for people."""
        if link == "stale" and self.late_s:
            return f"{HOST} {self.late_s:.2f} s, and heard nothing of the microcontroller: {BUSY}"
        if link == "stale" and self._simulated:
            return f"{SIMULATOR}: {BUSY}"
        return WORDS[link]

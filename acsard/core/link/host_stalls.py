"""Distinguishes a silence of the board from a stall of this computer.

A computer that stalls neither sends nor receives. The result is a hint for the operator. The link
is judged by the silence alone.
"""

from __future__ import annotations

from acsard.core.link.link_state import WORDS
from acsard.core.link.link_state import State as LinkState
from acsard.core.values import NS_PER_S

SHARE = 0.5
"""Share of the silence that ends a link. Two steps this far apart have caused the silence."""

BUSY = "which other program uses the processor? (`top` shows it; as a service acsard has priority)"
"""The advice for a computer that is late."""

HOST = "this computer did not run for"

SIMULATOR = "the built-in simulator, which is a part of this program, is late"


def is_ours(words: str) -> bool:
    """Return whether `Lateness.words` blames this computer for the silence."""
    return HOST in words or SIMULATOR in words


class Lateness:
    """The lateness of the control steps."""

    def __init__(self, simulated: bool, quiet_ns: int) -> None:
        """Start.

        Args:
            simulated: Whether the board is a part of this process.
            quiet_ns: The duration of silence that ends a link, ns.
        """
        self._simulated, self._least_ns = simulated, SHARE * quiet_ns
        self._looked_ns: int | None = None
        self.late_s = 0.0
        """Longest time without a step since the last good line, s; 0 if no step was late."""
        self.step_s = 0.0
        """Time between the last two steps if it was too long, else 0; s."""

    def look(self, now_ns: int, good: bool) -> bool:
        """Note a step, and whether a good line came with it.

        Return True if this line ends a silence that this computer caused.
        """
        before_ns, self._looked_ns = self._looked_ns, now_ns
        passed_ns = 0 if before_ns is None else now_ns - before_ns
        self.step_s = passed_ns / NS_PER_S if passed_ns >= self._least_ns else 0.0
        late_s = max(self.late_s, self.step_s)
        self.late_s = 0.0 if good else late_s
        return good and (late_s > 0.0 or self._simulated)

    def words(self, link: LinkState) -> str:
        """Return a sentence about the link."""
        if link == "stale" and self.late_s:
            return (
                f"{HOST} {self.late_s:.2f} s, and received nothing from the microcontroller: {BUSY}"
            )
        if link == "stale" and self._simulated:
            return f"{SIMULATOR}: {BUSY}"
        return WORDS[link]

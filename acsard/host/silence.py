"""Pure: measures how long a peer has been silent while this process was running."""

from __future__ import annotations

from acsard.core.values import NS_PER_S

MOMENT_NS = NS_PER_S // 2
"""Longest time that counts between two judgements, ns. A longer gap means that the machine or a
CPU quota has stopped this process too.
"""


class Silence:
    """Silence of a peer, judged again and again.

    A machine that stands still as a whole does not count as silence of the peer.
    """

    def __init__(self, most_ns: int) -> None:
        self._most_ns, self._ns = most_ns, 0

    def too_long(self, heard: bool, passed_ns: int) -> bool:
        """Return whether the silence exceeds `most_ns`, `passed_ns` after the last call."""
        self._ns = 0 if heard else self._ns + min(passed_ns, MOMENT_NS)
        return self._ns > self._most_ns

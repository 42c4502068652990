"""Pure: how long somebody has been silent while we were there to hear it."""

from __future__ import annotations

from acsard.values import NS_PER_S

MOMENT_NS = NS_PER_S // 2
"""More than this between two judgements is a machine, or a quota, that let us stand still too."""


class Silence:
    """Judged again and again; a machine that stands still as a whole is nobody's silence."""

    def __init__(self, most_ns: int) -> None:
        self._most_ns, self._ns = most_ns, 0

    def too_long(self, heard: bool, passed_ns: int) -> bool:
        """Longer than `most_ns` by now, `passed_ns` after the last judgement?"""
        self._ns = 0 if heard else self._ns + min(passed_ns, MOMENT_NS)
        return self._ns > self._most_ns

"""When a viewer whose commands do not drive is told why; pure."""

from __future__ import annotations

from acsard.values import NS_PER_S

OBJECTS_NS = NS_PER_S // 2
"""For so long they do not count is no news: the first 0.25 s of a new sender never do."""


class Objections:
    """Those to one viewer."""

    def __init__(self) -> None:
        self._since_ns: int | None = None
        self.told = ""
        """What he has been told, and still holds."""

    def look(self, objection: str, now_ns: int) -> bool:
        """By what is objected to now, "" for nothing: whether `told` is another."""
        if not objection:
            self._since_ns = None
            changed, self.told = bool(self.told), ""
            return changed
        if self._since_ns is None:
            self._since_ns = now_ns
        if now_ns - self._since_ns < OBJECTS_NS or objection == self.told:
            return False
        self.told = objection
        return True

"""Decides when a viewer is informed why its commands do not drive. This module is pure."""

from __future__ import annotations

from acsard.client.commander import GRACE_S
from acsard.core.values import NS_PER_S


class Objections:
    """The objection to one viewer's commands."""

    def __init__(self) -> None:
        self._since_ns: int | None = None
        self.told = ""
        """The objection that was reported and still holds, or ""."""

    def look(self, objection: str, now_ns: int) -> bool:
        """Process the current objection ("" for none); return whether `told` has changed."""
        if not objection:
            self._since_ns = None
            changed, self.told = bool(self.told), ""
            return changed
        if self._since_ns is None:
            self._since_ns = now_ns
        if now_ns - self._since_ns < GRACE_S * NS_PER_S or objection == self.told:
            return False
        self.told = objection
        return True

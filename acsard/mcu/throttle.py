"""Now or not yet: what may be said again and again, but not too often."""

from __future__ import annotations


class Throttle:
    """Lets one through, and the next when enough time has passed since."""

    def __init__(self) -> None:
        self.last_ns: int | None = None
        """When one went through last, monotonic; None for not yet."""
        self._before_ns: int | None = None

    def lets(self, now_ns: int, wait_ns: int) -> bool:
        """May one go now, `wait_ns` after the last? Then it is the last."""
        if self.last_ns is not None and now_ns - self.last_ns < wait_ns:
            return False
        self._before_ns, self.last_ns = self.last_ns, now_ns
        return True

    def undo(self) -> None:
        """Forget the last one, because its line did not leave: the next line need not wait."""
        self.last_ns = self._before_ns

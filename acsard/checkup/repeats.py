"""Finds out whether the replies repeat the commands, because then they measure nothing.

While the speeds rise, each line has other speeds, and a motor follows later. So a reply with
exactly the speeds of one of the last two lines is no measurement.
"""

from __future__ import annotations

from collections.abc import Sequence

from msgspec import Struct

from acsard.checkup import outcomes
from acsard.checkup.findings import Finding, StoppedError
from acsard.core.link.codec import Motors
from acsard.core.link.echo_check import RETURNED_FRACTION

MIN_REPEATED = 5  # a coarse encoder may show a commanded speed now and then


class Repeats(Struct):
    """Counts of the lines sent while speeds rise, and of the replies to them."""

    encoders: bool  # `feedback.encoders`
    lines: int = 0
    replies: int = 0
    moving: int = 0  # replies with a speed
    repeated: int = 0  # of those

    def record(self, replies: Sequence[Motors], before: Motors, command: Motors) -> None:
        """Record the replies that came after the line `command`, which followed `before`."""
        moving = [reply for reply in replies if any(reply)]
        self.lines += 1
        self.replies += len(replies)
        self.moving += len(moving)
        self.repeated += sum(reply in (before, command) for reply in moving)

    def check(self) -> None:
        """Raise `StoppedError` if the daemon would not drive with such replies."""
        others = self.replies - self.repeated
        if self.repeated < MIN_REPEATED:
            return
        if self.repeated >= RETURNED_FRACTION * self.lines and others >= self.lines / 2:
            raise StoppedError(outcomes.find("replies: echo"))
        if self._only and self.encoders:
            raise StoppedError(outcomes.find("replies: set points"))

    @property
    def _only(self) -> bool:
        return self.repeated == self.moving >= MIN_REPEATED

    def finding(self) -> Finding | None:
        """Return a finding if the board has no encoders, as configured."""
        return outcomes.find("measured speeds: set points") if self._only else None

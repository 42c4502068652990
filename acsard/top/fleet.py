"""The data of `acsard fleet`: the present robots, and the reason why others may be missing."""

from __future__ import annotations

import time

from msgspec.structs import replace

from acsard.client import fleet
from acsard.client.fleet import Row
from acsard.daemon.bus.robot_discovery import ALL, nobody, seen


class Fleet(fleet.Fleet):
    """Follows the robots with these ids, or all robots."""

    def rows(self) -> list[Row]:
        """Query silent robots, and return one row per robot."""
        self.ask(self.due())
        return [replace(row, here=bool(row.here)) for row in super().rows()]

    def gather(self) -> list[Row]:
        """Wait until every robot that is present has answered; return no rows if none is there.

        It takes 1.5 s, or 3 s if no robot is there: on a busy computer the first answer is late.
        """
        began, rows = time.monotonic(), self.rows()
        while not self.whole:
            present = any(row.here or row.state for row in rows)
            if time.monotonic() - began >= (1.5 if present else 3.0):
                return self.rows() if present else []
            time.sleep(0.05)
            rows = self.rows()
        return self.rows()

    @property
    def whole(self) -> bool:
        """Whether all named robots are present and have reported their state and version.

        This is never true if all robots were requested, because their number is unknown.
        """
        with self._lock:
            known = list(self._known.values())
        named = ALL not in self._ids
        return named and all(one.here and one.version and one.follower.heard for one in known)

    @property
    def seen(self) -> str:
        """Number of present robots and where they were found; "" if the robots were named."""
        with self._lock:
            here = sum(bool(one.here) for one in self._known.values())
        return seen(self._robot.where.endpoint, here) if ALL in self._ids else ""

    @property
    def more(self) -> str:
        """Note that some robots are left out, or ""."""
        if not self.left_out:
            return ""
        return (
            f"more than {self._most} robots: the others are left out; name yours with --id "
            "robot1,robot2"
        )

    def hint(self) -> str:
        """Return the reason why there may be no robots to show."""
        if ALL in self._ids:
            return nobody(self._robot.where.endpoint)
        return "none of these robots is present"

"""What may be begun from the page, as the words of the very command; pure.

Nothing of what was sent becomes an option of its own: the options are these, and each value is one
of a few, or a plain key.
"""

from __future__ import annotations

import re
from collections.abc import Collection

from msgspec import Struct

from acsard.calibration.guided.needs import NEEDS
from acsard.web.frames import Begin, FrameError

POSITIONS = "positions"

KEY = re.compile(r"(?=.{1,80}\Z)[A-Za-z0-9_][A-Za-z0-9_-]*(/[A-Za-z0-9_-]+)*\Z")


class Reach(Struct, frozen=True):
    """By which options a command finds what this page's server has found; "" is not given."""

    config: str
    endpoint: str
    robot_id: str
    tls: str


def words(begin: Begin, reach: Reach, ports: Collection[str]) -> list[str]:
    """Behind `acsard`; raises `FrameError`."""
    config = [f"--config={reach.config}"] if reach.config else []
    if begin.begin == "check":
        if begin.way or begin.positions:
            raise FrameError("begin", "way and positions are for calibrate")
        if begin.port not in ports:
            raise FrameError("begin", f"port is one of {', '.join(sorted(ports))}")
        return ["mcu", "check", "--json-lines", *config, f"--port={begin.port}"]
    if begin.port:
        raise FrameError("begin", "port is for check")
    given = [f"--connect={reach.endpoint}", f"--id={reach.robot_id}"]
    if reach.tls:
        given.append(f"--tls={reach.tls}")
    return ["calibrate", "--json-lines", *config, *given, *_way(begin)]


def _way(begin: Begin) -> list[str]:
    if begin.way and begin.way not in NEEDS:
        raise FrameError("begin", f"way is one of {', '.join(NEEDS)}")
    if (begin.way == POSITIONS) != bool(begin.positions):
        raise FrameError("begin", "positions is the key that they come on, with the way positions")
    if begin.positions and not KEY.match(begin.positions):
        raise FrameError("begin", "positions is a key like sim/pose: letters, digits, _ / -")
    options = {"way": begin.way, "positions": begin.positions}
    return [f"--{name}={value}" for name, value in options.items() if value]

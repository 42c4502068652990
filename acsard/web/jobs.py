"""Command lines for the checks and calibrations that the page may start. This module is pure.

No text from the browser becomes an option by itself. The options are fixed here, and each value is
either one of a known set or a plain key.
"""

from __future__ import annotations

import re
from collections.abc import Collection

from msgspec import Struct

from acsard.calibration.guided.drive_plan import NEEDS
from acsard.web.frames import Begin, FrameError

POSITIONS = "positions"

KEY = re.compile(r"(?=.{1,80}\Z)[A-Za-z0-9_][A-Za-z0-9_-]*(/[A-Za-z0-9_-]+)*\Z")


class Reach(Struct, frozen=True):
    """The options that let a command reach the same daemon as this server.

    An empty value omits its option.
    """

    config: str
    endpoint: str
    robot_id: str
    tls: str


def words(begin: Begin, reach: Reach, ports: Collection[str]) -> list[str]:
    """Return the arguments after `acsard`. Raises `FrameError` if the request is not allowed."""
    config = [f"--config={reach.config}"] if reach.config else []
    if begin.begin == "check":
        if begin.method or begin.positions:
            raise FrameError("begin", "`method` and `positions` are only for a calibration")
        if begin.port not in ports:
            raise FrameError("begin", f"port is one of {', '.join(sorted(ports))}")
        return ["mcu", "check", "--json-lines", *config, f"--port={begin.port}"]
    if begin.port:
        raise FrameError("begin", "`port` is only for the check of a board")
    given = [f"--connect={reach.endpoint}", f"--id={reach.robot_id}"]
    if reach.tls:
        given.append(f"--tls={reach.tls}")
    return ["calibrate", "--json-lines", *config, *given, *_method(begin)]


def _method(begin: Begin) -> list[str]:
    if begin.method and begin.method not in NEEDS:
        raise FrameError("begin", f"method is one of {', '.join(NEEDS)}")
    if (begin.method == POSITIONS) != bool(begin.positions):
        raise FrameError("begin", f"`positions` is a key; it belongs to the method {POSITIONS}")
    if begin.positions and not KEY.match(begin.positions):
        raise FrameError("begin", "`positions` must be a key like sim/pose: letters, digits, _ / -")
    options = {"method": begin.method, "positions": begin.positions}
    return [f"--{name}={value}" for name, value in options.items() if value]

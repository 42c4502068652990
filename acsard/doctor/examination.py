"""Everything the doctor looks at, in order: from the configuration to a robot that drives.

It opens no port and sends nothing to a robot.
"""

from __future__ import annotations

from collections.abc import Iterator

from acsard.config.contradictions import warnings
from acsard.config.parsing import ConfigError, parse
from acsard.doctor.certificates import certificates
from acsard.doctor.daemon import daemon, door, routers
from acsard.doctor.finding import Finding
from acsard.doctor.machine import clock_and_scheduling, meddlers
from acsard.doctor.port import serial_port


def examine(where: str, text: bytes) -> Iterator[Finding]:
    """Everything there is to find; `where` is the configuration's place, `text` what it says."""
    try:
        config = parse(text)
    except ConfigError as error:
        for problem in error.problems:
            yield Finding("configuration", "failure", f"{where}: {problem}", "see acsard.toml")
        return
    yield Finding("configuration", "ok", where)
    for warning in warnings(config):
        yield Finding("configuration", "warning", warning, "see acsard.toml")
    yield from serial_port(config)
    yield from meddlers()
    yield from clock_and_scheduling()
    yield from certificates(config)
    yield from routers(config)
    yield from daemon(config)
    yield from door(config)

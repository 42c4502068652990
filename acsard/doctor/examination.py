"""Everything the doctor looks at, in order: from the configuration to a robot that drives.

It opens no port and sends nothing to a robot. Where a daemon runs, what it runs with is looked at:
the file may say something else by now, or options did.
"""

from __future__ import annotations

from collections.abc import Iterator

from acsard.config.contradictions import warnings
from acsard.config.parsing import ConfigError, parse
from acsard.doctor.certificates import certificates
from acsard.doctor.daemon import daemon, door, found, routers
from acsard.doctor.finding import Finding
from acsard.doctor.machine import clock_and_scheduling, meddlers
from acsard.doctor.port import serial_port
from acsard.doctor.running import Running, compared


def examine(where: str, text: bytes) -> Iterator[Finding]:
    """Everything there is to find; `where` is the configuration's place, `text` what it says."""
    try:
        config = parse(text)
    except ConfigError as error:
        for problem in error.problems:
            yield Finding("configuration", "failure", f"{where}: {problem}", "see acsard.toml")
        return
    yield Finding("configuration", "ok", where)
    running = found(config)
    if isinstance(running, Running):
        yield from compared(running, config)
        config = running.config
    for warning in warnings(config):
        yield Finding("configuration", "warning", warning, "see acsard.toml")
    yield from serial_port(config)
    yield from meddlers()
    yield from clock_and_scheduling()
    yield from certificates(config)
    yield from routers(config)
    if isinstance(running, Running):
        yield from daemon(running)
    else:
        yield running
    yield from door(config)

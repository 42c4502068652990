"""Everything the doctor looks at, in order: from the configuration to a robot that drives.

It opens no port and sends nothing to a robot. Where a daemon runs, what it runs with is looked at:
the file may say something else by now, or options did. Of one on another machine only what it says
of itself: its port, files and door are there.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

from acsard.bus.address import Address, address_of
from acsard.config.contradictions import warnings
from acsard.config.parsing import ConfigError, parse
from acsard.config.settings import Config
from acsard.doctor.certificates import certificates
from acsard.doctor.daemon import daemon, door, found, routers
from acsard.doctor.finding import Finding
from acsard.doctor.machine import clock_set, meddlers, scheduling
from acsard.doctor.port import serial_port
from acsard.doctor.running import Running, compared


def examine(
    where: str,
    text: bytes,
    given: dict[str, dict[str, object]],
    told: Callable[[Config], Address] = address_of,
) -> Iterator[Finding]:
    """Everything there is to find; `where` is the configuration's place, `text` what it says.

    `given` is what goes before the file, `told` where a file has its daemon. Raises `UsageError`
    for what is no such place.
    """
    try:
        config = parse(text, given)
    except ConfigError as error:
        for problem in error.problems:
            yield Finding("configuration", "failure", f"{where}: {problem}", "see acsard.toml")
        return
    yield Finding("configuration", "ok", where)
    address, written = told(config), ""
    running = found(config, address)
    if isinstance(running, Running) and not running.here:
        elsewhere = f"runs on another machine (its pid {running.info.pid} is none of acsard's here)"
        yield Finding("daemon", "ok", f"{elsewhere}: its port, files and door are looked at there")
        yield from certificates(address.tls)
        yield from daemon(running)
        return
    if isinstance(running, Running):
        yield from compared(running, config)
        config, written = running.config, config.bus.tls
    for warning in warnings(config):
        yield Finding("configuration", "warning", warning, "see acsard.toml")
    yield from serial_port(config)
    yield from meddlers()
    yield from clock_set()
    yield from scheduling(
        config.control.real_time, running.info.pid if isinstance(running, Running) else None
    )
    # The service has copies of its own, as they were: a file that is gone is missed in its place.
    for directory in dict.fromkeys((config.bus.tls, address.tls, written)):
        yield from certificates(directory)
    yield from routers(config)
    if isinstance(running, Running):
        yield from daemon(running)
    else:
        yield running
    yield from door(config)

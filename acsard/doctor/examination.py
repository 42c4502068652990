"""All examinations in their order, from the configuration to a moving robot.

The doctor opens no port and sends nothing to a robot. If a daemon runs, its own configuration is
examined, because the file may have changed since and options may override it. For a daemon on
another machine, only its own reports are examined: its port, files and gateway are there.
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
    """Yield all findings.

    Args:
        where: the path of the configuration, for messages.
        text: the content of the configuration file.
        given: values that override the file.
        told: returns the daemon's address for a configuration.

    Raises `UsageError` if that address is not an endpoint.
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
    # The service has copies of the certificates from its start. A file that has since been deleted
    # is reported at its original place.
    for directory in dict.fromkeys((config.bus.tls, address.tls, written)):
        yield from certificates(directory)
    yield from routers(config)
    if isinstance(running, Running):
        yield from daemon(running)
    else:
        yield running
    yield from door(config)

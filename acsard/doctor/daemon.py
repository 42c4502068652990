"""Examines the daemon: whether it can be reached, whether it runs, and its own reports."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from acsard.bus.address import Address
from acsard.bus.session import reachable
from acsard.config.settings import Config
from acsard.doctor.finding import LEVELS, Finding, Level
from acsard.doctor.link import check, link
from acsard.doctor.running import Running, answers, asked
from acsard.drive.gyro import WORDS
from acsard.host.errors import NoAnswerError
from acsard.messages.diagnostics import NO_ROUTER
from acsard.messages.schema import DiagnosticStatus
from acsard.values import NS_PER_S, AcsardError

APART_S = 0.4
"""Clock difference that is reported, s.

From 0.5 s on, Zenoh replaces the stamps of the clock that is ahead.
"""

GYRO_MENDS = {
    "used": "",
    "waiting for rest": "",
    "silent": "is its driver running, and does it send to the key imu (ROS: imu/data)?",
    "disagrees": "slower turns, other ground; if it stays so: its z must point up, in rad/s",
    "not believed": "its z must point up, in rad/s; then `acsard calibrate` finds the track",
}
"""Remedy for each gyro status in `state`; "" if the status is good."""

START = (
    "systemctl status acsard; or start it: acsard run; one that was started with --listen is asked "
    "by --connect and what that says"
)

ANOTHER = (
    "one with another id is asked by --id (`acsard fleet` shows who is there); or is another "
    "program on that port?"
)

ROUTER = "acsard: router"
LOOP = "acsard: control loop"
"""Names of rows in the daemon's diagnostics."""

SIGN = "commands signed as the README says need no common clock"


START_ROUTER = "start it there (rmw_zenohd, zenohd, `acsard router`): the daemon connects by itself"


PUT_ROUTER = (
    "robots that are joined directly hand on nothing: `acsard fleet` and `acsard call stop --id "
    "'*'` miss the others; a router that all connect to mends that (deploy/zenoh/README.md)"
)


def routers(config: Config) -> Iterator[Finding]:
    """Yield findings about the routers: whether they listen, and which rights they pass on."""
    for endpoint in config.bus.connect:
        if not answers(endpoint):
            yield Finding("router", "warning", f"nobody listens at {endpoint}", START_ROUTER)
        if endpoint.startswith("tls/"):
            continue
        text = f"connects to {endpoint}: everyone behind that router has the rights of this machine"
        yield Finding("bus", "warning", text, "keep the router on loopback, or behind TLS")


def found(config: Config, address: Address) -> Running | Finding:
    """Return the daemon that was reached and asked, or the finding that explains the failure.

    Raises `UsageError` if the address is not an endpoint.
    """
    endpoint = address.endpoint
    if not answers(endpoint):
        if config.bus.mode == "client" and endpoint in map(reachable, config.bus.connect):
            text = f"cannot be asked: the router at {endpoint}, by which it is reached, is missing"
            mend = "the router first; see `systemctl status acsard`"
            return Finding("daemon", "warning", text, mend)
        return Finding("daemon", "warning", f"nobody listens at {endpoint}", START)
    try:
        return asked(config, address)
    except NoAnswerError as error:
        return Finding("daemon", "failure", str(error), ANOTHER)
    except AcsardError as error:
        return Finding("daemon", "failure", str(error), "is another program on that port?")


def daemon(running: Running) -> Iterator[Finding]:
    """Yield the findings of the daemon's reports."""
    state = running.state
    level: Level = "failure" if state.mode == "fault" else "ok"
    mend = f"see the reason; `acsard call clear` releases it; {check(running)}"
    mend = mend if level == "failure" else ""
    yield Finding("daemon", level, f"{state.mode}: {state.reason}", mend)
    yield from link(running)
    yield from clocks(running)
    yield from gyro(state.gyro, state.counters)
    yield from linked({row.name: row for row in running.rows})
    if state.counters.get("door_crowded"):
        text = "all connections from the network were taken at times: the log says by whom"
        yield Finding("door", "warning", text, "take his certificate from [access], or his program")
    yield from latch_file(state.latch_file)
    yield from late(running)


def latch_file(trouble: str) -> Iterator[Finding]:
    """Report that a stop would be lost at a restart, if it would."""
    if trouble:
        mend = "free the disk, or name a directory that can be written: control.state_directory"
        yield Finding("latch file", "warning", trouble, mend)


def late(running: Running) -> Iterator[Finding]:
    """Yield a warning if the daemon misses control periods, over its whole run or recently.

    Its counters show the whole run, and its diagnostics the recent time.
    """
    counters = running.state.counters
    missed, lines = counters.get("missed_periods", 0), counters.get("lines_sent", 0)
    told = [row.message for row in running.rows if row.name == LOOP and row.level]
    if missed > 0.01 * max(1, lines):
        told = [f"missed {missed} control periods"]
    for text in told:
        mend = "what else runs here? `top`; the service runs real-time"
        yield Finding("daemon", "warning", text, mend)


def clocks(running: Running) -> Iterator[Finding]:
    """Yield warnings if clocks differ, or if stamps were replaced.

    The daemon's time was taken at some moment of the round trip. A daemon on this machine shares
    our clock.
    """
    its_ns, counters = running.state.stamp.to_ns(), running.state.counters
    apart = (its_ns - running.looked_ns) / NS_PER_S
    if not running.here and abs(apart) > APART_S + running.trip_ns / 2 / NS_PER_S:
        way = "ahead of" if apart > 0 else "behind"
        text = f"the daemon's clock is {abs(apart):.1f} s {way} this machine's"
        yield Finding("clock", "warning", text, f"let NTP set both (timedatectl); {SIGN}")
    replaced = counters.get("stamps_replaced", 0)
    if replaced:
        text = f"{replaced} commands came from clocks over 0.5 s ahead: their stamps were replaced"
        yield Finding("clock", "warning", text, f"let NTP set both clocks; {SIGN}")


def gyro(does: str, counters: Mapping[str, int]) -> Iterator[Finding]:
    """Yield findings about the gyro's status in `state` and about refused samples."""
    words = next((text for name, text in WORDS.items() if name == does), does)
    if does != "off":
        mend = GYRO_MENDS.get(does, "is the daemon of another version?")
        yield Finding("gyro", "warning" if mend else "ok", words, mend)
    refused = {n.removeprefix("imu_"): c for n, c in counters.items() if n.startswith("imu_") and c}
    if refused:
        most = sorted(refused.items(), key=lambda one: -one[1])
        told = ", ".join(f"{count} {reason.replace('_', ' ')}" for reason, count in most)
        mend = "the log says by whom (imu_refused); one gyro, rad/s, z up, finite values"
        yield Finding("gyro", "warning", f"samples on imu that did not count: {told}", mend)


def linked(rows: Mapping[str, DiagnosticStatus]) -> Iterator[Finding]:
    """Yield a finding about the daemon's connection to its routers, if any are configured."""
    row = rows.get(ROUTER)
    if row is not None:
        mend = START_ROUTER if row.level else ""
        if any(one.value == NO_ROUTER for one in row.values):
            mend = PUT_ROUTER
        yield Finding("router", LEVELS[min(row.level, 2)], f"the daemon is {row.message}", mend)


def door(config: Config) -> Iterator[Finding]:
    """Yield a finding for each endpoint of the TLS gateway."""
    for endpoint in config.bus.outside:
        if answers(endpoint):
            yield Finding("door", "ok", f"open at {endpoint}")
        else:
            mend = "systemctl status acsard-door; `acsard run` opens one by itself"
            yield Finding("door", "warning", f"nobody listens at {endpoint}", mend)

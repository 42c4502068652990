"""Examines whether the daemon can be reached, and evaluates the daemon's reports.

The doctor queries the configuration once and the state twice, a second apart: the counters'
differences show how well the serial link works.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from typing import cast

import msgspec
from msgspec import Struct
from msgspec.structs import replace

from acsard.bus.address import Address
from acsard.bus.zenoh_sessions import answers, reachable
from acsard.client import Client, connect
from acsard.core.codes import GUARD_CODES, HOST_CODES
from acsard.core.config.live import Difference, differences, find_live_setting
from acsard.core.config.parsing import from_builtins
from acsard.core.config.settings import SIMULATOR, BatteryConfig, Config, is_tls
from acsard.core.config.validation import write
from acsard.core.formatting import listed, many
from acsard.core.link.link_diagnosis import BUSY_ADVICE, MAX_UNANSWERED_FRACTION
from acsard.core.messages.diagnostics import NO_ROUTER
from acsard.core.messages.schema import (
    BatterySummary,
    DiagnosticStatus,
    Info,
    RobotState,
)
from acsard.core.motion import bumpers
from acsard.core.motion.battery import MISSING_REASON as NO_BATTERY
from acsard.core.motion.battery import empty_reason
from acsard.core.motion.battery import status_text as battery_words
from acsard.core.motion.emergency_stop import (
    MISSING_REASON,
    PRESSED_REASON,
    SILENT_REASON,
)
from acsard.core.motion.gyro import STATUS_TEXTS
from acsard.core.values import (
    NS_PER_S,
    AcsardError,
    BatteryLevel,
    BatteryStatus,
    GyroDoes,
    Ns,
    WallNs,
)
from acsard.host import clock
from acsard.host.errors import MendableError, NoAnswerError
from acsard.host.processes import is_daemon_here
from acsard.machine.finding import LEVELS, Finding, Level

MIN_JUDGED_LINES = 40  # fewer lines between the queries say nothing about lost lines

MAX_KEYS = 6  # in one finding of `compared`


# Set by options of `acsard run`, so a difference to the file is probably intended.
OPTION_KEYS = (
    "mcu.port", "mcu.baud_rate", "robot.id", "bus.listen", "bus.connect", "record.directory",
    "ros.namespace",
)  # fmt: skip

# Why a value may differ from the file: for which keys, level, reason, advice (`{which}`: "this
# value" or "these values"; `{lines}`: lines for the file).
DIFFERENCE_REASONS: tuple[tuple[Callable[[str], bool], Level, str, str], ...] = (
    (
        lambda key: key in OPTION_KEYS,
        "ok",
        "these values come from the options of `acsard run` or from another file, or the file has "
        "changed since the daemon started",
        "to keep {which} after a restart, write these lines into the configuration file: {lines}",
    ),
    (
        lambda key: key not in OPTION_KEYS and find_live_setting(key) is None,
        "warning",
        "these values come from another file or from the daemon's environment, or the file has "
        "changed since the daemon started",
        "if the daemon runs with another file, name that file with --config; otherwise either "
        "write the daemon's values into this file, or restart the daemon with this file. The "
        "findings below are about the running daemon",
    ),
    (
        lambda key: find_live_setting(key) is not None,
        "warning",
        "these values were set while the daemon ran, or come from another file, or the file has "
        "changed since the daemon started",
        "when the daemon starts again, it uses the file's values; `acsard set KEY VALUE --keep` "
        "writes a value into the file",
    ),
)


class Running(Struct, frozen=True):
    """The answers of a running daemon, with its state a second before in `before`."""

    info: Info
    config: Config
    before: RobotState
    state: RobotState
    queried_ns: WallNs  # middle of the query of `state`, by this machine's wall clock
    round_trip_ns: Ns = 0  # of the query of `state`
    rows: tuple[DiagnosticStatus, ...] = ()  # of the diagnostics
    is_local: bool = True  # it runs on this machine
    role: str = ""  # this client's role, certificate and name at the daemon


def query(config: Config, address: Address) -> Running:
    """Query the daemon for about a second. Raises an `AcsardError` without an answer.

    The local `config`, with the values of `info`, stands in for one that is not returned.
    """
    endpoint, robot_id, tls = address
    with connect(endpoint, robot_id=robot_id, tls=tls) as robot:
        info, before = robot.get("info"), robot.get("state")
        time.sleep(1.0)  # the daemon counts about a hundred lines in this time
        rows = tuple(robot.get("diagnostics").status)
        runs, is_local = _configuration(robot, info, config), is_daemon_here(info.pid)
        sent = clock.now()
        state, answered = robot.get("state"), clock.now()
        round_trip_ns = answered.mono_ns - sent.mono_ns
        queried_ns = sent.wall_ns + round_trip_ns // 2
        us = robot.whoami()
        role = f"{us.describe()}; your sender id is {us.sender}"
        return Running(info, runs, before, state, queried_ns, round_trip_ns, rows, is_local, role)


def _configuration(robot: Client, info: Info, file: Config) -> Config:
    # Otherwise `file`, with the values of `info`.
    try:
        return from_builtins(robot.get("config"))
    except (AcsardError, msgspec.ValidationError):  # not permitted, or a daemon of another version
        mcu = replace(file.mcu, port=SIMULATOR if info.simulated else info.port)
        bus = replace(file.bus, listen=tuple(info.listen), connect=tuple(info.connect))
        return replace(file, robot=replace(file.robot, id=info.id), mcu=mcu, bus=bus)


def compared(running: Running, file: Config) -> Iterator[Finding]:
    """Yield a finding for each row of `DIFFERENCE_REASONS` with keys that differ, or one ok."""
    info, others = running.info, differences(running.config, file)
    daemon_name = f"acsard {info.version}, pid {info.pid}"
    if not others:
        yield Finding(
            "configuration",
            "ok",
            f"the running daemon ({daemon_name}) uses the configuration file's values",
        )
        return
    for belongs, level, reason, mend in DIFFERENCE_REASONS:
        differing = {key: difference for key, difference in others.items() if belongs(key)}
        if not differing:
            continue
        texts = [difference.describe(key) for key, difference in differing.items()]
        text = f"the running daemon ({daemon_name}) has other values than the file ({reason}): "
        text += listed(texts, MAX_KEYS, "; ")
        mend = mend.format(
            which="these values" if len(differing) > 1 else "this value", lines=_tables(differing)
        )
        yield Finding("configuration", level, text, mend)


def _tables(differing: Mapping[str, Difference]) -> str:
    # The lines with which the file has the running daemon's values.
    parts = [(key.rpartition("."), write(difference.its)) for key, difference in differing.items()]
    return "; ".join(f"[{table}] {name} = {value}" for (table, _, name), value in parts)


def link(running: Running) -> Iterator[Finding]:
    """Yield findings about the serial link and, if it is up, the board's inputs and battery."""
    config, state = running.config, running.state
    mend = check(running)
    if state.link != "up":
        if state.link == "down":
            mend = (
                "see the finding about the serial port above"
                if running.is_local
                else "run `acsard doctor` on the daemon's machine, where it checks the serial port"
            )
        if config.mcu.simulated or state.code in HOST_CODES:
            mend = BUSY_ADVICE
        text = f"{state.link}: {state.why}" if state.mode == "waiting" else state.link
        yield Finding("link", "failure", text, mend)
        return
    passed = {
        key: count - running.before.counters.get(key, 0) for key, count in state.counters.items()
    }
    # Warn of lost links only if the link was lost more than once a day on average. So `often`, the
    # limit on the number of losses, is the number of days for which the daemon has run.
    often = state.counters.get("lines_sent", 0) / config.rate_hz / 86400
    # The built-in simulator runs in the daemon and is never unplugged. So if the link to the
    # simulator was lost, the daemon's computer did not run the daemon in time.
    if late := state.counters.get(f"link_lost{'' if config.mcu.simulated else '_host_stall'}", 0):
        late_times = many(late, "time")
        text = (
            f"the link was lost {late_times} since the daemon's start because the daemon's "
            "computer did not run the daemon in time"
        )
        yield Finding("link", "warning" if late > often else "ok", text, BUSY_ADVICE)
    problems = [*unanswered_lines(passed, config), *(refused(passed) or refused(state.counters))]
    for text in problems:
        yield Finding("link", "warning", text, mend)
    losses = [] if config.mcu.simulated else link_losses(state.counters)
    for times, text in losses:
        yield Finding("link", "warning" if times > often else "ok", text, mend)
    if not problems and not late and not losses:
        text = "the link is up, and almost all lines to and from the board arrive"
        if config.mcu.reply_period:
            text = (
                "the link is up, and the daemon can read the lines from the board; this tool "
                "cannot check the lines to the board, because a free-running board "
                "(mcu.reply_period is set) does not answer each line"
            )
        elif passed.get("lines_sent", 0) < MIN_JUDGED_LINES:
            text = (
                "the link is up, but the daemon sends too few lines in a second for this tool to "
                "check whether lines are lost"
            )
        yield Finding("link", "ok", text)
    if state.wheel_fault:
        advice = mend if config.feedback.encoders else NO_ENCODERS_ADVICE
        yield Finding("wheels", "warning", state.wheel_fault, advice)
    yield from _emergency_stop(config, state, mend)
    yield from _bumpers(config, state, mend)
    yield from _battery(config.battery, state.battery, mend)


def _emergency_stop(config: Config, state: RobotState, mend: str) -> Iterator[Finding]:
    if state.emergency_stop == "pressed":
        yield Finding(
            "emergency stop",
            "warning",
            PRESSED_REASON.text,
            f"{PRESSED_REASON.advice}, then `acsard call clear`",
        )
    elif state.emergency_stop == "silent":
        yield Finding("emergency stop", "failure", SILENT_REASON.text, SILENT_REASON.advice)
    elif state.emergency_stop:
        yield Finding(
            "emergency stop", "ok", "the board reports that the emergency stop is released"
        )
    elif config.safety.estop == "required":
        yield Finding("emergency stop", "failure", MISSING_REASON.text, mend)


def _bumpers(config: Config, state: RobotState, mend: str) -> Iterator[Finding]:
    safety, pressed = config.safety, state.bumpers
    if pressed is not None and any(pressed):
        # If the board has fallen silent, all bumpers count as pressed.
        todo = (
            f"{PRESSED_REASON.advice}; if none is pressed, {SILENT_REASON.advice}; then `acsard "
            "call clear`"
        )
        if safety.bumper == "away":
            todo = (
                "drive the robot in a straight line away from the obstacle; if the robot is "
                f"stopped, {todo}"
            )
        yield Finding("bumpers", "warning", bumpers.pressed_words(safety.bumpers, pressed), todo)
    elif pressed is not None:
        text = f"the board reports {many(len(pressed), 'bumper')}, and none is pressed"
        yield Finding("bumpers", "ok", text)
    elif safety.needs_bumpers:
        yield Finding("bumpers", "failure", bumpers.missing_reason(safety).text, mend)


def _battery(config: BatteryConfig, battery: BatterySummary | None, mend: str) -> Iterator[Finding]:
    if battery is None:
        if config.bounds:
            yield Finding("battery", "warning", NO_BATTERY, mend)
        return
    level = cast(BatteryLevel, battery.level)
    status = BatteryStatus(level, None, battery.volts, battery.percent, battery.amps)
    text = battery_words(config, status)
    if level == "ok":
        yield Finding("battery", "ok", text)
    elif level == "unknown":
        yield Finding("battery", "warning", text, mend)
    elif level == "stop":
        mend = f"{empty_reason(config).advice}, then `acsard call clear`"
        yield Finding("battery", "failure", text, mend)
    else:
        yield Finding("battery", "warning", text, "charge it")


def unanswered_lines(passed: Mapping[str, int], config: Config) -> Iterator[str]:
    """Yield a warning if too few lines were answered, by the counters' increase in a second.

    A free-running board (`mcu.reply_period`) does not answer each line.
    """
    sent, replies = passed.get("lines_sent", 0), passed.get("lines", 0)
    enough = replies >= (1 - MAX_UNANSWERED_FRACTION) * sent - 1
    if config.mcu.reply_period or sent < MIN_JUDGED_LINES or enough:
        return
    yield (
        f"the board answered only {replies} of the {sent} lines that the daemon sent in a second: "
        "the serial line loses data, or the board is free-running and does not answer each line"
    )


def refused(counters: Mapping[str, int]) -> list[str]:
    """Return a warning, in a list, if too many lines of the board were rejected."""
    kinds = {
        name.removeprefix("line_"): count
        for name, count in counters.items()
        if name.startswith("line_") and count
    }
    if sum(kinds.values()) <= MAX_UNANSWERED_FRACTION * max(1, counters.get("lines", 0)):
        return []
    reasons = ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in kinds.items())
    return [f"the daemon rejected lines from the microcontroller, by reason: {reasons}"]


def link_losses(counters: Mapping[str, int]) -> list[tuple[int, str]]:
    """Return how often the link was lost, with a sentence; not because this computer was late."""
    times = counters.get("link_lost", 0) - counters.get("link_lost_host_stall", 0)
    text = (
        f"the link was lost {many(times, 'time')} since the daemon's start: the board restarts, is "
        "silent at times or was unplugged; the events link_stale and link_down in the log say when"
    )
    return [(times, text)] if times > 0 else []


def check(running: Running) -> str:
    """Return the advice to run `acsard mcu check`, with the steps that must come first."""
    port = running.config.mcu.port
    return (
        f"`acsard mcu check --port {port}` finds the cause. Before you run it, lift the wheels off "
        f"the ground, and stop the daemon: `systemctl stop acsard`, or `kill {running.info.pid}`"
    )


# Advice by the status in `state`.
GYRO_MENDS: dict[GyroDoes, str] = {
    "used": "",
    "waiting for rest": "",
    "waiting for turn": "",
    "silent": "check that the gyro's driver runs, and that it publishes on the Zenoh key `imu` "
    "(the ROS topic imu/data)",
    "hangs": "check the gyro's cable and its driver: angular_velocity.z must change in its last "
    "digits even at rest",
    "disagrees": "if the wheels do not slip, measure the track with `acsard calibrate`, let the "
    "robot stand so that it learns the gyro's bias, and check the gyro's scale",
    "reversed": "check with `acsard mcu check` that the wheels turn the right way; if they do, "
    "mount the gyro with its z axis up, or let its driver negate angular_velocity.z",
    "in degrees": "let the gyro's driver send rad/s: divide the degrees per second by 57.3",
    "dead": "check the gyro's cable and its driver: angular_velocity.z must change when the robot "
    "turns",
    "not believed": "check that the gyro's z axis points up and that its driver sends rad/s; then "
    "measure the track width with `acsard calibrate`",
}

OTHER_VERSION_ADVICE = (
    "if the daemon has another version of acsard, run this tool from the same version"
)

NO_ENCODERS_ADVICE = (
    "nothing is wrong if the robot has no encoders; else set feedback.encoders = true"
)

ECHO_ADVICE = (
    "or let the clients echo the key beat (deploy/clients/README.md): commands with an echo do not "
    "need a common clock"
)

START_ROUTER_ADVICE = (
    "start the Zenoh router at that address (rmw_zenohd, zenohd or `acsard router`): the daemon "
    "then connects by itself"
)


def routers(config: Config) -> Iterator[Finding]:
    """Yield warnings about endpoints in `bus.connect` without a program, or without TLS."""
    for endpoint in config.bus.connect:
        if not answers(endpoint):
            yield Finding(
                "router", "warning", f"no program listens at {endpoint}", START_ROUTER_ADVICE
            )
        if is_tls(endpoint):
            continue
        text = (
            f"the daemon connects to the router at {endpoint} without TLS: every program that is "
            "connected to that router has the rights of this machine"
        )
        yield Finding(
            "bus",
            "warning",
            text,
            "let the router listen only on loopback, or let the daemon connect to it over TLS",
        )


def query_or_finding(config: Config, address: Address) -> Running | Finding:
    """Return the daemon's answers, or a finding. Raises `UsageError` for an invalid endpoint."""
    endpoint = address.endpoint
    if not answers(endpoint):
        if config.bus.mode == "client" and endpoint in map(reachable, config.bus.connect):
            text = (
                f"this tool reaches the daemon only through the Zenoh router at {endpoint}, and no "
                "program listens there"
            )
            mend = (
                "start that router (rmw_zenohd, zenohd or `acsard router`), then run `acsard "
                "doctor` again; until then, `systemctl status acsard` shows the state of the daemon"
            )
            return Finding("daemon", "warning", text, mend)
        mend = (
            "if the daemon is a systemd service, `systemctl status acsard` shows why it does not "
            "run; otherwise start it with `acsard run`. If the daemon was started with --listen "
            "ADDRESS, give this command the same address with --connect"
        )
        return Finding("daemon", "warning", f"no program listens at {endpoint}", mend)
    try:
        return query(config, address)
    except NoAnswerError as error:
        mend = (
            "if the daemon has another robot id, name that id with --id (`acsard fleet` lists the "
            "robots); otherwise check whether another program listens at that address"
        )
        return Finding("daemon", "failure", str(error), mend)
    except MendableError as error:
        # The text of such an error contains the advice.
        return Finding("daemon", "failure", str(error))
    except AcsardError as error:
        return Finding("daemon", "failure", str(error), OTHER_VERSION_ADVICE)


def daemon(running: Running) -> Iterator[Finding]:
    """Yield findings about the robot and its daemon."""
    state = running.state
    level: Level = "failure" if state.mode == "fault" else "ok"
    mend = (
        "correct the cause that this reason names, then release the fault with `acsard call "
        f"clear`; {check(running)}"
    )
    if state.code in GUARD_CODES:
        mend = (
            "this is a defect of acsard: report it with the newest recording (`acsard recording` "
            "lists the recordings), then release the fault with `acsard call clear`"
        )
    mend = mend if level == "failure" else ""
    yield Finding("daemon", level, f"{state.mode}: {state.why}", mend)
    yield Finding("role", "ok", running.role)
    yield from link(running)
    yield from clocks(running)
    yield from gyro(state.gyro, state.counters)
    rows = {row.name: row for row in running.rows}
    yield from linked(rows.get("acsard: router"))
    yield from certificate(rows.get("acsard: certificate"), running.is_local)
    if state.counters.get("gateway_full"):
        text = (
            "at times, clients from the network used all connections of the TLS gateway: the log "
            "names these clients"
        )
        mend = "remove such a client's certificate from [access], or end the client's program"
        yield Finding("gateway", "warning", text, mend)
    if state.latch_file_error:
        mend = "free disk space, or set control.state_directory to a writable directory"
        yield Finding("latch file", "warning", state.latch_file_error, mend)
    # If the daemon runs on this machine, `compared` reports these differences.
    if state.settings_differ and not running.is_local:
        mend = (
            "when the daemon restarts, it uses the values of the file; `acsard set KEY VALUE "
            "--keep` on the robot writes a value into the file"
        )
        text = f"settings were changed since the daemon's start: {state.settings_differ}"
        yield Finding("configuration", "warning", text, mend)
    yield from late(running)


def certificate(row: DiagnosticStatus | None, is_local: bool) -> Iterator[Finding]:
    """Yield a finding if a certificate of the daemon or its TLS gateway expires soon."""
    if row is None or not row.level:
        return
    mend = "run `acsard doctor` on the daemon's machine, where it examines the certificate files"
    if is_local:
        mend = (
            "if you have already renewed the certificate files of the findings above, give the "
            "services copies of them: run `sudo systemctl try-reload-or-restart acsard-gateway "
            "acsard-web`, and if the robot connects to a router, also `sudo systemctl reload "
            "acsard`. The daemon uses the new files for its next connection. A restart of the "
            "daemon ends this warning at once, but stops the robot"
        )
    text = f"the daemon's certificate that expires first: {row.message}"
    yield Finding("certificates", LEVELS[min(row.level, 2)], text, mend)


MAX_MISSED_FRACTION = 0.01  # of the control periods


def late(running: Running) -> Iterator[Finding]:
    """Yield a warning about 1 % of missed periods since the start, or recent ones."""
    counters = running.state.counters
    missed, lines = counters.get("missed_periods", 0), counters.get("lines_sent", 0)
    messages = [
        row.message for row in running.rows if row.name == "acsard: control loop" and row.level
    ]
    if missed > MAX_MISSED_FRACTION * max(1, lines):
        messages = [f"the daemon missed {missed} control periods"]
    for text in messages:
        mend = (
            "`top` shows which other program uses the processor; a daemon that runs as the systemd "
            "service has real-time priority"
        )
        yield Finding("daemon", "warning", text, mend)


def clocks(running: Running) -> Iterator[Finding]:
    """Yield warnings about clocks.

    Another machine's differs by more than 0.4 s plus half of the query, or a client's was more than
    0.5 s ahead, so that Zenoh replaced its stamps.
    """
    its_ns, counters = running.state.stamp.to_ns(), running.state.counters
    apart = (its_ns - running.queried_ns) / NS_PER_S
    # The limit of 0.4 s is a little below the 0.5 s from which on Zenoh replaces time stamps. The
    # daemon has read its clock at an unknown moment between the query and the answer.
    if not running.is_local and abs(apart) > 0.4 + running.round_trip_ns / 2 / NS_PER_S:
        way = "ahead of" if apart > 0 else "behind"
        text = f"the daemon's clock is {abs(apart):.1f} s {way} this machine's"
        yield Finding(
            "clock",
            "warning",
            text,
            f"let NTP set the clocks of both machines (timedatectl), {ECHO_ADVICE}",
        )
    replaced = counters.get("stamps_replaced", 0)
    if replaced:
        text = (
            f"{replaced} commands came from computers with clocks more than 0.5 s ahead: Zenoh "
            "replaced the time stamps of these commands"
        )
        yield Finding(
            "clock", "warning", text, f"let NTP set the clocks of daemon and clients, {ECHO_ADVICE}"
        )


def gyro(does: str, counters: Mapping[str, int]) -> Iterator[Finding]:
    """Yield findings about the gyro's status and rejected samples."""
    if does != "off":
        status = cast(GyroDoes, does)  # a daemon of another version may have another status
        mend = GYRO_MENDS.get(
            status, f"this tool does not know this status of the gyro: {OTHER_VERSION_ADVICE}"
        )
        yield Finding("gyro", "warning" if mend else "ok", STATUS_TEXTS.get(status, does), mend)
    refused = {n.removeprefix("imu_"): c for n, c in counters.items() if n.startswith("imu_") and c}
    if refused:
        most = sorted(refused.items(), key=lambda item: -item[1])
        reasons = ", ".join(f"{count} {reason.replace('_', ' ')}" for reason, count in most)
        mend = (
            "the event imu_refused in the log names the sender: let the sender send finite values "
            "in rad/s, from only one gyro, whose z axis points up"
        )
        yield Finding(
            "gyro",
            "warning",
            f"the daemon rejected samples on the Zenoh key `imu`, by reason: {reasons}",
            mend,
        )


def linked(row: DiagnosticStatus | None) -> Iterator[Finding]:
    """Yield a finding about the connection to routers, by the row of the diagnostics."""
    if row is not None:
        mend = START_ROUTER_ADVICE if row.level else ""
        if any(pair.value == NO_ROUTER for pair in row.values):
            mend = (
                "a daemon does not forward the messages of other daemons, so `acsard fleet` and "
                "`acsard call stop --id '*'` do not reach a robot that is connected only to "
                "another daemon: connect all robots to a Zenoh router (deploy/zenoh/README.md)"
            )
        yield Finding("router", LEVELS[min(row.level, 2)], f"the daemon is {row.message}", mend)


def gateway(config: Config) -> Iterator[Finding]:
    """Yield a finding for each endpoint of the TLS gateway: does a program listen there?"""
    for endpoint in config.bus.outside:
        if answers(endpoint):
            yield Finding("gateway", "ok", f"open at {endpoint}")
        else:
            mend = (
                "`systemctl status acsard-gateway` shows why the TLS gateway does not run; without "
                "the systemd service, `acsard run` starts a gateway by itself"
            )
            yield Finding("gateway", "warning", f"no program listens at {endpoint}", mend)

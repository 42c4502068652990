"""Makes the rows of the message `diagnostics`, which rqt_robot_monitor and `acsard doctor` show.

OK needs no attention, WARN a person should know, ERROR keeps the robot from driving. A row that is
not OK has the value `advice`: what a person can do. Each message has the same rows, because a
missing one is shown as stale. Only those of the board's inputs and battery appear with the first
report, or from the start if they are required, until a board without them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import cast

from msgspec import Struct

from acsard.core.codes import GUARD_CODES, HOST_CODES, PoseCode, sentence
from acsard.core.config.settings import Config
from acsard.core.config.wire_time import wire_use
from acsard.core.formatting import many
from acsard.core.link.link_diagnosis import BUSY_ADVICE, MAX_UNANSWERED_FRACTION
from acsard.core.messages.certificate_expiry import CERTIFICATE_LEVELS
from acsard.core.messages.schema import (
    DiagnosticArray,
    DiagnosticStatus,
    Header,
    KeyValue,
    RobotState,
    Time,
)
from acsard.core.messages.snapshot import Snapshot
from acsard.core.motion import battery
from acsard.core.motion.arbiter_text import waiting
from acsard.core.motion.bumpers import missing_reason
from acsard.core.motion.emergency_stop import (
    DRIVER_FAULT_REASON,
    MISSING_REASON,
    PRESSED_REASON,
    SILENT_REASON,
)
from acsard.core.motion.gyro import STATUS_TEXTS
from acsard.core.values import (
    GyroDoes,
    Instant,
    Recording,
    RoutersStatus,
)

OK, WARN, ERROR = 0, 1, 2

MODE_LEVELS = {"stopped": WARN, "fault": ERROR}  # of modes; others are OK

# Rows by the state of the emergency-stop input.
BOARD = {
    "": (OK, "no emergency-stop input", ""),
    "released": (OK, "emergency stop released", ""),
    "pressed": (WARN, PRESSED_REASON.text, PRESSED_REASON.advice),
    "silent": (ERROR, SILENT_REASON.text, SILENT_REASON.advice),
}

BATTERY_LEVELS = {"ok": OK, "warning": WARN, "stop": ERROR, "unknown": WARN}

SHOW_REFUSAL_S = 2.0  # two messages at the default 1 Hz

MAX_MISSED_FRACTION = 0.01  # of the last minute's periods, above which this warns

NO_ROUTER, NOT_YET = "a peer, not a router", "not connected yet"

SIMULATOR_ADVICE = (
    "to drive a robot, set mcu.port to the board's serial port; `acsard ports` lists the ports"
)

PORT_ADVICE = "plug the board in if it is not; `acsard ports` lists the serial ports"

ACTIVATE = "if no check runs, type `acsard call activate`"

CLEAR = "then look at the robot, and type `acsard call clear`"

DEFECT = (
    "this is a defect of acsard: report it with the newest recording (`acsard recording` lists the "
    f"recordings), {CLEAR}"
)

# Advice by the status of the gyro.
GYRO_ADVICE: dict[GyroDoes, str] = {
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

# Level, text, and advice for a level that is not OK.
Finding = tuple[int, str, str]


class Row(Struct, frozen=True):
    """A row about one part of the robot, with details as text in `values`."""

    name: str
    level: int
    message: str
    values: dict[str, str]
    advice: str = ""


def diagnostics(
    config: Config,
    now: Instant,
    snapshot: Snapshot,
    certificate: tuple[str, str],
) -> DiagnosticArray:
    """Return the message with one row for each part of the robot.

    `certificate` is the result of `expiry`, or two "" for no such row.
    """
    rows = [
        _mode(snapshot.state),
        _serial_link(config, snapshot),
        _control_loop(snapshot),
        _commands(snapshot),
        _wheels(config, snapshot),
        *_board(config, snapshot),
        *_battery(config, snapshot),
        *_gyro(snapshot),
        *_routers(config.bus.connect, snapshot.routers),
        *_recording(snapshot.recording),
        *_latch_file(snapshot.latch_file),
        *_certificate(*certificate),
        _settings(snapshot.state.settings_differ),
    ]
    return DiagnosticArray(
        Header(Time.from_ns(now.wall_ns)),
        [
            DiagnosticStatus(
                row.level,
                f"acsard: {row.name}",
                row.message,
                config.robot.id,
                [KeyValue(key, value) for key, value in row.values.items()]
                + ([KeyValue("advice", row.advice)] if row.advice else []),
            )
            for row in rows
        ],
    )


def _row(name: str, findings: Sequence[Finding], values: dict[str, str]) -> Row:
    level = max(level for level, _, _ in findings)
    advice = dict.fromkeys(advice for level, _, advice in findings if level and advice)
    return Row(name, level, "; ".join(text for _, text, _ in findings), values, "; ".join(advice))


def _mode(status: RobotState) -> Row:
    advice = ""
    if status.mode == "stopped":
        advice = f"remove the cause, {CLEAR}"
    elif status.mode == "fault":
        advice = DEFECT if status.code in GUARD_CODES else f"correct the cause, {CLEAR}"
    values = {"mode": status.mode, "code": status.code, "source": status.source}
    return Row("mode", MODE_LEVELS.get(status.mode, OK), status.reason, values, advice)


def _check(config: Config) -> str:
    return (
        f"lift the wheels off the ground, and type `acsard mcu check --port {config.mcu.port}` on "
        "this robot's computer: it finds the cause, and the daemon lends it the port meanwhile"
    )


def _serial_link(config: Config, snapshot: Snapshot) -> Row:
    mcu, state = config.mcu, snapshot.state
    use = wire_use(config.rate_hz, mcu.baud_rate, mcu.line_bytes)
    named = zip(config.mcu.wheels.names, state.encoder_counts, strict=False)
    values = {"port": mcu.port, "wire_use": f"{use:.2f}", "check": snapshot.check}
    if _is_reason(state):
        values["code"] = state.code
    if state.feedback_age is not None:
        values["feedback_age_s"] = f"{state.feedback_age:.2f}"
    values |= {f"counts_{name}": str(counts) for name, counts in named if counts}
    values |= _counted(state.counters, "line") | _counted(state.counters, "link")
    return _row("serial link", [*_link(config, snapshot)], values)


def _is_reason(status: RobotState) -> bool:
    # The robot waits because of the link.
    return status.mode == "waiting" and status.link != "up"


def _link(config: Config, snapshot: Snapshot) -> Iterator[Finding]:
    status, counters, simulated = snapshot.state, snapshot.state.counters, config.mcu.simulated
    by_host = simulated or status.code in HOST_CODES
    advice = BUSY_ADVICE if by_host else _check(config)
    if status.link == "down" and not simulated:
        advice = ACTIVATE if snapshot.port_released else PORT_ADVICE
    if status.link == "up":
        yield OK, "up", ""
    else:
        # The advice says more about the check.
        reason = status.reason.removesuffix(" `acsard mcu check` finds out more").rstrip(";")
        why = f": {reason}" if _is_reason(status) else ""
        yield ERROR, f"{status.link}{why}", advice
    if status.pose_doubt not in ("", "gyro_disagrees", "not_calibrated"):
        doubt = sentence(cast("PoseCode", status.pose_doubt))
        yield WARN, doubt.text + snapshot.counts_figures, ""
    if simulated:
        yield WARN, "this is the simulator, no real wheel turns", SIMULATOR_ADVICE
    if snapshot.unanswered:
        yield WARN, "the board does not answer each line", advice
    refused = {name: n for name, n in counters.items() if name.startswith("line_") and n}
    if sum(refused.values()) > MAX_UNANSWERED_FRACTION * max(1, counters.get("lines", 0)):
        kinds = ", ".join(f"{n} {name[5:].replace('_', ' ')}" for name, n in refused.items())
        yield WARN, f"lines of the board were rejected: {kinds}", advice
    # More than once a day on average.
    days = counters.get("lines_sent", 0) / config.rate_hz / 86400
    late = counters.get(f"link_lost{'' if simulated else '_host_stall'}", 0)
    if late > days:
        times = many(late, "time")
        yield WARN, f"lost {times}, because this computer did not run the daemon", BUSY_ADVICE
    lost = counters.get("link_lost", 0) - late
    if lost > days:
        yield WARN, f"lost {many(lost, 'time')} since the start", advice


def _control_loop(snapshot: Snapshot) -> Row:
    figures, counters = snapshot.state.latencies, snapshot.state.counters
    missed = snapshot.missed_last_minute
    lateness = figures.get("period_lateness")
    run_count = lateness.last_minute.count if lateness else 0
    values = {
        f"{name}{when}_{share}_us": f"{getattr(spread, share):.0f}"
        for name, figure in figures.items()
        for when, spread in (("", figure.since_start), ("_minute", figure.last_minute))
        for share in ("p50", "p99", "max")
    }
    level = WARN if missed > MAX_MISSED_FRACTION * (run_count + missed) else OK
    return Row(
        "control loop",
        level,
        f"{missed} of {run_count + missed} periods missed in the last minute",
        values | _counted(counters, "missed") | _counted(counters, "bus"),
        BUSY_ADVICE if level else "",
    )


def _commands(snapshot: Snapshot) -> Row:
    values = {s.name: waiting(s.waits_for).text or "driving" for s in snapshot.sources}
    values |= _counted(snapshot.state.counters, "command")
    driver = snapshot.state.source
    findings = [(OK, f"commanded by {driver}" if driver else "waiting for a command", "")]
    if snapshot.state.speed_limit:
        findings.append((OK, f"speed limit: {snapshot.state.speed_limit}", ""))
    for source in snapshot.sources:
        if source.waits_for.what == "senders":
            text = (
                f"{source.waits_for.senders + 1} programs send as {source.name}, and the robot "
                "follows one of them"
            )
            advice = "end the other programs, or give each program its own source"
            findings.append((WARN, text, advice))
    age_s = snapshot.refused_age_s
    if age_s is not None and age_s < SHOW_REFUSAL_S:
        findings.append((WARN, f"refused: {snapshot.state.refused}", ""))
    return _row("commands", findings, values)


def _wheels(config: Config, snapshot: Snapshot) -> Row:
    text, counters = snapshot.state.wheel_fault, snapshot.state.counters
    advice = _check(config)
    if not config.feedback.encoders:
        advice = "if the robot has encoders, set feedback.encoders = true"
    values = {
        "left_out": ", ".join(snapshot.excluded),
        "slipping": ", ".join(snapshot.slipping),
    }
    values |= _counted(counters, "wheel_fault") | _counted(counters, "uncommanded_motion")
    if not text:
        return Row("wheels", OK, "every wheel obeys its command", values)
    return Row("wheels", WARN, text, values, advice)


def _board(config: Config, snapshot: Snapshot) -> list[Row]:
    safety, state = config.safety, snapshot.state
    required = safety.estop == "required"
    if not (snapshot.board or required or safety.needs_bumpers):
        return []
    findings = [BOARD[state.emergency_stop]]
    if required and not state.emergency_stop:
        findings = [(ERROR, MISSING_REASON.text, _check(config))]
    if snapshot.bumper is not None:
        level = ERROR if snapshot.bumper.code == "bumpers_silent" else WARN
        findings.append((level, snapshot.bumper.text, snapshot.bumper.advice))
    elif state.bumpers is not None:
        findings.append((OK, f"{many(len(state.bumpers), 'bumper')} released", ""))
    elif safety.needs_bumpers:
        findings.append((ERROR, missing_reason(safety).text, _check(config)))
    if snapshot.board.get("motor_driver") == "fault":
        findings.append((ERROR, DRIVER_FAULT_REASON.text, DRIVER_FAULT_REASON.advice))
    counted: dict[str, str] = {}
    for kind in ("line_status", "emergency", "bumper"):
        counted |= _counted(snapshot.state.counters, kind)
    return [_row("board", findings, snapshot.board | counted)]


def _battery(config: Config, snapshot: Snapshot) -> list[Row]:
    status, bounds = snapshot.battery, config.battery.bounds
    if status is None:
        missing = Row("battery", WARN, battery.MISSING_REASON, {}, _check(config))
        return [missing] if bounds else []
    values: dict[str, str] = {"level": status.level}
    numbers = {
        "volts": status.volts,
        "percent": status.percent,
        "amperes": status.amps,
        "mean": status.mean if bounds else None,
    }
    values |= {name: f"{value:.2f}" for name, value in numbers.items() if value is not None}
    values |= {f"{level}_below": f"{below:g}" for level, below in bounds.items()}
    advice = {
        "ok": "",
        "warning": "charge the battery",
        "stop": f"{battery.empty_reason(config.battery).advice}, {CLEAR}",
        "unknown": _check(config),
    }
    text, level = battery.status_text(config.battery, status), status.level
    return [Row("battery", BATTERY_LEVELS[level], text, values, advice[level])]


def _gyro(snapshot: Snapshot) -> list[Row]:
    does, bias = cast("GyroDoes", snapshot.state.gyro), snapshot.gyro_bias
    if does == "off":
        return []
    values = {} if bias is None else {"bias_rad_s": f"{bias:.5f}"}
    values |= _counted(snapshot.state.counters, "imu_")
    advice = GYRO_ADVICE.get(does, "")
    return [Row("gyro", WARN if advice else OK, STATUS_TEXTS[does], values, advice)]


def _routers(endpoints: Sequence[str], routers: RoutersStatus) -> list[Row]:
    missing, peers = routers.missing, routers.peers
    values = dict.fromkeys(endpoints, NOT_YET) | dict.fromkeys(routers.connected, "connected")
    values |= dict.fromkeys(missing, "not connected") | dict.fromkeys(peers, NO_ROUTER)
    words = NOT_YET if NOT_YET in values.values() else "connected"
    advice = ""
    if missing:
        words = f"not connected to {', '.join(missing)}"
        advice = (
            "start the Zenoh router at that address (rmw_zenohd, zenohd or `acsard router`): the "
            "daemon then connects by itself"
        )
    if peers:
        advice = "connect all robots to a Zenoh router (page howto/fleet of the manual)"
        words += (
            f"; {', '.join(peers)} is not a router: clients that connect to this daemon see only "
            "this robot"
        )
    level = WARN if missing or peers else OK
    return [Row("router", level, words, values, advice)] if values else []


def _recording(recording: Recording) -> list[Row]:
    if not recording.where:
        return []
    missing = {"steps_missing": str(recording.missing)}
    if not recording.trouble:
        return [Row("recording", OK, "on", missing)]
    advice = "free disk space, or set record.directory to a writable directory"
    return [Row("recording", WARN, recording.trouble, missing, advice)]


def _certificate(code: str, text: str) -> list[Row]:
    if not code:
        return []
    level = CERTIFICATE_LEVELS[code]
    advice = "run `acsard doctor` on the daemon's machine, where it examines the certificate files"
    return [Row("certificate", level, text, {}, advice if level else "")]


def _latch_file(trouble: str | None) -> list[Row]:
    if trouble is None:
        return []
    if not trouble:
        return [Row("latch file", OK, "written", {})]
    advice = "free disk space, or set control.state_directory to a writable directory"
    return [Row("latch file", WARN, trouble, {}, advice)]


def _settings(differ: str) -> Row:
    changed = f"changed since the daemon's start: {differ}" if differ else "those of the start"
    return Row("settings", OK, changed, {})


def _counted(counters: dict[str, int], kind: str) -> dict[str, str]:
    return {name: str(count) for name, count in counters.items() if name.startswith(kind)}

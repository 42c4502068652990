"""Makes the rows of the message `diagnostics`, which rqt_robot_monitor shows.

OK needs no attention, WARN a person should know, ERROR keeps the robot from driving. Each message
has the same rows, because a missing one is shown as stale. Only those of the board's inputs and
battery appear with the first report, or from the start if they are required, until a board without
them.
"""

from __future__ import annotations

from collections.abc import Sequence

from msgspec import Struct

from acsard.core.codes import sentence
from acsard.core.config.settings import Config
from acsard.core.config.wire_time import wire_use
from acsard.core.formatting import many
from acsard.core.messages.certificate_expiry import CERTIFICATE_LEVELS
from acsard.core.messages.schema import DiagnosticArray, DiagnosticStatus, Header, KeyValue, Time
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
    WHEELS,
    GyroStatus,
    Instant,
    Measured,
    Recording,
    RoutersStatus,
    Snapshot,
    WheelsStatus,
)

OK, WARN, ERROR = 0, 1, 2

MODE_LEVELS = {"stopped": WARN, "fault": ERROR}  # of modes; others are OK

# Rows by the state of the emergency-stop input.
BOARD = {
    "": (OK, "no emergency-stop input"),
    "released": (OK, "emergency stop released"),
    "pressed": (WARN, PRESSED_REASON.text),
    "silent": (ERROR, SILENT_REASON.text),
}

BATTERY_LEVELS = {"ok": OK, "warning": WARN, "stop": ERROR, "unknown": WARN}

SHOW_REFUSAL_S = 2.0  # two messages at the default 1 Hz

MAX_MISSED_FRACTION = 0.01  # of the last minute's periods, above which this warns

NO_ROUTER, NOT_YET = "a peer, not a router", "not connected yet"


class Row(Struct, frozen=True):
    """A row about one part of the robot, with details as text in `values`."""

    name: str
    level: int
    message: str
    values: dict[str, str]


def diagnostics(
    config: Config,
    now: Instant,
    snapshot: Snapshot,
    certificate: tuple[str, str],
) -> DiagnosticArray:
    """Return the message with one row for each part of the robot.

    `certificate` is the result of `expiry`, or two "" for no such row.
    """
    status = snapshot.status
    mode = {"mode": status.mode, "source": status.source}
    rows = [
        Row("mode", MODE_LEVELS.get(status.mode, OK), status.reason, mode),
        _serial_link(config, snapshot),
        _control_loop(snapshot),
        _commands(snapshot),
        _wheels(snapshot.doubt, snapshot.counters),
        *_board(config, snapshot),
        *_battery(config, snapshot),
        *_gyro(snapshot.gyro),
        *_routers(config.bus.connect, snapshot.routers),
        *_recording(snapshot.recording),
        *_latch_file(snapshot.latch_file),
        *_certificate(*certificate),
    ]
    return DiagnosticArray(
        Header(Time.from_ns(now.wall_ns)),
        [
            DiagnosticStatus(
                row.level,
                f"acsard: {row.name}",
                row.message,
                config.robot.id,
                [KeyValue(key, value) for key, value in row.values.items()],
            )
            for row in rows
        ],
    )


def _serial_link(config: Config, snapshot: Snapshot) -> Row:
    mcu = config.mcu
    use = wire_use(config.rate_hz, mcu.baud_rate, mcu.line_bytes)
    named = zip(WHEELS, snapshot.encoders, strict=False)
    values = {"port": mcu.port, "wire_use": f"{use:.2f}", "check": snapshot.check}
    if snapshot.feedback_age_s is not None:
        values["feedback_age_s"] = f"{snapshot.feedback_age_s:.2f}"
    values |= {f"counts_{name}": str(counts) for name, counts in named if counts}
    link = snapshot.status.link
    level, message = OK if link == "up" else ERROR, link
    if snapshot.pose_doubt:
        level, message = max(level, WARN), f"{message}; {sentence(snapshot.pose_doubt).text}"
    if mcu.simulated:
        level, message = max(level, WARN), f"{message}: this is the simulator, no real wheel turns"
    return Row("serial link", level, message, values | _counted(snapshot.counters, "line"))


def _control_loop(snapshot: Snapshot) -> Row:
    figures, missed = snapshot.figures, snapshot.missed_last_minute
    run_count = figures.get("period_lateness", Measured()).last_minute.count
    values = {
        f"{name}{when}_{share}_us": f"{getattr(spread, share):.0f}"
        for name, figure in figures.items()
        for when, spread in (("", figure.since_start), ("_minute", figure.last_minute))
        for share in ("p50", "p99", "max")
    }
    return Row(
        "control loop",
        WARN if missed > MAX_MISSED_FRACTION * (run_count + missed) else OK,
        f"{missed} of {run_count + missed} periods missed in the last minute",
        values | _counted(snapshot.counters, "missed") | _counted(snapshot.counters, "bus"),
    )


def _commands(snapshot: Snapshot) -> Row:
    values = {s.name: waiting(s.waits_for).text or "driving" for s in snapshot.sources}
    values |= _counted(snapshot.counters, "command")
    driver = snapshot.status.source
    message = f"commanded by {driver}" if driver else "waiting for a command"
    if snapshot.speed_limit:
        message = f"{message}; speed limit: {snapshot.speed_limit}"
    crowded = [s for s in snapshot.sources if s.waits_for.what == "senders"]
    for source in crowded:
        message = (
            f"{message}; {source.waits_for.senders + 1} programs send as {source.name}, and the "
            "robot follows one of them: end the other programs, or give each program its own source"
        )
    age_s = snapshot.refused_age_s
    refused = age_s is not None and age_s < SHOW_REFUSAL_S
    if refused:
        message = f"{message}; refused: {snapshot.refused}"
    return Row("commands", WARN if refused or crowded else OK, message, values)


def _wheels(doubt: WheelsStatus, counters: dict[str, int]) -> Row:
    values = {
        "left_out": ", ".join(doubt.left_out),
        "slipping": ", ".join(doubt.slipping),
    }
    level = WARN if doubt.text else OK
    message = doubt.text or "every wheel obeys its command"
    values |= _counted(counters, "wheel_fault") | _counted(counters, "uncommanded_motion")
    return Row("wheels", level, message, values)


def _board(config: Config, snapshot: Snapshot) -> list[Row]:
    safety, bumpers = config.safety, snapshot.bumpers
    required = safety.estop == "required"
    if not (snapshot.board or required or safety.needs_bumpers):
        return []
    findings = [BOARD[snapshot.estop]]
    if required and not snapshot.estop:
        findings = [(ERROR, MISSING_REASON.text)]
    if snapshot.bumper is not None:
        level = ERROR if snapshot.bumper.code == "bumpers_silent" else WARN
        findings.append((level, snapshot.bumper.text))
    elif bumpers is not None:
        findings.append((OK, f"{many(len(bumpers), 'bumper')} released"))
    elif safety.needs_bumpers:
        findings.append((ERROR, missing_reason(safety).text))
    if snapshot.board.get("motor_driver") == "fault":
        findings.append((ERROR, DRIVER_FAULT_REASON.text))
    counted: dict[str, str] = {}
    for kind in ("line_status", "emergency", "bumper"):
        counted |= _counted(snapshot.counters, kind)
    level, message = max(level for level, _ in findings), "; ".join(text for _, text in findings)
    return [Row("board", level, message, snapshot.board | counted)]


def _battery(config: Config, snapshot: Snapshot) -> list[Row]:
    status, bounds = snapshot.battery, config.battery.bounds
    if status is None:
        return [Row("battery", WARN, battery.MISSING_REASON, {})] if bounds else []
    values: dict[str, str] = {"level": status.level}
    numbers = {
        "volts": status.volts,
        "percent": status.percent,
        "amperes": status.amps,
        "mean": status.mean if bounds else None,
    }
    values |= {name: f"{value:.2f}" for name, value in numbers.items() if value is not None}
    values |= {f"{level}_below": f"{below:g}" for level, below in bounds.items()}
    return [
        Row(
            "battery",
            BATTERY_LEVELS[status.level],
            battery.status_text(config.battery, status),
            values,
        )
    ]


def _gyro(gyro: GyroStatus) -> list[Row]:
    if gyro.does == "off":
        return []
    values = {} if gyro.bias is None else {"bias_rad_s": f"{gyro.bias:.5f}"}
    level = OK if gyro.does in ("used", "waiting for rest", "waiting for turn") else WARN
    return [Row("gyro", level, STATUS_TEXTS[gyro.does], values)]


def _routers(endpoints: Sequence[str], routers: RoutersStatus) -> list[Row]:
    missing, peers = routers.missing, routers.peers
    values = dict.fromkeys(endpoints, NOT_YET) | dict.fromkeys(routers.connected, "connected")
    values |= dict.fromkeys(missing, "not connected") | dict.fromkeys(peers, NO_ROUTER)
    words = NOT_YET if NOT_YET in values.values() else "connected"
    if missing:
        words = f"not connected to {', '.join(missing)}"
    if peers:
        words += (
            f"; {', '.join(peers)} is not a router: clients that connect to this daemon see only "
            "this robot"
        )
    return [Row("router", WARN if missing or peers else OK, words, values)] if values else []


def _recording(recording: Recording) -> list[Row]:
    if not recording.where:
        return []
    missing = {"steps_missing": str(recording.missing)}
    level, message = WARN if recording.trouble else OK, recording.trouble or "on"
    return [Row("recording", level, message, missing)]


def _certificate(code: str, text: str) -> list[Row]:
    return [Row("certificate", CERTIFICATE_LEVELS[code], text, {})] if code else []


def _latch_file(trouble: str | None) -> list[Row]:
    if trouble is None:
        return []
    return [Row("latch file", WARN if trouble else OK, trouble or "written", {})]


def _counted(counters: dict[str, int], kind: str) -> dict[str, str]:
    return {name: str(count) for name, count in counters.items() if name.startswith(kind)}

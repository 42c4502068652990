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
from msgspec.structs import replace

from acsard.core.codes import CODES, Code, Reason, reason, sentence
from acsard.core.config.settings import Config
from acsard.core.config.wire_time import wire_use
from acsard.core.formatting import many
from acsard.core.link.link_diagnosis import (
    BUSY_ADVICE,
    FIND_OUT_MORE,
    MAX_UNANSWERED_FRACTION,
    STATE_REASONS,
)
from acsard.core.link.link_state import LinkState
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
from acsard.core.motion.arbiter_text import NO_COMMAND, waiting
from acsard.core.motion.bumpers import missing_reason
from acsard.core.motion.emergency_stop import (
    DRIVER_FAULT_REASON,
    MISSING_REASON,
    PRESSED_REASON,
    SILENT_REASON,
)
from acsard.core.motion.gyro import STATUS
from acsard.core.tables.finding_table import LEVELS
from acsard.core.tables.link_codes import HOST_CODES
from acsard.core.tables.motor_codes import GUARD_DEFECTS
from acsard.core.tables.pose_codes import PoseCode
from acsard.core.values import (
    GyroDoes,
    Instant,
    Recording,
    RoutersStatus,
)

HELD = ("stopped", "fault")  # modes that a person ends

# Findings by the state of the emergency-stop input.
ESTOP: dict[str, Reason] = {
    "": reason("no_emergency_stop"),
    "released": reason("emergency_stop_released"),
    "pressed": PRESSED_REASON,
    "silent": SILENT_REASON,
}

BATTERY: dict[str, Code] = {
    "ok": "battery_ok",
    "warning": "battery_low",
    "unknown": "battery_unknown",
}

SHOW_REFUSAL_S = 2.0  # two messages at the default 1 Hz

MAX_MISSED_FRACTION = 0.01  # of the last minute's periods, above which this warns

NO_ROUTER, NOT_YET = "a peer, not a router", "not connected yet"

PORT_ADVICE = "plug the board in if it is not; `acsard ports` lists the serial ports"

ACTIVATE = "if no check runs, type `acsard call activate`"

CLEAR = "then look at the robot, and type `acsard call clear`"


class Row(Struct, frozen=True):
    """A row about one part of the robot, with details as text in `values`."""

    name: str
    findings: Sequence[Reason]
    values: dict[str, str]

    def message(self, robot_id: str) -> DiagnosticStatus:
        """Return the row with the code of its first finding of the highest level."""
        worst = max(self.findings, key=lambda why: LEVELS.index(why.level))
        advice = [why.advice for why in self.findings if why.level != "ok" and why.advice]
        values = {"code": worst.code} | self.values
        if advice:
            values["advice"] = "; ".join(dict.fromkeys(advice))
        return DiagnosticStatus(
            LEVELS.index(worst.level),
            f"acsard: {self.name}",
            "; ".join(why.text for why in self.findings),
            robot_id,
            [KeyValue(key, value) for key, value in values.items()],
        )


def diagnostics(
    config: Config,
    now: Instant,
    snapshot: Snapshot,
    certificate: Reason | None,
) -> DiagnosticArray:
    """Return the message with one row for each part of the robot.

    `certificate` is the result of `expiry`, or None for no such row.
    """
    rows = [
        _mode(snapshot.state),
        _serial_link(config, snapshot),
        _control_loop(snapshot),
        _commands(config, snapshot),
        _wheels(config, snapshot),
        *_board(config, snapshot),
        *_battery(config, snapshot),
        *_gyro(snapshot),
        *_routers(config.bus.connect, snapshot.routers),
        *_recording(snapshot.recording),
        *_latch_file(snapshot.latch_file),
        *_certificate(certificate),
        _settings(snapshot.state.settings_differ),
    ]
    stamp = Header(Time.from_ns(now.wall_ns))
    return DiagnosticArray(stamp, [row.message(config.robot.id) for row in rows])


def _mode(status: RobotState) -> Row:
    why = Reason(cast("Code", status.code), status.reason)
    if status.mode in HELD:
        clear = f"remove the cause, {CLEAR}"
        why = replace(why, advice=CODES[why.code].advice if why.code in GUARD_DEFECTS else clear)
    return Row("mode", [why], {"mode": status.mode, "source": status.source})


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
    if state.feedback_age is not None:
        values["feedback_age_s"] = f"{state.feedback_age:.2f}"
    values |= {f"counts_{name}": str(counts) for name, counts in named if counts}
    values |= _counted(state.counters, "line") | _counted(state.counters, "link")
    return Row("serial link", [*_link(config, snapshot)], values)


def _link(config: Config, snapshot: Snapshot) -> Iterator[Reason]:
    status, counters, simulated = snapshot.state, snapshot.state.counters, config.mcu.simulated
    by_host = simulated or status.code in HOST_CODES
    advice = BUSY_ADVICE if by_host else _check(config)
    if status.link == "down" and not simulated:
        advice = ACTIVATE if snapshot.port_released else PORT_ADVICE
    why = STATE_REASONS[cast("LinkState", status.link)]
    if status.link != "up" and status.mode == "waiting":  # the robot waits because of the link
        # The advice says more about the check.
        text = status.reason.removesuffix(FIND_OUT_MORE)
        why = Reason(cast("Code", status.code), f"{status.link}: {text}")
    yield replace(why, advice=advice)
    if status.pose_doubt not in ("", "gyro_disagrees", "not_calibrated"):
        doubt = sentence(cast("PoseCode", status.pose_doubt))
        yield replace(doubt, text=doubt.text + snapshot.counts_figures)
    if simulated:
        yield reason("port_simulated")
    if snapshot.unanswered:
        yield reason("lines_unanswered", check=advice)
    refused = {name: n for name, n in counters.items() if name.startswith("line_") and n}
    if sum(refused.values()) > MAX_UNANSWERED_FRACTION * max(1, counters.get("lines", 0)):
        kinds = ", ".join(f"{n} {name[5:].replace('_', ' ')}" for name, n in refused.items())
        yield reason("lines_rejected", kinds=kinds, check=advice)
    # More than once a day on average.
    days = counters.get("lines_sent", 0) / config.rate_hz / 86400
    late = counters.get(f"link_lost{'' if simulated else '_host_stall'}", 0)
    if late > days:
        yield reason("link_lost_late", times=many(late, "time"), busy=BUSY_ADVICE)
    lost = counters.get("link_lost", 0) - late
    if lost > days:
        yield reason("link_lost", times=many(lost, "time"), check=advice)


def _control_loop(snapshot: Snapshot) -> Row:
    figures, counters = snapshot.state.latencies, snapshot.state.counters
    missed = snapshot.missed_last_minute
    lateness = figures.get("period_lateness")
    periods = missed + (lateness.last_minute.count if lateness else 0)
    values = {
        f"{name}{when}_{share}_us": f"{getattr(spread, share):.0f}"
        for name, figure in figures.items()
        for when, spread in (("", figure.since_start), ("_minute", figure.last_minute))
        for share in ("p50", "p99", "max")
    }
    code: Code = "periods_missed" if missed > MAX_MISSED_FRACTION * periods else "periods_run"
    why = reason(code, missed=missed, periods=periods, busy=BUSY_ADVICE)
    values |= _counted(counters, "missed") | _counted(counters, "bus")
    return Row("control loop", [why], values)


def _commands(config: Config, snapshot: Snapshot) -> Row:
    timeouts = {source.name: source.timeout for source in config.commands.sources}
    values = {s.name: waiting(s.waits_for).text or "driving" for s in snapshot.sources}
    values |= _counted(snapshot.state.counters, "command")
    # A source may be selected, and still have to send a zero.
    drives, source_name = snapshot.state.mode == "driving", snapshot.state.source
    findings = [reason("commanded", source=source_name) if drives else NO_COMMAND]
    if snapshot.state.speed_limit:
        findings.append(reason("speed_limited", limit=snapshot.state.speed_limit))
    for source in snapshot.sources:
        if source.waits_for.what == "senders":
            senders = source.waits_for.senders + 1
            findings.append(reason("shared_source", senders=senders, source=source.name))
        timeout = timeouts.get(source.name, source.longest_gap_s)
        if source.longest_gap_s > timeout:
            gap_s = source.longest_gap_s
            findings.append(
                reason("command_gaps", source=source.name, seconds=gap_s, timeout=timeout)
            )
        if source.waits_for.what == "neutral" and source.waits_for.lasts and source.twist:
            twist = source.twist
            findings.append(
                reason(
                    "never_zero",
                    source=source.name,
                    linear=twist.linear,
                    angular=twist.angular,
                )
            )
    age_s = snapshot.refused_age_s
    if age_s is not None and age_s < SHOW_REFUSAL_S:
        findings.append(reason("refused", refused=snapshot.state.refused))
    return Row("commands", findings, values)


def _wheels(config: Config, snapshot: Snapshot) -> Row:
    text, counters = snapshot.state.wheel_fault, snapshot.state.counters
    values = {
        "left_out": ", ".join(snapshot.excluded),
        "slipping": ", ".join(snapshot.slipping),
    }
    values |= _counted(counters, "wheel_fault") | _counted(counters, "uncommanded_motion")
    code: Code = "wheel_fault" if config.feedback.encoders else "no_encoders"
    why = reason(code if text else "wheels_obey", fault=text, check=_check(config))
    return Row("wheels", [why], values)


def _board(config: Config, snapshot: Snapshot) -> list[Row]:
    safety, state, check = config.safety, snapshot.state, _check(config)
    required = safety.estop == "required"
    if not (snapshot.board or required or safety.needs_bumpers):
        return []
    findings = [ESTOP[state.emergency_stop]]
    if required and not state.emergency_stop:
        findings = [replace(MISSING_REASON, advice=check)]
    if snapshot.bumper is not None:
        findings.append(snapshot.bumper)
    elif state.bumpers is not None:
        findings.append(reason("bumpers_released", bumpers=many(len(state.bumpers), "bumper")))
    elif safety.needs_bumpers:
        findings.append(replace(missing_reason(safety), advice=check))
    if snapshot.board.get("motor_driver") == "fault":
        findings.append(DRIVER_FAULT_REASON)
    counted: dict[str, str] = {}
    for kind in ("line_status", "emergency", "bumper"):
        counted |= _counted(snapshot.state.counters, kind)
    return [Row("board", findings, snapshot.board | counted)]


def _battery(config: Config, snapshot: Snapshot) -> list[Row]:
    status, bounds, check = snapshot.battery, config.battery.bounds, _check(config)
    if status is None:
        missing = reason("battery_missing", text=battery.MISSING_REASON, check=check)
        return [Row("battery", [missing], {})] if bounds else []
    values: dict[str, str] = {"level": status.level}
    numbers = {
        "volts": status.volts,
        "percent": status.percent,
        "amperes": status.amps,
        "mean": status.mean if bounds else None,
    }
    values |= {name: f"{value:.2f}" for name, value in numbers.items() if value is not None}
    values |= {f"{level}_below": f"{below:g}" for level, below in bounds.items()}
    text = battery.status_text(config.battery, status)
    if status.level == "stop":
        empty = battery.empty_reason(config.battery)
        why = replace(empty, text=text, advice=f"{empty.advice}, {CLEAR}")
    else:
        why = reason(BATTERY[status.level], text=text, check=check)
    return [Row("battery", [why], values)]


def _gyro(snapshot: Snapshot) -> list[Row]:
    does, bias = cast("GyroDoes", snapshot.state.gyro), snapshot.gyro_bias
    if does == "off":
        return []
    values = {} if bias is None else {"bias_rad_s": f"{bias:.5f}"}
    values |= _counted(snapshot.state.counters, "imu_")
    return [Row("gyro", [STATUS[does]], values)]


def _routers(endpoints: Sequence[str], routers: RoutersStatus) -> list[Row]:
    missing, peers = routers.missing, routers.peers
    values = dict.fromkeys(endpoints, NOT_YET) | dict.fromkeys(routers.connected, "connected")
    values |= dict.fromkeys(missing, "not connected") | dict.fromkeys(peers, NO_ROUTER)
    if not values:
        return []
    findings = [reason("routers_due" if NOT_YET in values.values() else "routers_connected")]
    if missing:
        findings = [reason("router_missing", routers=", ".join(missing))]
    if peers:
        findings.append(reason("router_is_peer", routers=", ".join(peers)))
    return [Row("router", findings, values)]


def _recording(recording: Recording) -> list[Row]:
    if not recording.where:
        return []
    why = reason("recording_works")
    if recording.trouble:
        why = reason("recording_fails", trouble=recording.trouble)
    return [Row("recording", [why], {"steps_missing": str(recording.missing)})]


def _certificate(why: Reason | None) -> list[Row]:
    return [] if why is None else [Row("certificate", [why], {})]


def _latch_file(trouble: str | None) -> list[Row]:
    if trouble is None:
        return []
    why = reason("latch_file_works")
    if trouble:
        why = reason("latch_file_fails", trouble=trouble)
    return [Row("latch file", [why], {})]


def _settings(differ: str) -> Row:
    why = reason("settings_changed", differ=differ) if differ else reason("settings_same")
    return Row("settings", [why], {})


def _counted(counters: dict[str, int], kind: str) -> dict[str, str]:
    return {name: str(count) for name, count in counters.items() if name.startswith(kind)}

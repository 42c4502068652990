"""Summarizes a robot for `state` and `diagnostics`: it decides what `state` says."""

from __future__ import annotations

from typing import Literal

from acsard.core.link.board_status import as_text
from acsard.core.messages.schema import BatterySummary, Cause, RobotState, SourceState, Time
from acsard.core.messages.snapshot import Snapshot
from acsard.core.motion.arbiter_text import waiting
from acsard.core.robot import Robot
from acsard.core.tables.pose_codes import PoseCode
from acsard.core.values import NS_PER_S, BatteryStatus, GyroStatus, Ns
from acsard.core.values import Cause as LatchedCause


def summary(robot: Robot, now_ns: Ns) -> Snapshot:
    """Return what the messages say about a robot; too slow for every wake-up.

    In `state`, the daemon adds its own figures, and `messages/report.py` the stamp, the version and
    the certificates.
    """
    state, config = robot.state, robot.config
    session, status, inputs, odometry = state.session, state.status, state.inputs, state.odometry
    pose, silent = odometry.pose, session.silent(now_ns)
    refused, refused_ns = state.refused or ("", None)
    sources = state.arbiter.status(now_ns, config.commands)
    gyro = state.checks.gyro_status(config.odometry)
    wheels = state.checks.wheels_status(config.feedback)
    battery, bumpers = inputs.battery.status, inputs.bumpers.pressed
    return Snapshot(
        RobotState(
            stamp=Time(),
            mode=status.mode,
            reason=status.reason,
            code=status.code,
            x=pose.x,
            y=pose.y,
            yaw=pose.yaw,
            linear=None if silent else odometry.twist.linear,
            angular=None if silent else odometry.twist.angular,
            wheels=[] if silent else list(odometry.speeds.as_tuple()[: robot.model.independent]),
            link=status.link,
            source=status.source,
            sources=[
                SourceState(
                    s.name,
                    s.priority,
                    s.age_s,
                    waiting(s.waits_for).text,
                    s.waits_for.what,
                    s.twist.linear if s.twist else None,
                    s.twist.angular if s.twist else None,
                    s.longest_gap_s,
                )
                for s in sources
            ],
            refused=refused,
            counters=_counters(robot),
            gyro=gyro.does,
            encoder_counts=list(session.encoder_counts(robot.link_setup)),
            wheel_fault=wheels.text,
            pose_doubt=_pose_doubt(robot, gyro),
            sender=state.choice.sender,
            causes=[
                _cause(cause, state.life.shown.get(cause.number), now_ns)
                for cause in state.life.latches.causes
            ],
            feedback_age=session.feedback_age_s(now_ns),
            emergency_stop=inputs.estop.state,
            bumpers=None if bumpers is None else list(bumpers),
            battery=None if battery is None else _battery(battery),
            speed_limit=_speed_limit(robot),
        ),
        applied=robot.applied,
        sources=sources,
        refused_age_s=None if refused_ns is None else (now_ns - refused_ns) / NS_PER_S,
        gyro_bias=gyro.bias,
        excluded=wheels.excluded,
        slipping=wheels.slipping,
        port_released=state.life.port_released,
        bumper=inputs.bumpers.why(config.safety),
        battery=battery,
        board=_board(robot, now_ns),
        counts_figures=session.counts_figures(robot.link_setup),
        check=session.check(robot.link_setup),
        unanswered=state.unanswered.told,
    )


def _pose_doubt(robot: Robot, gyro: GyroStatus) -> PoseCode | Literal[""]:
    if code := robot.state.session.pose_warning.code:
        return code
    if robot.state.odometry.doubts.differs:
        return "wheels_and_commands_differ"
    if gyro.does == "disagrees":
        return "gyro_disagrees"
    config = robot.config
    return "" if config.odometry.calibrated or config.mcu.simulated else "not_calibrated"


def _counters(robot: Robot) -> dict[str, int]:
    session = robot.state.session
    counters = {"lines": session.good_lines} | robot.state.odometry.counters()
    counters |= {f"line_{reason}": count for reason, count in session.rejects.items() if count}
    if session.coarse_lines:
        counters["coarse_encoder_lines"] = session.coarse_lines
    return counters | robot.state.counters


def _cause(cause: LatchedCause, shown_ns: Ns | None, now_ns: Ns) -> Cause:
    age_s = None if shown_ns is None else (now_ns - shown_ns) / NS_PER_S
    at = Time.from_ns(cause.at_ns)
    return Cause(cause.number, cause.kind, cause.code, cause.text, cause.by, at, cause.kept, age_s)


def _battery(battery: BatteryStatus) -> BatterySummary:
    return BatterySummary(battery.volts, battery.percent, battery.amps, battery.level)


def _board(robot: Robot, now_ns: Ns) -> dict[str, str]:
    status = robot.state.session.status
    if status.last_ns is None:
        return {}
    return as_text(status.last) | {"age_s": f"{(now_ns - status.last_ns) / NS_PER_S:.1f}"}


def _speed_limit(robot: Robot) -> str:
    cap, highest = robot.state.cap, robot.config.limits.linear_speed
    if cap.speed is None or cap.speed >= highest:
        return ""
    return f"{cap.speed:.3g} m/s, set by {cap.by}; back to {highest:g} m/s when this limit ends"

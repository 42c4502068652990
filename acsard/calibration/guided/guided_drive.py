"""Chooses the method of a guided drive, connects its sensors, and runs the drive on a robot."""

from __future__ import annotations

from contextlib import AbstractContextManager, ExitStack

import msgspec
from msgspec import Struct

from acsard.bus.zenoh_sessions import client_session
from acsard.calibration.guided.drive_plan import DisturbedError, GuideError, Leg, setup
from acsard.calibration.guided.robot_on_bus import RobotOnBus
from acsard.calibration.guided.runner import guide
from acsard.calibration.runs import Run
from acsard.calibration.solve import Calibration
from acsard.client.connection import Connection
from acsard.core.config.settings import Config
from acsard.core.messages.keys_and_roles import IMU, full_key
from acsard.core.messages.schema import Info
from acsard.host.errors import NoAnswerError, UsageError
from acsard.terminal.prompt import Prompt

TRUE_POSE = "sim/pose"  # only the built-in simulator publishes this key


class DriveOptions(Struct, frozen=True):
    """The options of a guided drive. None means that the user chose nothing."""

    method: str | None = None  # as in `METHODS`
    positions: str | None = None  # key of the robot's positions, with or without its id
    positions_at: str | None = None  # their endpoint; None means the daemon's
    imu: str | None = None  # key of the gyro, with or without the robot's id
    without_person: bool = False  # only the built-in simulator permits this


def guided_drive(
    client: Connection,
    options: DriveOptions,
    file: str,
    file_config: Config,
    prompt: AbstractContextManager[Prompt],
    *,
    must_write: bool = False,
) -> tuple[Calibration, Config]:
    """Guide a person through a drive. Return its calibration and the daemon's configuration.

    The result may be written into `file`, which has `file_config`; `must_write` refuses a file that
    does not belong to the daemon. Raises `UsageError` for unsuitable options, `GuideError` if the
    drive ends early, and the errors of `guide`.
    """
    info, robot_id = client.get("info"), client.where.robot_id
    if options.without_person and not info.simulated:
        raise UsageError(
            "--yes is only for the built-in simulator: this robot is real, and a person "
            "must stand near it and start each leg. Leave --yes out"
        )
    settings = client.get("config")
    try:
        config = msgspec.convert(settings, Config)
    except msgspec.ValidationError as error:
        raise GuideError(
            f"this version of acsard cannot read the daemon's configuration ({error}): use the "
            f"daemon's version, {info.version}"
        ) from None
    if must_write and (trouble := other_robot(config, file_config, file)):
        raise GuideError(trouble)
    method, plan = choose_method(options, config), setup(config)
    true = info.simulated and options.positions in (TRUE_POSE, full_key(robot_id, TRUE_POSE))
    with ExitStack() as stack:
        asker = stack.enter_context(prompt)
        asker.begin(f"robot {robot_id} at {client.where.endpoint}")
        robot = RobotOnBus(client, config, asker)
        if method == "gyro":
            robot.gyro(options.imu or IMU)
        elif method == "positions":
            elsewhere = None
            if options.positions_at:
                elsewhere = client_session(options.positions_at, client.where.tls)
                stack.callback(elsewhere.close)
            robot.positions(options.positions or "", elsewhere)

        def ride(leg: Leg) -> Run:
            try:
                require_same_robot(client, info, settings)
            except NoAnswerError as error:
                why = f"the daemon did not answer before the leg ({error})"
                text = f"{why}. The tool did not change any file"
                raise (DisturbedError(why, text) if robot.returns() else GuideError(text)) from None
            return robot.ride(leg)

        try:
            calibration = guide(
                method, plan, asker, ride, simulated=info.simulated, true_positions=true
            )
        except KeyboardInterrupt:
            raise GuideError("the operator ended the drive. No file was written") from None
        return calibration, config


def require_same_robot(client: Connection, info: Info, settings: object) -> None:
    """Raise `GuideError` if another robot or other settings answer than before the first leg.

    A restarted daemon may drive a real robot instead of the simulator.
    """
    now = client.get("info")
    # The simulator's port is a pty, whose name changes at each start.
    was, port = (("the simulator" if x.simulated else x.port) for x in (info, now))
    if port != was:
        raise GuideError(
            f"the daemon now drives {port} instead of {was}: begin the calibration again"
        )
    if client.get("config") != settings:
        raise GuideError(
            "the daemon's settings were changed during the calibration: begin it again, and change "
            "no settings until it is finished"
        )


def choose_method(options: DriveOptions, config: Config) -> str:
    """Return the method that the options need, else "gyro" if the daemon reads one, else "tape".

    Raises `UsageError` if the options need a gyro that the daemon does not read.
    """
    if options.positions:
        return "positions"
    gyro = options.method == "gyro" or options.imu
    if gyro and options.imu in (None, IMU) and not config.odometry.gyro:
        raise UsageError(
            "this robot's daemon does not read a gyro: set odometry.gyro = true and restart "
            "the daemon, or use --method tape"
        )
    return options.method or ("gyro" if gyro or config.odometry.gyro else "tape")


def other_robot(config: Config, file_config: Config, file: str) -> str:
    """Return an error message if the file is for a robot with another geometry, else ""."""
    ours, theirs = config.drive, file_config.drive
    if (ours.wheel_radius, ours.wheel_separation) == (theirs.wheel_radius, theirs.wheel_separation):
        return ""
    return (
        f"the daemon runs with drive.wheel_radius = {ours.wheel_radius:g} and "
        f"drive.wheel_separation = {ours.wheel_separation:g}, but {file} has other values: name "
        "the daemon's configuration file with --config"
    )

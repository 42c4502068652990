"""`acsard calibrate` without a log: the guided drive, from the first question to the result."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import msgspec
import zenoh

from acsard.calibration.guided.drive_plan import NEEDS, GuideError, setup
from acsard.calibration.guided.robot_on_bus import SOURCE, RobotOnBus
from acsard.calibration.guided.runner import guide
from acsard.calibration.solve import Calibration
from acsard.cli.connection import require_one
from acsard.client import Client, connect
from acsard.core.config.settings import Config
from acsard.core.messages.topics import full_key
from acsard.daemon.bus.address import address_of
from acsard.daemon.bus.zenoh_sessions import client_session
from acsard.host.errors import UsageError
from acsard.host.terminal_modes import one_by_one
from acsard.terminal.json_prompt import JsonPrompt
from acsard.terminal.prompt import Prompt, ended_by_signals
from acsard.terminal.terminal_prompt import NoPrompt, TerminalPrompt

DRIVE_OPTIONS = ("method", "positions", "positions_at", "imu", "yes", "json_lines")

IMU = "imu"
"""The gyro's key if the command line names none."""


def add_drive_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that only a guided drive takes."""
    parser.add_argument(
        "--method",
        choices=tuple(NEEDS),
        help="reference for the drive (default: a gyro if the robot has one ([odometry] gyro), "
        "else a tape)",
    )
    parser.add_argument(
        "--positions",
        metavar="KEY",
        help="for --method positions: the key of the positions (PoseStamped or Odometry in JSON, "
        "msgpack or CDR), as `acsard topics` lists it (sim/pose), or any full key",
    )
    parser.add_argument(
        "--positions-at",
        metavar="ENDPOINT",
        help="where that key is published if the daemon does not have it, for example a router",
    )
    parser.add_argument(
        "--imu",
        metavar="KEY",
        help="for --method gyro: the key of the gyro (default: imu), as `acsard topics` lists it, "
        "or a full key",
    )
    parser.add_argument(
        "--yes",
        action="store_true",
        help="start every leg without Enter (only with the built-in simulator)",
    )


def guided(
    args: argparse.Namespace, config: Config, where: str, lines: JsonPrompt | None
) -> tuple[Calibration, Config]:
    """Drive the robot and return the calibration with the configuration that the robot runs with.

    A key press and Ctrl-C end the drive with zero commands. Raises `GuideError`, `LogError` and
    `RefusedError`.
    """
    require_one(args)
    endpoint, robot_id, tls = address_of(config, args.connect, args.id, args.tls)
    _usable(args, full_key(robot_id, "odom"))
    with ExitStack() as stack:
        client = stack.enter_context(connect(endpoint, robot_id=robot_id, source=SOURCE, tls=tls))
        info = client.get("info")
        _may(args, simulated=info.simulated)
        config = _in_force(client, config, where, write=args.write)
        name = _way(args, config)
        made = setup(config)
        prompt = stack.enter_context(_prompt(args, lines))
        prompt.begin(f"robot {robot_id} at {endpoint}", simulated=info.simulated)
        robot = RobotOnBus(client, config, prompt)
        if name == "gyro":
            robot.gyro(args.imu or IMU)
        elif name == "positions":
            robot.positions(args.positions, _elsewhere(args, tls, stack))
        try:
            return guide(name, made, prompt, robot.ride, simulated=info.simulated), config
        except KeyboardInterrupt:
            raise GuideError("the operator ended the drive. No file is written") from None


def _usable(args: argparse.Namespace, odometry: str) -> None:
    if args.method == "positions" and not args.positions:
        raise UsageError("--method positions needs the key of the positions: --positions KEY")
    if args.positions and args.method not in (None, "positions"):
        raise UsageError(f"--positions does not go with --method {args.method}: leave one out")
    if args.positions in ("odom", odometry):
        raise UsageError(
            "odom is computed from the wheels themselves: the positions must come from "
            "another source"
        )
    if args.imu and (args.positions or args.method not in (None, "gyro")):
        other = "--positions" if args.positions else f"--method {args.method}"
        raise UsageError(f"--imu is for --method gyro, not for {other}: leave one out")
    if args.positions_at and not args.positions:
        raise UsageError(
            "--positions-at says where the key of --positions is: give --positions KEY as well"
        )
    if not (args.yes or args.json_lines or sys.stdin.isatty()):
        raise UsageError(
            "calibrate drives the robot, and a person at the terminal starts and stops "
            "it: run it in a terminal. Without a terminal, use --yes (only with the "
            "built-in simulator), or --log with a recorded drive"
        )


def _may(args: argparse.Namespace, *, simulated: bool) -> None:
    """Raise `UsageError` if `--yes` is given for a real robot.

    A person must stand beside a real robot and start each leg.
    """
    if args.yes and not simulated:
        raise UsageError(
            "--yes is only for the built-in simulator: this robot is real, and a person "
            "must stand near it and start each leg. Leave --yes out"
        )


def _in_force(client: Client, mine: Config, where: str, *, write: bool) -> Config:
    """Return the configuration that the daemon runs with.

    Raises `GuideError` if the result is to be written to a file that differs from it.
    """
    config = msgspec.convert(client.get("config"), Config)
    if write and (trouble := differing(config, mine, where)):
        raise GuideError(trouble)
    return config


def differing(config: Config, mine: Config, where: str) -> str:
    """Return why a result for `config` does not belong into the file `where`, or "" if it does.

    Args:
        config: the configuration that the daemon runs with.
        mine: the configuration in the file `where`.
    """
    same = config.drive.wheel_radius, config.drive.wheel_separation
    if same == (mine.drive.wheel_radius, mine.drive.wheel_separation):
        return ""
    return (
        f"the daemon runs with drive.wheel_radius = {same[0]:g} and drive.wheel_separation "
        f"= {same[1]:g}, but {where} has other values: give --config the file that the "
        "daemon uses"
    )


def _way(args: argparse.Namespace, config: Config) -> str:
    if args.positions:
        return "positions"
    gyro = args.method == "gyro" or args.imu
    if gyro and args.imu in (None, IMU) and not config.odometry.gyro:
        raise UsageError(
            "this robot's daemon receives no gyro: set odometry.gyro = true and restart "
            "the daemon, or use --method tape, wall or umbmark"
        )
    way: str = args.method or ("gyro" if gyro or config.odometry.gyro else "tape")
    return way


@contextmanager
def _prompt(args: argparse.Namespace, lines: JsonPrompt | None) -> Iterator[Prompt]:
    if args.yes:
        yield NoPrompt(args.json)
        return
    with ended_by_signals():
        if lines is not None:
            yield lines
            return
        with one_by_one():
            yield TerminalPrompt(args.json)


def _elsewhere(args: argparse.Namespace, tls: str, stack: ExitStack) -> zenoh.Session | None:
    """Return a separate session for positions that the daemon does not publish, or None."""
    if not args.positions_at:
        return None

    session = client_session(args.positions_at, tls)
    stack.callback(session.close)
    return session

"""Leads a person through the legs of a guided drive, and returns the log of the drive.

What the person measures by tape are readings of whole runs, which the one fit compares like the
samples of a sensor.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import ExitStack, suppress

import msgspec
import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from acsard.bus.zenoh_sessions import client_session
from acsard.calibration.drive import Recorder
from acsard.calibration.log import Floats, Log, LogError, Run, TapeReading
from acsard.calibration.plan import METHODS, WHEELBASE, Leg, Setup, legs
from acsard.client.connection import Connection
from acsard.client.ride import NEVER_DRIVING_MODES
from acsard.core.config.settings import Config, DriveConfig
from acsard.core.messages.keys_and_roles import by_key
from acsard.core.values import Metres, Rad
from acsard.host.errors import NoAnswerError, NotDrivenError, UsageError
from acsard.terminal.prompt import NumberQuestion, Prompt

SOURCE = "app"

MAX_REPEATS = 20  # of a leg: then nobody is there who could type "q"

# Standard deviations of what a person reads, m, and of skidding, per root of a metre and relative.
TAPE_STD_M, LINE_STD_M = 0.005, 0.002
SKID_HEADING, SKID_LENGTH = 0.015, 0.002
MIN_TAPE_M = 0.5
TRACKS = 0.85, 3.0  # credible ratios of effective track and wheel separation

Ride = Callable[[Leg], Run]  # raises `NotDrivenError` if the leg may be repeated


class Options(Struct, frozen=True):
    """The options of a guided drive; None means that the user chose nothing."""

    method: str | None = None
    poses: str | None = None  # key, with or without the robot's id
    poses_at: str | None = None  # endpoint of the bus that has them; None means the daemon's
    without_person: bool = False


def drive(
    client: Connection, options: Options, prompt: Prompt, file: str, file_config: Config
) -> tuple[Log, Config]:
    """Guide a person through a drive. Return its log and the daemon's configuration.

    The result may be written into `file`, which has `file_config`, unless it is "". Raises
    `UsageError` for unsuitable options, and `LogError` or `NotDrivenError` if the drive ends early.
    """
    info, settings = client.get("info"), client.get("config")
    if options.without_person and not info.simulated:
        raise UsageError(
            "--yes is only for the built-in simulator: this robot is real, and a person must stand "
            "near it and start each leg. Leave --yes out"
        )
    try:
        config = msgspec.convert(settings, Config)
    except msgspec.ValidationError as error:
        raise LogError(
            f"this version of acsard cannot read the daemon's configuration ({error}): use the "
            f"daemon's version, {info.version}"
        ) from None
    if file:
        _require_own(config.drive, file_config.drive, file)
    method = options.method or (
        "poses" if options.poses else "gyro" if config.odometry.gyro else "tape"
    )
    setup = Setup.of(config)
    prompt.begin(f"robot {client.where.robot_id} at {client.where.endpoint}")
    recorder = Recorder(client, config, prompt)
    with ExitStack() as stack:
        if method == "gyro":
            recorder.add_gyro()
        elif options.poses:
            session = client.session
            if options.poses_at:
                session = client_session(options.poses_at, client.where.tls)
                stack.callback(session.close)
            known = by_key(options.poses) is not None
            recorder.add_poses(client.key(options.poses) if known else options.poses, session)

        def ride(leg: Leg) -> Run:
            # A restarted daemon may drive a real robot instead of the simulator.
            now = client.get("info")
            if now.simulated != info.simulated or client.get("config") != settings:
                raise LogError(
                    "another robot answers, or its settings were changed during the calibration: "
                    "begin again"
                )
            try:
                return recorder.ride(leg)
            except NotDrivenError:
                with suppress(NoAnswerError):  # the reason is known, also if a query is late
                    state = client.get("state")
                    if state.mode in NEVER_DRIVING_MODES:
                        raise LogError(state.why) from None
                raise
            except NoAnswerError as error:
                client.get("info")  # raises if the daemon is still silent
                raise NotDrivenError(str(error)) from None

        try:
            return guided(method, setup, prompt, ride), config
        except KeyboardInterrupt:
            raise LogError("the operator ended the drive") from None


def _require_own(ours: DriveConfig, theirs: DriveConfig, file: str) -> None:
    if (ours.wheel_radius, ours.wheel_separation) != (theirs.wheel_radius, theirs.wheel_separation):
        raise LogError(
            f"the daemon runs with drive.wheel_radius = {ours.wheel_radius:g} and "
            f"drive.wheel_separation = {ours.wheel_separation:g}, but {file} has other values: "
            "name the daemon's configuration file with --config"
        )


def guided(method: str, setup: Setup, prompt: Prompt, ride: Ride) -> Log:
    """Return the runs of a guided drive, with what the person measured.

    Raises `LogError` if the drive cannot continue.
    """
    longest = max(
        sum(leg.seconds for leg in legs(method, setup, track))
        for track in np.arange(1.0, 2.55, 0.05)
    )
    prompt.show_text(
        f"Calibration with {METHODS[method]}. The robot drives for at most {longest:.0f} s in all. "
        "Stay near it: any key stops it at once."
    )

    def number(ask: NumberQuestion) -> Metres:
        return prompt.number(ask) / 1000

    wheelbase = number(WHEELBASE) if method == "tape" else 0.0
    runs: list[Run] = []
    track, slope = 1.0, 0.0  # of the robot to the line, rad
    while len(runs) < len(plan := legs(method, setup, track)):
        leg = plan[len(runs)]
        end = "" if leg.by_key else " It stops by itself: press a key only if you must stop it."
        words = f"{len(runs) + 1}. {leg.words}{end} ({leg.seconds:.0f} s)"
        run = _repeated(leg, words, prompt, ride)
        found = {ask.name: number(ask) for ask in leg.asks}
        readings = []
        rolled = setup.drive.wheel_radius * (_rolled(run.left) + _rolled(run.right)) / 2
        if (metres := found.get("distance", 0.0)) >= MIN_TAPE_M:
            std = math.hypot(TAPE_STD_M, SKID_LENGTH * metres)
            readings.append(TapeReading("distance", metres, std))
        if "front" in found:
            before, slope = slope, line_angle(found["front"], found["rear"], wheelbase)
            std = math.hypot(2 * LINE_STD_M / wheelbase, SKID_HEADING * math.sqrt(rolled))
            turned = leg.whole_turns + slope - before
            readings.append(TapeReading("turn", turned, std))
            if leg.by_key:
                track = track_ratio(run, turned, setup.drive)
        runs.append(replace(run, tape=tuple(readings)))
    return Log(tuple(runs), ())


def _repeated(leg: Leg, words: str, prompt: Prompt, ride: Ride) -> Run:
    for left in reversed(range(MAX_REPEATS + 1)):
        prompt.start(words)
        try:
            return ride(leg)
        except NotDrivenError as error:
            if not left:
                raise
            prompt.show_text(f"This leg has ended early: {error}")
            prompt.instruct("Put the robot back where and how the leg began. Then start it again.")
    raise AssertionError


def _rolled(angles: Floats) -> float:
    return float(np.abs(np.diff(angles)).sum())


def line_angle(front: Metres, rear: Metres, wheelbase: Metres) -> Rad:
    """Return the angle of the robot to a line on its left, positive after a turn to the left."""
    sine = (rear - front) / wheelbase
    if abs(sine) > 0.98:
        raise LogError(
            f"two wheels that are {wheelbase * 1000:.0f} mm apart cannot be {front * 1000:.0f} mm "
            f"and {rear * 1000:.0f} mm from the line: start again, and measure again"
        )
    return math.asin(sine)


def track_ratio(run: Run, turned: Rad, drive: DriveConfig) -> float:
    """Return effective track / wheel separation from one full turn. Raises `LogError`."""
    rolled = float(run.right[-1] - run.left[-1])
    track = rolled * drive.wheel_radius / drive.wheel_separation / turned
    low, high = TRACKS
    if not low < track < high:
        raise LogError(
            "the robot should have made one full turn, but by its wheels it turned "
            f"{math.degrees(track * turned):.0f} deg: let it make exactly one, check "
            "drive.wheel_radius and drive.wheel_separation with a tape, and start again"
        )
    return max(1.0, track)

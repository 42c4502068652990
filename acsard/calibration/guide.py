"""Leads a person through the legs of a guided drive, and returns the log of the drive.

What the person measures by tape are readings of whole runs, which the one fit compares like the
samples of a sensor.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, suppress

import msgspec
import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from acsard.bus.zenoh_sessions import client_session
from acsard.calibration.leg import Recorder
from acsard.calibration.log import Log, LogError, Run, TapeReading
from acsard.calibration.plan import METHODS, STAY, WHEELBASE, Leg, Setup, legs
from acsard.client.connection import Connection
from acsard.client.ride import NEVER_DRIVING_MODES
from acsard.core.config.settings import Config, DriveConfig
from acsard.core.messages.keys_and_roles import by_key
from acsard.core.values import AcsardError, Metres, Rad
from acsard.host.errors import NoAnswerError, NotDrivenError, UsageError
from acsard.terminal.prompt import Prompt

SOURCE = "app"

MAX_REPEATS = 20  # of a leg: then nobody is there who could type "q"

# Standard deviations of what a person reads, m, and of skidding, per root of a metre and relative.
TAPE_STD_M, LINE_STD_M = 0.005, 0.002
SKID_HEADING, SKID_LENGTH = 0.015, 0.002
MIN_TAPE_M = 0.5
ODD_SHARE, ODD_DEG = 0.15, 30.0  # of the wheels' distance, to the line: readings to confirm
TRACKS = 0.85, 3.0  # credible ratios of effective track and wheel separation

Ride = Callable[[Leg], Run]
Driven = tuple[Leg, Run, dict[str, Metres]]  # with the answers after it


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
    `UsageError` for unsuitable options, and another `AcsardError` if the drive ends early.
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
        require_own(config, file_config, file)
    state = client.get("state")
    if state.mode in NEVER_DRIVING_MODES:
        raise NotDrivenError(state.why)
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
                    "set them back, or begin again"
                )
            try:
                return recorder.ride(leg)
            except NotDrivenError:
                with suppress(NoAnswerError):  # the reason is known, also if a query is late
                    state = client.get("state")
                    if state.mode in NEVER_DRIVING_MODES:
                        raise NotDrivenError(state.why) from None
                raise

        try:
            return guided(method, setup, prompt, ride), config
        except KeyboardInterrupt:
            raise LogError("the operator ended the drive") from None


def require_own(daemon: Config, file_config: Config, file: str) -> None:
    """Raise `LogError` unless the file describes the robot that the daemon drives."""
    if daemon.mcu.simulated and not file_config.mcu.simulated:
        raise LogError(
            f'the daemon simulates its robot, but {file} has mcu.port = "{file_config.mcu.port}": '
            "a real robot must not get the values of the simulator. Run the daemon with this port, "
            'or name a file whose mcu.port is "sim" with --config'
        )
    ours, theirs = daemon.drive, file_config.drive
    if (ours.wheel_radius, ours.wheel_separation) != (theirs.wheel_radius, theirs.wheel_separation):
        raise LogError(
            f"the daemon runs with drive.wheel_radius = {ours.wheel_radius:g} and "
            f"drive.wheel_separation = {ours.wheel_separation:g}, but {file} has other values: "
            "name the daemon's configuration file with --config"
        )


def guided(method: str, setup: Setup, prompt: Prompt, ride: Ride) -> Log:
    """Return the runs of a guided drive, with what the person measured."""
    longest = max(
        sum(leg.seconds for leg in legs(method, setup, track))
        for track in np.arange(1.0, 2.55, 0.05)
    )
    prompt.show_text(
        f"Calibration with {METHODS[method]}. The robot drives for at most {longest:.0f} s in all. "
        "Stay near it: any key stops it at once."
    )
    wheelbase = prompt.number(WHEELBASE) / 1000 if method == "tape" else 0.0
    driven: list[Driven] = []
    runs: list[Run] = []
    track = 1.0
    while len(runs) < len(plan := legs(method, setup, track)):
        leg = plan[len(runs)]
        end = "" if leg.by_key else " It stops by itself: press a key only if you must stop it."
        words = f"{len(runs) + 1} of {len(plan)}: {leg.words}{end} ({leg.seconds:.0f} s)"
        run = _repeated(leg, words, prompt, ride, setup.drive)
        asks = leg.asks
        while True:
            found = {ask.name: prompt.number(ask) / 1000 for ask in asks}
            asks = (WHEELBASE, *leg.asks) if method == "tape" else leg.asks
            wheelbase = found.get(WHEELBASE.name, wheelbase)
            try:
                runs = _measured([*driven, (leg, run, found)], wheelbase, setup.drive)
                doubts = "; ".join(_doubts(run, found, wheelbase, setup.drive))
                if not doubts or prompt.ask(f"{doubts}. Is this right?", ("yes", "no")) != "no":
                    break
            except LogError as error:
                prompt.show_text(f"{error}: measure again")
        driven.append((leg, run, found))
        if leg.by_key:
            track = max(1.0, _track_ratio(run, runs[-1].tape[-1].value, setup.drive))
    return Log(tuple(runs), ())


def _repeated(leg: Leg, words: str, prompt: Prompt, ride: Ride, drive: DriveConfig) -> Run:
    # Whatever interrupts a leg costs only this leg.
    for left in reversed(range(MAX_REPEATS + 1)):
        prompt.start(words)
        try:
            run = ride(leg)
            if leg.by_key:
                _require_one_turn(_track_ratio(run, leg.whole_turns, drive))
            return run
        except AcsardError as error:
            if not left:
                raise
            prompt.show_text(f"This leg has ended early: {error}")
            prompt.instruct("Put the robot back where and how the leg began. Then start it again.")
            words = words.replace(STAY, "")
    raise AssertionError


def _measured(driven: Sequence[Driven], wheelbase: Metres, drive: DriveConfig) -> list[Run]:
    # The runs with their readings. Raises `LogError` if a person cannot have measured them.
    runs, slope = [], 0.0  # of the robot to the line, rad
    for leg, run, found in driven:
        readings = []
        if (metres := found.get("distance", 0.0)) >= MIN_TAPE_M:
            std = math.hypot(TAPE_STD_M, SKID_LENGTH * metres)
            readings.append(TapeReading("distance", metres, std))
        if "front" in found:
            before, slope = slope, _line_angle(found["front"], found["rear"], wheelbase)
            rolled = drive.wheel_radius * float(np.abs(np.diff([run.left, run.right])).sum()) / 2
            std = math.hypot(2 * LINE_STD_M / wheelbase, SKID_HEADING * math.sqrt(rolled))
            readings.append(TapeReading("turn", leg.whole_turns + slope - before, std))
        runs.append(replace(run, tape=tuple(readings)))
    return runs


def _doubts(
    run: Run, found: dict[str, Metres], wheelbase: Metres, drive: DriveConfig
) -> Iterator[str]:
    # Answers that are possible, but more likely misread.
    mm = found.get("distance", 0.0) * 1000
    wheels = 500 * drive.wheel_radius * abs(float(run.left[-1] + run.right[-1]))
    if mm >= MIN_TAPE_M * 1000 and abs(mm - wheels) > ODD_SHARE * wheels:
        yield f"you measured {mm:.0f} mm, but by its wheels the robot drove {wheels:.0f} mm"
    if "front" in found:
        angle = math.degrees(_line_angle(found["front"], found["rear"], wheelbase))
        if abs(angle) > ODD_DEG:
            yield f"by these distances the robot stands at {abs(angle):.0f} deg to the line"


def _line_angle(front: Metres, rear: Metres, wheelbase: Metres) -> Rad:
    # Of the robot to a line on its left, positive after a turn to the left.
    sine = (rear - front) / wheelbase
    if abs(sine) > 0.98:
        raise LogError(
            f"two points that are {wheelbase * 1000:.0f} mm apart cannot be {front * 1000:.0f} mm "
            f"and {rear * 1000:.0f} mm from the line"
        )
    return math.asin(sine)


def _track_ratio(run: Run, turned: Rad, drive: DriveConfig) -> float:
    # Effective track / wheel separation.
    rolled = float(run.right[-1] - run.left[-1])
    return rolled * drive.wheel_radius / drive.wheel_separation / turned


def _require_one_turn(track: float) -> None:
    low, high = TRACKS
    if not low < track < high:
        raise NotDrivenError(
            "the robot should have made one full turn, but by its wheels it turned "
            f"{360 * track:.0f} deg: let it make exactly one, and check drive.wheel_radius and "
            "drive.wheel_separation with a tape"
        )

"""Guided drives of simulated robots, with a person who measures without an error."""

from __future__ import annotations

import cmath
import math
import re
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from functools import partial
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
from msgspec.structs import replace

from acsard.calibration import guide
from acsard.calibration.geometry import Base
from acsard.calibration.guide import MAX_REPEATS, Options, drive, guided, require_own
from acsard.calibration.leg import require_path
from acsard.calibration.log import Log, LogError, Notes, Run, run_of
from acsard.calibration.plan import FLOOR_M, METHODS, Leg, Move, Setup, legs
from acsard.calibration.result import calibrate
from acsard.calibration.series import Floats
from acsard.core.config.parsing import effective, parse
from acsard.core.config.settings import Config
from acsard.core.values import AcsardError
from acsard.host.errors import NoAnswerError, NotDrivenError, UsageError
from acsard.terminal.prompt import NumberQuestion, Prompt

STEP_S, LINE_M, WHEELBASE_M, WIDTH_M = 0.02, 0.45, 0.25, 0.30
SETUP = Setup.of(Config())
AGAIN = r"measure again\. The distance of run 1 of 4 \(ahead\) is missed by 1\d\d mm"
REAL = "[mcu]\nport = '/dev/acsar_mcu'\n"


class Robot(Prompt):
    """A robot that skids, whose wheels follow exactly, and the person beside it."""

    def __init__(self, track: float, radius: float = 0.0505) -> None:
        super().__init__()
        self.track, self.radius = track, radius
        self.place, self.yaw = complex(SETUP.from_edge, FLOOR_M / 2), 0.0
        self.mark = self.place
        self.way: list[complex] = []
        self.disturbed: list[AcsardError] = []
        self.lies: dict[str, list[float]] = {}  # first answers, by question
        self.said: list[str] = []
        self.rng = np.random.default_rng(1)

    def ride(self, leg: Leg) -> Run:
        if self.disturbed:
            raise self.disturbed.pop()
        begun, sides, rates = self.yaw, [], []
        for number, move in enumerate(leg.moves):
            rolled = move.angular * Config().drive.wheel_separation / 2
            for _ in range(max(1, round(move.seconds / STEP_S))):
                ends = leg.by_key and number == len(leg.moves) - 1
                if ends and self.yaw - begun > 2 * math.pi + 0.1:
                    break
                wheels = [(move.linear + side * rolled) / 0.05 for side in (-1, 1)]
                left, right = (wheel * self.radius for wheel in wheels)
                turn = (right - left) / (Config().drive.wheel_separation * self.track) * STEP_S
                self.place += (left + right) / 2 * STEP_S * cmath.exp(1j * (self.yaw + turn / 2))
                self.yaw += turn
                self.way.append(self.place)
                sides.append(wheels)
                rates.append(turn / STEP_S + self.rng.normal(0, 0.002))
        t: Floats = STEP_S * np.arange(len(sides), dtype=np.float64)
        left_speeds, right_speeds = np.array(sides, dtype=np.float64).T
        streams: dict[str, tuple[Floats, ...]] = {"left right": (t, left_speeds, right_speeds)}
        if self.method == "gyro":
            streams["yaw_rate"] = t, np.array(rates, dtype=np.float64)
        return run_of(leg.name, streams, Notes())

    method, confirms = "tape", "no"

    def show_text(self, text: str) -> None:
        self.said.append(text)

    def ask(self, question: str, answers: Sequence[str]) -> str:
        self.said.append(question)
        return self.confirms

    def number(self, ask: NumberQuestion) -> float:
        if self.lies.get(ask.name):
            return self.lies[ask.name].pop(0)
        ahead = {"front": WHEELBASE_M / 2, "rear": -WHEELBASE_M / 2}.get(ask.name, 0.0)
        corner = self.place + (ahead + 1j * WIDTH_M / 2) * cmath.exp(1j * self.yaw)
        answer = {
            "wheelbase": 1000 * WHEELBASE_M, "distance": 1000 * abs(self.place - self.mark),
        }.get(ask.name, 1000 * (FLOOR_M / 2 + LINE_M - corner.imag))  # fmt: skip
        return float(np.round(answer))


@pytest.mark.variations(3)
@pytest.mark.parametrize("track", [1.0, 1.6, 2.4])
@pytest.mark.parametrize("method", ["gyro", "tape"])
def test_a_guided_drive_finds_track_and_size_and_stays_on_the_floor(
    method: str, track: float
) -> None:
    robot = Robot(track)
    robot.method = method
    log = guided(method, SETUP, robot, robot.ride)
    assert f"{len(log.runs)} of {len(log.runs)}: The robot" in robot.said[-1]
    result = calibrate(log, Config(), "the drive")
    print(result.found, result.deviations)
    found = result.found["wheel_separation_multiplier"]
    assert found == pytest.approx(track, rel=0.025)
    assert abs(found - track) < 3 * result.deviations["wheel_separation_multiplier"] + 0.01
    assert result.found["left_wheel_radius_multiplier"] == pytest.approx(1.01, abs=0.004)
    edges = [x for place in robot.way for x in (place.real, place.imag)]
    assert SETUP.reach <= min(edges)
    assert max(edges) <= FLOOR_M - SETUP.reach


@pytest.mark.parametrize("misread", ["round", "slowly", "fast"])
def test_a_turn_that_was_misread_is_named(misread: str) -> None:
    robot = Robot(1.6)
    log = guided("tape", SETUP, robot, robot.ride)
    (turn,) = (run.tape[-1] for run in log.runs if run.name == misread)
    wrong = [
        replace(run, tape=(replace(turn, value=turn.value + 0.6),)) if run.name == misread else run
        for run in log.runs
    ]
    named = rf"^The measurements .* The turn of run \d of 4 \({misread}\) is missed by \d\d deg"
    with pytest.raises(LogError, match=named) as end:
        calibrate(Log(tuple(wrong), ()), Config(), "the drive")
    assert "agrees" not in str(end.value)


@pytest.mark.parametrize(
    ("track", "millimetres", "words"),
    [
        (1.0, 0, "^Your robot agrees with its configuration: nothing"),
        (1.01, 0, "^No value is surely better: nothing"),
        (1.0, 1850, f"^The measurements do not fit together: {AGAIN}"),
        (1.2, 1850, f"^The measurements do not fit together: {AGAIN}"),
    ],
)
def test_a_robot_agrees_with_its_configuration_only_if_the_readings_do(
    track: float, millimetres: float, words: str
) -> None:
    robot = Robot(track, radius=0.05)
    robot.lies = {"distance": [millimetres] if millimetres else []}
    log = guided("tape", SETUP, robot, robot.ride)
    with pytest.raises(LogError, match=words) as end:
        calibrate(log, Config(), "the drive")
    assert ("agrees" in str(end.value)) is (track == 1.0 and not millimetres)


@pytest.mark.parametrize("method", METHODS)
def test_a_guided_drive_lasts_90_s_at_most(method: str) -> None:
    for track in np.arange(1.0, 2.51, 0.1):
        assert sum(leg.seconds for leg in legs(method, SETUP, track)) <= 90.0


@pytest.mark.parametrize("error", [NotDrivenError, NoAnswerError, LogError])
def test_whatever_disturbs_a_leg_it_is_repeated_until_nobody_seems_to_be_there(
    error: type[AcsardError],
) -> None:
    robot = Robot(1.5)
    robot.disturbed = [error("a chair")] * MAX_REPEATS
    assert len(guided("tape", SETUP, robot, robot.ride).runs) == 4
    assert robot.said.count("This leg has ended early: a chair") == MAX_REPEATS
    assert sum("Do not move the robot by hand" in text for text in robot.said) == 1
    robot = Robot(1.5)
    robot.disturbed = [error("a chair")] * (MAX_REPEATS + 1)
    with pytest.raises(error, match="a chair"):
        guided("tape", SETUP, robot, robot.ride)


@pytest.mark.parametrize(
    ("share", "words"),
    [(1.0, ""), (0.95, ""), (0.8, "moved 0.96 m, although 1.20 m"), (0.0, "0.00 m")],
)
def test_wheels_that_do_not_roll_the_commanded_path_disturb_the_leg(
    share: float, words: str
) -> None:
    move, base = Move(4.0, 0.3), Base.of(Config().drive)
    rows = [(0.02 * n, 0.0, share * 6.0, share * 6.0) for n in range(201)]
    if words:
        with pytest.raises(NotDrivenError, match=words):
            require_path(move, rows, base)
    else:
        require_path(move, rows, base)
    with pytest.raises(NotDrivenError, match="hardly any wheel speeds"):
        require_path(move, rows[:5], base)
    require_path(Move(1.0), [], base)


@pytest.mark.parametrize(
    ("move", "speeds", "words"),
    [
        (Move(4.0, 0.3), (6.0, 6.0), ""),
        (Move(4.0, 0.3), (0.0, 0.0), ""),  # not yet
        (Move(4.0, -0.3), (-3.0, -3.0), ""),
        (Move(4.0, 0.3), (12.0, 12.0), "moved 0.60 m, although 0.30 m"),
        (Move(4.0, 0.3), (-6.0, -6.0), "moved -0.30 m"),
        (Move(4.0, 0.3), (5.0, 7.0), "rad, although 0.00 rad"),
    ],
)
def test_wheels_that_roll_another_path_disturb_the_leg_before_its_end(
    move: Move, speeds: tuple[float, float], words: str
) -> None:
    rows = [(0.02 * n, 0.0, *speeds) for n in range(51)]
    base = Base.of(Config().drive)
    if words:
        with pytest.raises(NotDrivenError, match=words):
            require_path(move, rows, base, 1.0)
    else:
        require_path(move, rows, base, 1.0)


def test_only_the_leg_of_a_turn_that_ended_too_early_is_repeated() -> None:
    robot, sound = Robot(1.5), Robot(1.5)
    early = [True]

    def ride(leg: Leg) -> Run:
        if leg.by_key and early:
            early.clear()
            place, yaw = robot.place, robot.yaw
            run = robot.ride(replace(leg, moves=(*leg.moves[:-1], Move(2.0, 0.0, 1.0))))
            robot.place, robot.yaw = place, yaw  # the person puts it back
            return run
        return robot.ride(leg)

    log = guided("tape", SETUP, robot, ride)
    assert not early
    (text,) = (text for text in robot.said if "has ended early" in text)
    assert "should have made one full turn, but by its wheels it turned 114 deg" in text
    assert [run.tape for run in log.runs] == [
        run.tape for run in guided("tape", SETUP, sound, sound.ride).runs
    ]


@pytest.mark.parametrize(
    ("lies", "words"),
    [
        ({"front": [100.0], "rear": [400.0]}, "two points that are 250 mm apart cannot be"),
        ({"wheelbase": [50.0]}, "the robot stands at"),  # which only a turned robot shows
    ],
)
def test_distances_that_cannot_be_true_are_measured_again(
    lies: dict[str, list[float]], words: str
) -> None:
    robot, honest = Robot(1.5), Robot(1.5)
    robot.lies = lies
    log = guided("tape", SETUP, robot, robot.ride)
    (text,) = (text for text in robot.said if "measure again" in text or "right?" in text)
    assert words in text
    right = guided("tape", SETUP, honest, honest.ride)
    assert [run.tape for run in log.runs[:2]] == [run.tape for run in right.runs[:2]]
    found = calibrate(log, Config(), "the drive").found
    assert found["wheel_separation_multiplier"] == pytest.approx(1.5, rel=0.025)


@pytest.mark.parametrize("confirms", ["yes", "no"])
@pytest.mark.parametrize(
    ("lies", "words"),
    [
        ({"distance": [1500.0]}, r"you measured 1500 mm, but by its wheels .* 19\d\d mm"),
        ({"front": [300.0], "rear": [450.0]}, "the robot stands at 37 deg to the line"),
    ],
)
def test_a_reading_that_is_more_likely_misread_is_confirmed_or_measured_again(
    lies: dict[str, list[float]], words: str, confirms: str
) -> None:
    robot, honest = Robot(1.5), Robot(1.5)
    robot.lies, robot.confirms = {name: [*lie] for name, lie in lies.items()}, confirms
    runs = guided("tape", SETUP, robot, robot.ride).runs
    question = next(text for text in robot.said if "Is this right?" in text)
    assert re.search(words, question)
    right = guided("tape", SETUP, honest, honest.ride).runs
    assert (runs[0].tape == right[0].tape) is (confirms == "no")


@pytest.mark.parametrize(
    ("daemon", "file", "words"),
    [
        ("", "", ""),
        (REAL, REAL, ""),
        ("", REAL, 'mcu.port = "/dev/acsar_mcu"'),
        ("", "[drive]\nwheel_radius = 0.06\n", "has other values"),
    ],
)
def test_only_the_file_of_the_robot_that_was_driven_gets_its_values(
    daemon: str, file: str, words: str
) -> None:
    configs = parse(daemon.encode()), parse(file.encode())
    with pytest.raises(LogError, match=words) if words else nullcontext():
        require_own(*configs, "robot.toml")


def test_a_drive_of_the_simulator_for_a_robot_s_file_is_refused_before_it_begins() -> None:
    client = MagicMock()
    client.get.side_effect = [SimpleNamespace(simulated=True), effective(Config())]
    with pytest.raises(LogError, match="must not get the values of the simulator"):
        drive(client, Options(), Prompt(), "robot.toml", parse(REAL.encode()))


def test_a_robot_that_is_stopped_already_is_named_before_the_first_question() -> None:
    client = MagicMock()
    client.get.side_effect = [
        SimpleNamespace(simulated=True), effective(Config()),
        SimpleNamespace(mode="stopped", why="stopped by phone; type `acsard call clear`"),
    ]  # fmt: skip
    with pytest.raises(NotDrivenError, match="stopped by phone"):
        drive(client, Options("tape"), Prompt(), "", Config())


class Rides:
    """A daemon that answers queries, and the robot that a guided drive rides."""

    def __init__(self, text: str = "", mode: str = "ready") -> None:
        self.answers: dict[str, object] = {
            "info": SimpleNamespace(simulated=True, version="1.2"),
            "config": effective(parse(text.encode())),
            "state": SimpleNamespace(mode=mode, why="stopped by phone"),
        }
        self.where = SimpleNamespace(robot_id="acsar", endpoint="tcp/a", tls=None)
        self.session, self.robot, self.sensors = "the session", Robot(1.5), list[str]()
        self.disturbs: Callable[[], None] = lambda: None

    def get(self, name: str) -> Any:
        return self.answers[name]

    def key(self, name: str) -> str:
        return f"acsard/acsar/{name}"

    def add_gyro(self) -> None:
        self.sensors.append("gyro")

    def add_poses(self, key: str, session: object) -> None:
        self.sensors.append(f"{key} of {session}")

    def ride(self, leg: Leg) -> Run:
        self.disturbs()
        return self.robot.ride(leg)

    def drive(self, monkeypatch: pytest.MonkeyPatch, options: Options) -> tuple[Log, Config]:
        monkeypatch.setattr(guide, "Recorder", lambda client, config, prompt: self)
        client: Any = self
        return drive(client, options, self.robot, "", Config())


@pytest.mark.parametrize(
    ("text", "options", "sensors", "legs"),
    [
        ("", Options(), [], 4),
        ("[odometry]\ngyro = true\n", Options(), ["gyro"], 2),
        ("[odometry]\ngyro = true\n", Options(poses="mocap"), ["mocap of the session"], 2),
        ("", Options(poses="sim/pose"), ["acsard/acsar/sim/pose of the session"], 2),
        ("[odometry]\ngyro = true\n", Options("tape"), [], 4),
    ],
)
def test_the_method_follows_from_the_options_and_the_gyro(
    monkeypatch: pytest.MonkeyPatch, text: str, options: Options, sensors: list[str], legs: int
) -> None:
    robot = Rides(text)
    log, config = robot.drive(monkeypatch, options)
    assert robot.sensors == sensors
    assert len(log.runs) == legs
    assert config == parse(text.encode())


def test_the_cause_that_ends_a_guided_drive_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def raises(error: BaseException) -> Callable[[], None]:
        def disturb() -> None:
            raise error

        return disturb

    robot = Rides()
    robot.disturbs = raises(KeyboardInterrupt())
    with pytest.raises(LogError, match="the operator ended the drive"):
        robot.drive(monkeypatch, Options())
    robot.disturbs = raises(NotDrivenError("a reason"))
    with pytest.raises(NotDrivenError, match="a reason"):
        robot.drive(monkeypatch, Options())

    def stopped() -> None:
        robot.answers["state"] = SimpleNamespace(mode="stopped", why="stopped by phone")
        raise NotDrivenError("a reason")

    robot.disturbs = stopped
    with pytest.raises(NotDrivenError, match="stopped by phone"):
        robot.drive(monkeypatch, Options())
    for name, other in (
        ("info", SimpleNamespace(simulated=False)),
        ("config", effective(parse(b"[drive]\nwheel_radius = 0.06\n"))),
    ):
        robot = Rides()
        robot.disturbs = partial(robot.answers.__setitem__, name, other)
        with pytest.raises(LogError, match="another robot answers, or its settings were changed"):
            robot.drive(monkeypatch, Options())
    robot.answers["info"] = SimpleNamespace(simulated=False)
    with pytest.raises(UsageError, match="--yes is only for the built-in simulator"):
        robot.drive(monkeypatch, Options(without_person=True))
    robot.disturbs = raises(NotDrivenError("a reason"))
    with pytest.raises(NotDrivenError, match="a reason"):  # a person drives a real robot
        robot.drive(monkeypatch, Options())
    robot = Rides()
    robot.answers["config"] = {"drive": {"wheel_radius": "a"}}
    with pytest.raises(LogError, match=r"cannot read .* use the daemon's version, 1\.2"):
        robot.drive(monkeypatch, Options())


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[limits]\nangular_speed = 0.1\n", "raise limits.linear_speed"),
        ("[drive]\nwheel_separation = 1.6\n", "too large for a floor of 3 m x 3 m"),
    ],
)
def test_a_robot_that_cannot_be_guided_is_refused(text: str, words: str) -> None:
    with pytest.raises(LogError, match=words):
        Setup.of(parse(text.encode()))


@pytest.mark.parametrize(
    ("ratio", "words"),
    [(0.84, "it turned 302 deg"), (0.86, ""), (2.99, ""), (3.01, "it turned 1084 deg")],
)
def test_a_turn_of_a_credible_track_is_one(ratio: float, words: str) -> None:
    """The effective track is 0.85 to 3 wheel separations."""
    t = np.linspace(0.0, 9.0, 90)
    half = ratio * math.tau * Config().drive.wheel_separation / Config().drive.wheel_radius / 2 / 9
    still = np.full(len(t), half)
    run = run_of("round", {"left right": (t, -still, still)}, Notes())
    (leg,) = (leg for leg in legs("tape", SETUP) if leg.by_key)
    asked: list[str] = []

    class Stranger(Prompt):
        def start(self, text: str) -> None:
            asked.append(text)
            if len(asked) > 1:
                raise KeyboardInterrupt

        def show_text(self, text: str) -> None:
            asked.append(text)

        def instruct(self, text: str) -> None:
            pass

    with pytest.raises(KeyboardInterrupt) if words else nullcontext():
        assert guide._repeated(leg, "", Stranger(), lambda leg: run, Config().drive) is run
    assert words in asked[-2 if words else -1]


@pytest.mark.parametrize(
    ("text", "field", "value"),
    [
        ("", "speed", 0.3),
        ("[limits]\nlinear_speed = 0.2\n", "speed", 0.2),
        ("[limits]\nlinear_deceleration = 0.2\n", "speed", 0.2),  # it stops within 0.1 m
        ("[limits]\nwheel_speed = 5.0\n", "speed", 0.225),
        ("[limits]\nwheel_speed = 5.0\n", "rolling_speed", 0.225),  # 90 % of it
        ("", "rolling_speed", 0.5),
        ("", "length", 2.0),
        ("", "reach", 0.25),
        ("[drive]\nwheel_separation = 1.0\n", "length", 1.15),
    ],
)
def test_a_guided_drive_has_the_speed_and_length_that_robot_and_floor_allow(
    text: str, field: str, value: float
) -> None:
    assert getattr(Setup.of(parse(text.encode())), field) == pytest.approx(value)


def test_the_least_limits_of_a_guided_drive() -> None:
    for text, some in (
        ("linear_speed = 0.051", True), ("linear_speed = 0.049", False),
        ("angular_speed = 0.21", True), ("angular_speed = 0.19", False),
    ):  # fmt: skip
        with nullcontext() if some else pytest.raises(LogError, match=r"needs 0\.05 m/s and 0\.2"):
            Setup.of(parse(f"[limits]\n{text}\n".encode()))
    for separation, some in ((1.22, True), (1.26, False)):  # of which 0.8 m are left
        with nullcontext() if some else pytest.raises(LogError, match="too large for a floor"):
            Setup.of(parse(f"[drive]\nwheel_separation = {separation}\n".encode()))

"""Plays guided calibrations with a simulated robot.

The robot drives the legs, and a simulated person reads the tape.
"""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass, field, replace

import numpy as np

from acsard.calibration.guided.drive_plan import Leg, Setup, setup
from acsard.calibration.guided.methods import METHODS
from acsard.calibration.guided.runner import guide
from acsard.calibration.log_table import Table
from acsard.calibration.runs import Run, runs
from acsard.calibration.solve import Calibration
from acsard.core.config.settings import Config
from acsard.terminal.prompt import NumberQuestion, Prompt
from tests.unit.calibration.robots import Drive, Plan, Robot, drive

LENGTH = 0.25
"""Distance between the two wheels whose distances to the line the person measures, m."""

REACTION_RAD = 0.12
READ_M = 0.002


def anyone(seed: int) -> Robot:
    """Return a robot with random track, rate dependence and wheel radii."""
    rng = np.random.default_rng(seed)
    apart = float(rng.uniform(-0.005, 0.005))
    return Robot(
        chi=float(rng.uniform(1.0, 2.0)), rate=float(rng.uniform(0.0, 0.08)), left=1 - apart,
        right=1 + apart, place_hz=10.0, rng=rng,
    )  # fmt: skip


@dataclass
class Player:
    """The simulated robot and the person next to it."""

    robot: Robot
    gyro: bool = False
    places: bool = False
    yaw: float = 0.0
    """Heading since the person aligned the robot, rad.

    `place` is the position of its middle since then, m.
    """
    place: complex = 0j
    driven_s: float = 0.0
    outermost: complex = 0j
    drives: list[Drive] = field(default_factory=list)

    def ride(self, leg: Leg) -> Run:
        if "Mark" in leg.words:
            rng = self.robot.rng
            self.yaw = math.atan2(float(rng.normal(0, READ_M * math.sqrt(2))), LENGTH)
            self.place = 0j
        plan: Plan = [(move.seconds, move.linear, move.angular) for move in leg.moves]
        if leg.by_key:
            seconds, linear, angular = plan[-1]
            plan[-1] = (min(seconds, self._round_s(angular)), linear, angular)
        self.driven_s += sum(part[0] for part in plan)
        made = drive(replace(self.robot, slip=self.robot.slip), [*plan, (1.0, 0, 0)])
        self.drives.append(made)
        self.place += complex(made.where[-1]) * cmath.exp(1j * self.yaw)
        self.yaw += float(made.yaw[-1])
        return self._run(made)

    def _run(self, made: Drive) -> Run:
        """Convert the sensor samples of a drive to a run directly, without a CSV file."""
        sensors = [{"t": made.t, "left": made.left, "right": made.right}]
        if self.gyro:
            sensors.append({"t": made.gyro_t, "yaw_rate": made.gyro})
        if self.places:
            sensors.append({"t": made.place_t, "x": made.place.real, "y": made.place.imag})
        return runs(Table.joined(sensors)).runs[0]

    def _round_s(self, angular: float) -> float:
        rate = abs(angular)
        for _ in range(10):
            rate = abs(angular) / (self.robot.chi * (1 + self.robot.rate * rate))
        return (2 * math.pi + float(self.robot.rng.normal(0, REACTION_RAD))) / rate

    def answer(self, ask: NumberQuestion) -> float:
        number = self._measure(ask.words)
        if ask.unit == "mm":
            number = round(1000 * number)
        assert ask.least <= number <= ask.most, ask
        return float(number)

    def _measure(self, words: str) -> float:
        noise = float(self.robot.rng.normal(0, READ_M))
        off = math.remainder(self.yaw, math.pi)
        half = math.sin(off) / 2
        if "front left and the rear left" in words:
            return LENGTH
        for phrase, value in (
            ("front left wheel", 0.3 - LENGTH * half), ("rear left wheel", 0.3 + LENGTH * half),
            ("How far is", abs(self.place)),
        ):  # fmt: skip
            if phrase in words:
                return value + noise
        raise AssertionError(words)


class PlayedPrompt(Prompt):
    """A prompt that passes every question to the simulated person."""

    def __init__(self, player: Player) -> None:
        super().__init__()
        self._player = player

    def number(self, ask: NumberQuestion) -> float:
        return self._player.answer(ask)


def play(way: str, player: Player) -> Calibration:
    """Run a guided calibration with the simulated person and robot to its end."""
    return guide(way, usual_setup(), PlayedPrompt(player), player.ride)


def leg(way: str, name: str, track: float = 1.6) -> Leg:
    """Return the leg with this name of a calibration method, for a robot with this track."""
    (match,) = [entry for entry in METHODS[way].legs(usual_setup(), track) if entry.name == name]
    return match


def usual_setup() -> Setup:
    return setup(Config())

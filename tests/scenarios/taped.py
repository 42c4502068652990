"""Drives in virtual time, recorded in memory or in a file, for the tests of the black box."""

from __future__ import annotations

import random
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec

from acsard.core.config.parsing import effective
from acsard.core.config.settings import Config
from acsard.core.config.simulated_faults import FAULTS
from acsard.core.config.toml_text import document
from acsard.core.guard import Guard
from acsard.core.robot import Robot
from acsard.core.values import Heard, Instant, Recording
from acsard.recording.file import FrameWriter, Head, Steps, encode_steps, steps_of
from acsard.recording.recorded_steps import FinishedStep, PlainStep, RecordedStep
from acsard.recording.replay import Replay
from acsard.recording.state import freeze, thaw
from tests.scenarios.world import START, World

BATCH = 200
"""Number of steps; about a second."""

WITH_ARGUMENTS: dict[str, tuple[float, ...]] = {
    "stuck_encoder": (0,), "frozen_encoder": (1,), "dead_motor": (2,), "reversed_motor": (3,),
    "reversed_encoder": (0,), "reversed_wheel": (1,), "swapped_motors": (0, 1),
    "swapped_encoders": (2, 3), "swapped_wheels": (1, 2), "bias": (0, 1.2), "wrong_baud": (57600,),
    "pushed": (0.2,), "stalls": (0.5, 0.12), "battery": (90.0, 60.0),
}  # fmt: skip
"""An instance of every fault that needs arguments."""


ADDED = {"start", "continues", "reason", "waits", "clock", "gap", "cut", "failure"}
"""Names of the lines of the log that the export adds to the events of the robot."""


class Tape:
    """A recorder that stores all steps in memory."""

    def __init__(self, every: int = 0) -> None:
        """`every` is the number of steps between two stored robot states; 0 stores none.

        A test can also set `cut`, which stores one state at the next step.
        """
        self._every = every
        self.taken: list[FinishedStep] = []
        self.states: dict[int, bytes] = {}
        """The robot before the step of that number, for the steps that `cut` requests."""
        self.cut = False
        self.status = Recording("memory")

    def step(self, step: PlainStep, robot: Robot, guard: Guard) -> None:
        self.taken.append(FinishedStep(*step))
        if self.cut or (self._every and len(self.taken) % self._every == 0):
            self.cut = False
            self.states[len(self.taken)] = freeze(robot, guard.memory)

    def begins(self, robot: Robot, guard: Guard) -> None: ...

    def died(self, now: Instant, heard: Heard) -> None: ...

    def steps(self, first: int = 0) -> list[RecordedStep]:
        """Return the recorded steps from number `first` on, encoded and decoded again."""
        records = (
            msgspec.msgpack.encode(encode_steps(at, self.taken[at : at + BATCH]))
            for at in range(first, len(self.taken), BATCH)
        )
        return [s for data in records for s in steps_of(msgspec.msgpack.decode(data, type=Steps))]

    def save(
        self, path: Path, config: Config | None = None, first: int = 0, end: int | None = None
    ) -> Path:
        """Write the file that the daemon would write, and return its path.

        The file begins at the step `first`, and has a frame from there and from each stored state.
        Any step but the first one needs a stored state.
        """
        config = config or Config()
        text = "\n".join(document(effective(config))) + "\n"
        steps = self.taken[:end]
        with path.open("wb") as file:
            frames = FrameWriter(file)
            begins = sorted({first, *[n for n in self.states if first < n < len(steps)]})
            for begin, after in pairwise([*begins, len(steps)]):
                now, state = steps[begin].now, self.states.get(begin, b"")
                assert state or not begin
                times = now.mono_ns, now.wall_ns
                frames.begin(
                    Head("0.2.0", config.robot.id, begin, *times, text, state, START.wall_ns)
                )
                for at in range(begin, after, BATCH):
                    frames.add(encode_steps(at, steps[at : min(at + BATCH, after)]))
            frames.end()
        return path


def recorded_world(
    config: Config | None = None, *, every: int = 0, **options: Any
) -> tuple[Tape, World]:
    """Return a recorder in memory, and a new world with these options that it records."""
    tape = Tape(every=every)
    return tape, World(config, recorder=tape, **options)


def replayed(tape: Tape, config: Config, first: int = 0) -> Replay:
    """Replay the tape, from the start or from one of its states."""
    replay = Replay(*(thaw(tape.states[first]) if first else (Robot(config),)))
    for step in tape.steps(first):
        replay.step(step)
    return replay


INPUTS = {"estop", "bumpers"}
"""Faults after which the board no longer reports an input, which would keep the robot stopped."""

CASES: dict[str, tuple[float, ...]] = {
    name: () for name, fault in FAULTS.items() if not fault.arguments and name not in INPUTS
} | WITH_ARGUMENTS
"""The arguments of each fault of the simulator that a drive goes through."""


def of_board(world: World, name: str, arguments: tuple[float, ...]) -> list[float]:
    """Return the arguments of a fault with motors that the board has."""
    kinds, motors = FAULTS[name].arguments.split(":"), len(world.mcu.letters)
    given = zip(kinds, arguments, strict=False)
    return [value % motors if kind == "MOTOR" else value for kind, value in given]


def drive_through_faults(
    world: World, seconds: float, seed: int = 1, cases: dict[str, tuple[float, ...]] = CASES
) -> list[str]:
    """Drive with each fault in turn for half a second, then cause all other events, and repeat.

    Returns the names of the faults.
    """
    dice, end_ns, had = random.Random(seed), world.now_ns + int(seconds * 1e9), []
    while True:
        for name, arguments in cases.items():
            world.drive(dice.uniform(-1.5, 1.5), dice.uniform(-3, 3), 0.4, hz=20.0)
            with world.mcu.fault(name, *of_board(world, name, arguments)):
                world.hold(dice.uniform(-1, 1), dice.uniform(-2, 2), seconds=0.5)
            if world.state.mode == "fault":
                world.send(0.0)
                world.run(0.5)
                world.call("clear")
            had.append(name)
            if world.now_ns > end_ns:
                return had
        happenings(world, dice)


def happenings(world: World, dice: random.Random) -> None:
    """Cause each event that is not a fault of the simulator once.

    Examples are a stop, a stall, a blocked port, a jump of the wall clock, and a reset of the
    board.
    """
    world.call("stop")
    world.hold(0.5, seconds=2.1)  # a clear that names no latch is refused for 2 s
    assert world.call("clear").success
    world.call("set_pose", b'{"x": 1.5, "y": -2.0, "yaw": 0.3}')
    world.put("cmd/app", b'{"linear": {"x": "fast"}}')
    world.stall(dice.uniform(0.05, 0.4))
    world.drive(0.5, 0.1, 0.5, source="teleop")
    world.stall_in_step(0.03)
    world.hold(0.5, seconds=0.3, source="teleop")
    world.port.takes = 7
    world.run(0.1)
    world.port.blocked = True
    world.hold(0.5, seconds=0.2)
    world.port.blocked = False
    world.wall_offset_ns += dice.randrange(-(10**12), 10**12)
    world.port.unplug()
    world.port.trouble = "the serial port was lost; reopening it"
    world.run(0.5)
    world.port.trouble = ""
    world.port.plug(world.mcu)
    world.mcu.reset(world.now_ns)
    world.run(1.0)
    world.call("deactivate")
    world.call("activate")


def two_drivers(world: World) -> None:
    """Drive with the source nav, then with teleop. Stop and clear."""
    world.drive(0.5, 0.3, seconds=2.0, source="nav", hz=10.0)
    for n in range(40):
        world.send(0.5, 0.3, "nav")
        world.send(-0.3 if n else 0.0, -0.8 if n else 0.0, "teleop")
        world.run(0.05)
    world.call("stop")
    world.hold(0.3, seconds=0.5, source="teleop")
    world.call("clear")
    world.run(0.5)

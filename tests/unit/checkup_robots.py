"""Simulated robots on blocks for the tests of the checkup.

A simulation has a fake MCU, a wire in virtual time, and a person.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any

import msgspec
import pytest

from acsard.checkup import checkup_report, procedure
from acsard.checkup.board import Board
from acsard.checkup.findings import Finding
from acsard.core.config.settings import Config, McuConfig, WheelMap
from acsard.core.config.simulated_faults import parse
from acsard.core.simulator.fake_mcu import FakeMcu
from acsard.core.simulator.virtual_wire import VirtualWire
from acsard.core.values import NS_PER_S

MS = 1_000_000

TWO = Config(mcu=McuConfig(wheels=WheelMap(left="+l", right="+r")))

FOUR_AND_TWO = pytest.mark.parametrize("config", [Config(), TWO], ids=["four", "two"])
"""The tests of what the check does for a robot with four driven wheels and with two."""


class Robot(VirtualWire):
    """A robot with these faults that records every line it receives."""

    def __init__(self, *faults: str, config: Config | None = None, **mcu: Any) -> None:
        """Simulate the hardware that `config` describes, with these faults.

        `mcu` are keys of `[mcu]` that the host has configured differently.
        """
        self.built = config or Config()
        self.config = configured(self.built, **mcu)
        super().__init__(FakeMcu(self.built))
        self.faults = faults
        self.sent: list[bytes] = []
        self.sent_s: list[float] = []
        self.turned: dict[int, bool] = {}
        """Maps each wheel that turned since the last clear to whether it first turned forward."""
        self.opened: list[int] = []

    def open(self, baud_rate: int) -> None:
        super().open(baud_rate)
        self.opened.append(baud_rate)

    def send(self, data: bytes) -> None:
        self.sent.append(data)
        self.sent_s.append(self.now_ns() / NS_PER_S)
        for wheel, speed in enumerate(self.mcu.vehicle.speeds):
            if abs(speed) > 1.0:
                self.turned.setdefault(wheel, speed > 0)
        super().send(data)

    @contextmanager
    def faulty(self) -> Iterator[None]:
        with ExitStack() as stack:
            for text in self.faults:
                stack.enter_context(self.mcu.fault(*parse(text, self.mcu.letters)))
            yield

    @contextmanager
    def board(self, rest: bool = True) -> Iterator[Board]:
        """Yield the checkup's board with an open port.

        By default the motors have been shown to stand still, so that the board may turn them.
        """
        with self.faulty(), Board(self, self.config.mcu, self.config.rate_hz) as board:
            if rest:
                board.stop_motors()
                board.armed = True
            yield board

    def later(self) -> list[float]:
        """Return the size of the motors' set points a second later, when all lines have arrived."""
        self.mcu.advance(self.now_ns() + 1000 * MS)
        return [abs(speed) for speed in self.mcu.vehicle.set_points]


class Busy(Robot):
    """A robot on a computer that is overloaded for the first `until_s` seconds of the check.

    Every `every`-th wait ends `late_s` too late. The kernel holds the bytes that arrive meanwhile.
    """

    def __init__(
        self, *faults: str, late_s: float, every: int, until_s: float = math.inf, **how: Any
    ) -> None:
        super().__init__(*faults, **how)
        self._late_ns, self._every, self._until_ns = int(late_s * 1e9), every, until_s * 1e9
        self._waits = 0

    def wakes_late(self) -> bool:
        """Return whether the wait that starts now ends late."""
        self._waits += 1
        return self._waits % self._every == 0 and self.now_ns() < self._until_ns

    def listen(self, until_ns: int) -> list[tuple[int, bytes]]:
        if not self.wakes_late():
            return super().listen(until_ns)
        chunks = super().listen(until_ns + self._late_ns)
        return [(self.now_ns(), b"".join(data for _, data in chunks))] if chunks else []


class Starved(Busy):
    """A robot on an overloaded computer on which the simulated board runs as well.

    The board reads and writes too late, and the kernel reports how long it waited for a core.
    """

    def __init__(self, *faults: str, **how: Any) -> None:
        super().__init__(*faults, **how)
        self._runs_ns = self._waited_ns = 0
        self._held: list[bytes] = []

    def send(self, data: bytes) -> None:
        if self.now_ns() < self._runs_ns:
            self._held.append(data)
        else:
            super().send(data)

    def listen(self, until_ns: int) -> list[tuple[int, bytes]]:
        if self.now_ns() >= self._runs_ns and self.wakes_late():
            self._runs_ns = self.now_ns() + self._late_ns
        if self.now_ns() < self._runs_ns:
            self._now_ns = min(until_ns, self._runs_ns)
            if until_ns < self._runs_ns:
                return []
            self._waited_ns, backlog, self._held = self._late_ns, self._held, []
            for data in backlog:
                super().send(data)
        return VirtualWire.listen(self, until_ns)

    def late_ns(self) -> int:
        waited_ns, self._waited_ns = self._waited_ns, 0
        return waited_ns


def configured(config: Config, **mcu: Any) -> Config:
    """Return the configuration with these values in `[mcu]`."""
    changed = msgspec.structs.replace(config.mcu, **mcu)
    return msgspec.structs.replace(config, mcu=changed)


class Nobody:
    """An operator who confirms everything and reports nothing, as with `--yes`."""

    def doing(self, text: str) -> None: ...

    def keys(self, wait_s: float) -> str:
        return ""

    def ask(self, question: str, answers: Sequence[str]) -> str | None:
        return answers[0] if len(answers) == 1 else None


class Person(Nobody):
    """An operator next to the robot who reports how its wheels turned."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self.presses = {"emergency stop": 0, **{f"bumper {i}": i for i in range(1, 5)}}
        """The input that the person presses for each name; without an entry none."""
        self._pressed = ExitStack()

    def doing(self, text: str) -> None:
        self._robot.turned.clear()
        for name, number in self.presses.items():
            if text.startswith(f"press the {name} and"):
                name, *place = ("bumper_pressed", number) if number else ("estop_pressed",)
                self._pressed.enter_context(self._robot.mcu.fault(name, *place, 2.0, 0.5))

    def ask(self, question: str, answers: Sequence[str]) -> str | None:
        assert not any(abs(v) > 0.5 for v in self._robot.mcu.vehicle.speeds), "asked at speed"
        self._robot.listen(self._robot.now_ns() + 20_000 * MS)  # people are slow to answer
        turns = self._robot.turned
        if len(answers) == 1:
            return answers[0]
        if "ready" in answers:
            return "ready"
        if "forward" in answers:
            return "forward" if next(iter(turns.values())) else "back"
        names = ("r", "l") if "r" in answers else ("fr", "fl", "rl", "rr")
        return names[next(iter(turns))] if turns else "none"


class Checked:
    """The findings of a check of one robot."""

    def __init__(self, robot: Robot, person: bool | Person = False, fast: bool = True) -> None:
        self.findings: list[Finding] = []
        operator = person or Nobody()
        if operator is True:
            operator = Person(robot)
        with robot.faulty():
            procedure.run(robot, operator, robot.config, self.findings.append, fast=fast)
            self.left_turning = any(robot.later())
        self.changes = checkup_report.changes(self.findings, robot.config)

    def __getitem__(self, name: str) -> Finding:
        """Return the finding whose name starts with this text."""
        return next(f for f in self.findings if f.name.startswith(name))

    def named(self, verdict: str) -> list[str]:
        return [f.name for f in self.findings if f.verdict == verdict]

    @property
    def failed(self) -> list[str]:
        return self.named("FAIL")


def check(*faults: str, person: bool = False, **how: Any) -> Checked:
    """Check a robot with these faults and return the findings."""
    return Checked(Robot(*faults, **how), person)

"""A robot whose steps a test makes one by one, with a board that answers in each of them."""

from __future__ import annotations

from typing import Any

from msgspec.structs import replace

from acsard.core.config.settings import Config, FeedbackConfig
from acsard.core.link.codec import Codec
from acsard.core.messages.snapshot import Snapshot
from acsard.core.robot import Robot
from acsard.core.summary import summary
from acsard.core.values import (
    NS_PER_S,
    REST,
    Answer,
    Command,
    GyroSample,
    Instant,
    Latches,
    Plain,
    Pose,
    Received,
    Request,
    Twist,
    Verb,
    WheelSpeeds,
)
from tests.stepped import Inputs, Outputs, SteppedRobot
from tests.wheels import STEADY

MS = 1_000_000
WALL_NS = 1_800_000_000 * NS_PER_S
GO = Twist(0.5, 0.0)
ZERO_LINE = b"ap00.00,bp00.00,cp00.00,dp00.00\r\n"
ROLLING = WheelSpeeds(10.0, 10.0, 10.0, 10.0)
"""Wheel speeds of 0.5 m/s straight on."""


class Rig:
    """A robot in a simulated time.

    In each step the board sends `reply`, or nothing if that is None, and the status lines `status`.
    Nothing follows from its wheels unless they are `watched`, because it reports the same speeds
    whatever it gets.
    """

    def __init__(
        self,
        config: Config | None = None,
        latches: Latches = Latches(),  # noqa: B008
        status: bytes = b"",
        watched: bool = False,
    ) -> None:
        config = replace(config or Config(limits=STEADY), feedback=FeedbackConfig(encoders=watched))
        self.robot = Robot(config, latches)
        self.stepped = SteppedRobot(self.robot)
        self.codec = Codec(config.mcu.wheels, config.mcu.trailing_comma)
        self.reply: bytes | None = self.codec.stop
        self.status = status
        self.now_ns, self.period_ms = 50 * NS_PER_S, 1000 / config.rate_hz
        self.opened, self.port_open, self.shutting_down = 1, True, False
        self.out = self.stepped.step(Inputs(self.now, tick=False, port_open=False))

    @property
    def now(self) -> Instant:
        return Instant(self.now_ns, self.now_ns + WALL_NS)

    def step(
        self,
        *twists: Twist,
        source: str = "app",
        ask: Verb | None = None,
        pose: Pose | None = None,
        ms: float | None = None,
        gyro: float | None = None,
        late_ms: float | None = None,
        **inputs: Any,
    ) -> Outputs:
        """Make a step a period later, or `ms` later, with commands of `source`.

        A `clear` or `activate` names the faults of the last step, else all causes. `late_ms`:
        another clock stamped the commands so long ago. `inputs` are more values of `Inputs`.
        """
        named = self.out.latches.of("fault") or self.out.latches.causes
        releases = ask in ("clear", "activate") and named
        shown = tuple([cause.number for cause in named]) if releases else None
        self.now_ns += int((self.period_ms if ms is None else ms) * MS)
        stamp_ns = None if late_ms is None else self.now_ns + WALL_NS - int(late_ms * MS)
        data = b"" if self.reply is None else self.reply + self.status
        every: dict[str, Any] = {
            "tick": True,
            "received": (Received(self.now, data),) if data and self.port_open else (),
            "commands": tuple(Command(source, t, self.now_ns, stamp_ns) for t in twists),
            "gyro": () if gyro is None else (GyroSample(self.now_ns, None, gyro),),
            "requests": (Request(ask, 7, pose, numbers=shown),) if ask else (),
        }
        self.out = self.stepped.step(
            Inputs(
                now=self.now,
                port_open=self.port_open,
                opened=self.opened,
                shutting_down=self.shutting_down,
                **every | inputs,
            )
        )
        return self.out

    def each(self, count: int, *twists: Twist, **inputs: Any) -> list[Outputs]:
        return [self.step(*twists, **inputs) for _ in range(count)]

    def run(self, count: int, *twists: Twist, **inputs: Any) -> Outputs:
        """Return the outputs of the last of these steps."""
        return self.each(count, *twists, **inputs)[-1]

    def path(self, count: int, *twists: Twist, **inputs: Any) -> list[float]:
        return [out.applied.linear for out in self.each(count, *twists, **inputs)]

    def linked(self) -> Rig:
        """Step until the link is up: a line, the question, and three lines."""
        assert self.run(5).link == "up"
        return self

    def driving(self, twist: Twist = GO, steps: int = 60) -> Rig:
        """Bring the link up, arm with a zero, and send the twist until the robot has reached it."""
        self.linked().step(REST)
        assert self.run(steps, twist).mode == "driving"
        return self

    def drives(self) -> bool:
        """Return whether the sender drives again, after a zero but not before it."""
        before = {out.mode for out in self.each(20, GO)}
        self.step(REST)
        return "driving" not in before and self.step(GO).mode == "driving"

    def unplug(self) -> Rig:
        self.port_open = False
        return self

    def replug(self) -> Rig:
        self.port_open, self.opened = True, self.opened + 1
        return self

    def board(self, status: bytes) -> Rig:
        """Let the board send these status lines from now on."""
        self.status = status
        return self

    def answer(self, ask: Verb, pose: Pose | None = None) -> Answer:
        (answer,) = self.step(ask=ask, pose=pose).answers
        assert answer.id == 7
        return answer

    def asked(self, *requests: Request, **inputs: Any) -> Outputs:
        return self.step(requests=requests, **inputs)

    def set(self, settings: dict[str, Plain]) -> Answer:
        return self.asked(Request("set", 7, settings=settings)).answers[0]

    @property
    def mode(self) -> str:
        return self.out.mode

    @property
    def snapshot(self) -> Snapshot:
        return summary(self.robot, self.now_ns)

    @property
    def counters(self) -> dict[str, int]:
        return self.snapshot.state.counters


def names(outputs: Outputs) -> list[str]:
    return [event.name for event in outputs.events]

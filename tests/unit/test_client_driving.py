"""The client's `drive` in virtual time. It watches the `state` and ends by it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import zenoh
from msgspec.structs import replace

from acsard.client.driving import (
    Driver,
    UnheardError,
    drive,
    move,
    repeat_zeros,
)
from acsard.client.follower import FIRST_STATE_TIMEOUT_S, ROBOT_SILENCE_TIMEOUT_S, SETTLED_S
from acsard.client.ride import GRACE_S, OPEN_TIMEOUT_S
from acsard.core.messages.schema import RobotState, SourceState, Time
from acsard.core.values import NS_PER_S
from acsard.host import clock
from acsard.host.errors import NoAnswerError, NotDrivenError, UsageError
from tests.each import each
from tests.unit.screens import sample_of

US, OTHER = "joe/1/aa", "ann/2/bb"
NEUTRAL = "send a zero first: app must send a zero"


def source(waits_for: str = "", age: float | None = 0.01, name: str = "app") -> SourceState:
    kinds = {"": "nothing", "a command": "command", NEUTRAL: "neutral"}
    return SourceState(name, 50, age, waits_for, kinds.get(waits_for, "higher"))


FOLLOWED = RobotState(
    stamp=Time(1), mode="driving", reason="commanded by app", x=0, y=0, yaw=0, linear=0.0,
    angular=0.0, wheels=[], link="up", source="app", sources=[source()], refused="", counters={},
    sender=US,
)  # fmt: skip
STOPPED = replace(FOLLOWED, mode="stopped", reason="stopped by request", source="")
OPENING = replace(
    FOLLOWED, mode="ready", reason=NEUTRAL, source="app", sources=[source(NEUTRAL)], sender=""
)
HIGHER = replace(
    FOLLOWED,
    source="teleop",
    reason="commanded by teleop",
    sources=[source("teleop has priority: wait until it is silent")],
)

Says = Callable[[float, float, list[float]], RobotState | None]
"""Returns the daemon's state from the time in s, the last commanded m/s, and all commands."""


class World:
    """A robot, a clock and a daemon that publishes its state ten times a second."""

    source, sender = "app", US

    newest: World

    def __init__(self, responder: Says) -> None:
        World.newest = self
        self.now = 100.0
        self.sent: list[float] = []
        self.counters: dict[str, int] = {}
        self.asked = 0
        self.subscribed = self.answers = True
        self.published = True
        self.dies = math.inf
        """Time after which only a router's storage answers, with the last state, s."""
        self.stored: Any = None
        self.stalls: tuple[float, float] = math.inf, 0.0
        """Time at which this program stops running, and for how long, s. The states of this time
        are lost, except for one that waits in the queue."""
        self.blocks: tuple[float, float] = math.inf, 0.0
        """Time from which the bus accepts nothing, and for how long, s."""
        self._says, self._told = responder, 100.0

    def send(self, linear: float, angular: float = 0.0) -> None:
        self._block()
        self.sent.append(linear)

    def subscribe(self, name: str) -> Any:
        assert name == "state"
        self._block()
        return self

    def undeclare(self) -> None:
        self.subscribed = False

    def try_recv(self) -> Any:
        if not self.published or self.now < self._told or self.passed >= self.dies:
            return None
        self._told = self.now + 0.1
        self.stored = self._sample()
        return self.stored

    def start_query(self, name: str, take: Any) -> None:
        self.asked += 1
        sample = self._sample() if self.passed < self.dies else self.stored
        if self.answers and sample is not None:
            take(sample)

    def _sample(self) -> Any:
        state = self._says(self.passed, self.sent[-1] if self.sent else 0.0, self.sent)
        if state is None:
            return None
        stamp, counters = Time.from_ns(int(self.now * NS_PER_S)), self.counters or state.counters
        return sample_of(replace(state, stamp=stamp, counters=counters))

    @property
    def passed(self) -> float:
        return self.now - 100.0

    def drive(self, seconds: float = 1.0) -> float:
        """Drive at 0.5 m/s and return how long it took, s."""
        for pause in self.steps(seconds):
            self.now += pause
            self._stall()
        return self.passed

    def steps(self, seconds: float = 1.0) -> Iterator[float]:
        """Yield the pauses of a drive at 0.5 m/s, and send one zero after an error."""
        robot: Any = self
        driver = Driver(robot)
        try:
            yield from drive(0.5, 0.0, seconds)(driver)
        except BaseException:
            next(driver.zeros(), None)
            raise
        finally:
            driver.end()

    def _block(self) -> None:
        begin, blocked = self.blocks
        if self.passed >= begin:
            self.now += blocked
            self.blocks = math.inf, 0.0

    def _stall(self) -> None:
        begin, stalled = self.stalls
        if self.passed >= begin:
            self.now += stalled
            self.stalls = math.inf, 0.0


@pytest.fixture(autouse=True)
def _clock(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the clock that also advances during a suspend show the time of the newest world."""
    monkeypatch.setattr(clock, "steady_s", lambda: World.newest.now)


def followed(t: float, last: float, sent: list[float]) -> RobotState:
    """Return the state of a daemon at time `t`, s.

    The sender is armed after 0.3 s. The robot rolls on until 1.8 s after its last command.
    """
    if t < 0.3:
        return OPENING
    return replace(FOLLOWED, linear=last or (0.2 if any(sent) and t < 1.8 else 0.0))


def test_a_drive_starts_with_zeros_and_returns_when_the_robot_is_at_rest() -> None:
    world = World(followed)
    took = world.drive()
    first = world.sent.index(0.5)
    assert set(world.sent[:first]) == {0.0}
    assert first >= 20
    assert world.sent.count(0.5) in (20, 21)  # the last one may cover a fraction of a period
    assert world.sent[-1] == 0.0
    assert 1.6 <= took < 2.1
    assert (world.subscribed, world.asked) == (False, 0)


def without_speed(t: float, last: float, sent: list[float]) -> RobotState:
    state = followed(t, last, sent)
    return state if t < 1.3 else replace(state, linear=None, angular=None)


@each(
    ("responder", "least", "most"),
    [
        (lambda t, last, sent: replace(FOLLOWED, linear=0.3), 2.3, 3.0),
        (without_speed, 2.0, 3.0),
        # A long ramp.
        (lambda t, last, sent: replace(FOLLOWED, linear=max(0.0, 0.5 - t / 20)), 9.7, 10.2),
    ],
)
def test_a_drive_waits_for_rest_as_long_as_the_robot_slows_down(
    responder: Says, least: float, most: float
) -> None:
    assert least < World(responder).drive() < most


def after(seconds: float, state: RobotState | None) -> Says:
    return lambda t, last, sent: followed(t, last, sent) if t < seconds else state


AGAINST: list[tuple[str, Says, type[Exception], str, float, bool]] = [
    ("stopped", after(0, STOPPED), NotDrivenError, "stopped by request", SETTLED_S, False),
    ("stopped on the way", after(0.9, STOPPED), NotDrivenError, "by request", 0.9, True),
    ("in fault", after(0, replace(STOPPED, mode="fault", reason="fault: rear_left wheel is stuck")),
     NotDrivenError, "rear_left wheel is stuck", SETTLED_S, False),
    ("switched off", after(0, replace(STOPPED, mode="inactive", reason="switched off")),
     NotDrivenError, "switched off", SETTLED_S, False),
    ("unlisted", after(0, replace(FOLLOWED, sources=[source(name="nav")])), UnheardError,
     "app is not one of commands.sources: nav; add app",
     SETTLED_S, False),
    ("no link", after(0, replace(STOPPED, mode="waiting", reason="waiting for the first lines")),
     NotDrivenError, "first lines", OPEN_TIMEOUT_S, False),
    ("link lost", after(1.0, replace(STOPPED, mode="waiting", reason="no line for 0.3 s")),
     NotDrivenError, "no line", 1.0 + GRACE_S, True),
    ("unheard", after(0, replace(STOPPED, mode="ready", sources=[source("a command", None)])),
     UnheardError, "receives no command of source app", OPEN_TIMEOUT_S, False),
    ("outranked", after(0, HIGHER), NotDrivenError, "has priority", OPEN_TIMEOUT_S, False),
    ("outranked on the way", after(0.9, HIGHER), NotDrivenError, "priority", 0.9 + GRACE_S, True),
    ("another sender", after(0, replace(FOLLOWED, sender=OTHER)), NotDrivenError, OTHER,
     OPEN_TIMEOUT_S, False),
    ("dead", after(0, None), NoAnswerError, "nothing received", FIRST_STATE_TIMEOUT_S, False),
    ("killed on the way", after(1.0, None), NoAnswerError, "nothing",
     0.9 + ROBOT_SILENCE_TIMEOUT_S, True),
]  # fmt: skip


@each(("name", "responder", "error", "words", "took", "moved"), AGAINST)
def test_a_drive_that_is_not_followed_ends_with_the_reason_and_a_zero(
    name: str, responder: Says, error: type[Exception], words: str, took: float, moved: bool
) -> None:
    world = World(responder)
    with pytest.raises(error, match=words) as raised:
        world.drive(60.0)
    assert type(raised.value) is error
    if isinstance(raised.value, UnheardError):
        assert raised.value.lacks_only_commands == (name == "unheard")
    assert took - 0.05 <= world.passed <= took + 0.3
    assert (0.5 in world.sent) == moved
    assert (world.sent[-1], world.subscribed) == (0.0, False)


def test_a_drive_whose_connection_is_closed_ends_with_that_reason() -> None:
    class Closing(World):
        def send(self, linear: float, angular: float = 0.0) -> None:
            super().send(linear, angular)
            if self.passed > 0.9:
                raise zenoh.ZError("session closed")

    world = Closing(followed)
    with pytest.raises(NoAnswerError, match="was closed while the robot was driving"):
        world.drive(60.0)
    assert 0.9 < world.passed < 1.0


def test_a_stop_while_the_last_zeros_are_sent_is_named() -> None:
    usual = World(followed)
    usual.drive(1.0)
    world = World(after(usual.passed - 0.15, STOPPED))
    with pytest.raises(NotDrivenError, match="stopped by request"):
        world.drive(1.0)
    assert world.sent[-1] == 0.0
    assert world.passed <= usual.passed + 0.1


@each(
    ("trouble", "begins", "lasts", "seconds"),
    [
        ("stalls", 0.1, 4.0, 60.0),
        ("stalls", 0.9, 4.0, 60.0),
        ("stalls", 0.9, 4.0, 1.0),  # the end of the drive passes meanwhile
        ("blocks", 0.1, 0.6, 60.0),
        ("blocks", 0.9, 0.6, 60.0),
    ],
)
def test_a_drive_ends_after_the_program_stalled_or_the_bus_accepted_no_command(
    trouble: str, begins: float, lasts: float, seconds: float
) -> None:
    """The daemon publishes its state during a stall, so a state waits in the client's queue."""
    world = World(followed)
    setattr(world, trouble, (begins, lasts))
    words = rf"sent no command for {lasts:.0f}\.[01] s" if lasts > 1 else r"command for 0\.[67] s"
    with pytest.raises(NotDrivenError, match=rf"{words}.*not finished.*suspended"):
        world.drive(seconds)
    assert begins + lasts <= world.passed < begins + lasts + 0.2
    assert (0.5 in world.sent) == (begins == 0.9)
    assert (world.sent[-1], world.subscribed) == (0.0, False)


@each(
    ("trouble", "begins", "lasts"),
    [
        ("blocks", 0.0, 0.6),  # a slow subscription
        ("stalls", 0.9, 0.8 * GRACE_S),
        ("stalls", 1.5, 4.0),  # it only waits for the robot to stop
    ],
)
def test_a_drive_outlasts_a_harmless_pause(trouble: str, begins: float, lasts: float) -> None:
    world = World(followed)
    setattr(world, trouble, (begins, lasts))
    assert world.drive() < 2.1 + lasts
    assert world.sent.count(0.5) > 10


@each("seconds", [0.4, 1.0, 60.0])
@each("dies", [0.35, 0.7, 1.0])
def test_a_stored_state_of_a_dead_robot_keeps_no_drive_running(seconds: float, dies: float) -> None:
    """A router's storage answers queries with the last state of a robot that is off."""
    world = World(followed)
    world.dies = dies
    with pytest.raises(NoAnswerError, match="nothing received"):
        world.drive(seconds)
    assert world.asked
    assert world.passed <= dies + ROBOT_SILENCE_TIMEOUT_S + 0.3
    assert world.sent[-1] == 0.0


def test_a_wrong_number_is_refused_before_a_command_is_sent() -> None:
    value: Any
    for value in (float("nan"), float("inf"), "0.1", None, [0.1]):
        for place, name in enumerate(("linear", "angular", "seconds")):
            numbers = [0.1, 0.1, 0.1]
            numbers[place] = value
            with pytest.raises(UsageError, match=f"^{name} = .*finite"):
                drive(*numbers)
    with pytest.raises(UsageError, match="linear: this number is too large"):
        drive(10**400, 0.0, 1.0)
    for seconds in (0, -0.5):
        words = f"seconds = {seconds:g}: a drive needs a time above 0"
        with pytest.raises(UsageError, match=words):
            drive(5.0, 0.0, seconds)
    for speed in (0.0, -0.3):
        with pytest.raises(UsageError, match=f"speed = {speed:g}: it must be above 0"):
            move(-1.0, speed)


# the zeros at the end of a drive that was interrupted


def zeros_of(world: World, idle_s: float | None = None) -> float:
    """Send the zeros of a drive that was interrupted `idle_s` ago, and return how long it took."""
    robot: Any = world
    for pause in repeat_zeros(robot, None if idle_s is None else world.now - idle_s):
        world.now += pause
    return world.passed


def test_zeros_are_repeated_until_the_state_shows_rest() -> None:
    world = World(lambda t, last, sent: replace(FOLLOWED, linear=0.3 if t < 1.0 else 0.0))
    assert 1.0 < zeros_of(world) < 1.5
    assert set(world.sent) == {0.0}
    assert len(world.sent) > 20
    assert not world.subscribed


@each(
    ("says", "is_sent"),
    [
        (lambda *_: replace(FOLLOWED, source="nav", sender=OTHER, linear=0.3), False),
        (lambda *_: None, True),
        (followed, True),
    ],
)
def test_a_sender_that_was_idle_sends_no_zero_if_the_robot_follows_another_source(
    says: Says, is_sent: bool
) -> None:
    world = World(says)
    world.now += 1.0
    zeros_of(world, 2 * GRACE_S)
    assert set(world.sent) == ({0.0} if is_sent else set())
    assert not world.subscribed

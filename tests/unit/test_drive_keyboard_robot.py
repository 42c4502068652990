"""A drive by the keyboard: when a key moves the robot, and when only zeros are sent."""

from __future__ import annotations

import time
from types import SimpleNamespace
from typing import Any, cast

import pytest
from msgspec.structs import replace

from acsard.bus.address import Address
from acsard.client.driving import MAX_END_S
from acsard.client.ride import GRACE_S, RELEASE_TIMEOUT_S
from acsard.core.messages.schema import RobotState, SourceState
from acsard.core.values import NS_PER_S
from acsard.host import clock
from acsard.top.drive_screen import Teleop
from acsard.top.keyboard import (
    RELEASE_REASON,
    REPEAT_S,
    Keyboard,
    KeyboardDrive,
)
from acsard.top.terminal import print_last_report
from tests.each import each
from tests.unit.screens import STATE, sample_of

# the robot's published state

FOLLOWED = replace(
    STATE,
    source="teleop",
    sender="joe/1/aa",
    sources=[SourceState("teleop", 100, 0.02, "", "nothing")],
)
STOPPED = replace(FOLLOWED, mode="stopped", reason="stopped by request", source="")
ZERO_FIRST = replace(
    FOLLOWED,
    mode="ready",
    reason="send a zero first: teleop must send a zero before it can drive",
    sources=[SourceState("teleop", 10, 0.1, "send a zero first: teleop must send", "neutral")],
)


class Robot:
    """A client whose robot publishes `shows` at each step, unless it is None."""

    source, sender = "teleop", FOLLOWED.sender
    where = Address("tcp/127.0.0.1:7448", "acsar", "")

    def __init__(self, shows: RobotState | None = FOLLOWED) -> None:
        self.shows = shows
        self.is_fresh = False
        self.sent: list[float] = []

    def subscribe(self, name: str) -> Any:
        return SimpleNamespace(try_recv=self.receive, undeclare=lambda: None)

    def receive(self) -> Any:
        fresh, self.is_fresh = self.is_fresh, False
        return sample_of(self.shows) if fresh and self.shows else None

    def start_query(self, name: str, take: Any) -> None:
        """Do nothing: the query of the follower gets no answer."""

    def send(self, linear: float, angular: float = 0.0) -> None:
        self.sent.append(linear)


class Drive:
    """A keyboard drive with a clock that the test sets, and its robot."""

    newest: Drive

    def __init__(self) -> None:
        Drive.newest = self
        self.now, self.asleep = 100.0, 0.0
        robot: Any = Robot()
        self.robot = robot
        self.ride = KeyboardDrive(self.robot, Keyboard(0.5, 2.0))

    def step(self, typed: str = "", times: int = 1) -> list[float]:
        """Type this text at each step of 0.05 s, and return the speeds that were sent."""
        sent = len(self.robot.sent)
        for _ in range(times):
            self.robot.is_fresh = True
            self.ride.step(typed)
            self.now += 0.05
        return list(self.robot.sent[sent:])

    def for_s(self, typed: str, seconds: float) -> list[float]:
        return self.step(typed, round(seconds / 0.05))

    def drives(self, typed: str, times: int = 20) -> bool:
        """Type this text at each step, and return whether the drive sends a speed."""
        return any(self.step(typed, times))

    @property
    def objection(self) -> str:
        return self.ride.screen_data().objection


@pytest.fixture(autouse=True)
def _clock(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the clocks show the time of the newest drive."""

    def wait(seconds: float) -> None:
        Drive.newest.now += seconds

    monkeypatch.setattr(time, "sleep", wait)
    of = Drive
    monkeypatch.setattr(clock, "asleep_ns", lambda: round(of.newest.asleep * NS_PER_S))
    monkeypatch.setattr(
        clock, "mono_ns", lambda: round((of.newest.now - of.newest.asleep) * NS_PER_S)
    )


def test_only_a_drive_after_a_silence_is_led_by_a_zero_and_a_space_stops_at_the_next_step() -> None:
    drive = Drive()
    assert drive.step(times=40) == []
    assert drive.step("i", times=3) == [0.0, 0.5, 0.5]
    assert drive.step("m") == [-0.5]
    assert drive.step(" ") == [0.0]


def test_a_drive_that_ends_repeats_its_zero_for_two_seconds_at_most() -> None:
    drive = Drive()
    drive.step("i", times=3)
    sent, begun = len(drive.robot.sent), drive.now
    drive.ride.end()
    assert drive.now - begun == pytest.approx(MAX_END_S, abs=0.06)
    assert set(drive.robot.sent[sent:]) == {0.0}
    assert len(drive.robot.sent[sent:]) == pytest.approx(41, abs=1)


@each("asleep", [60.0, 0.0])
@each("reads", [[""], ["i"], [8 * "i"], [64 * "i", "ii"]])
def test_a_key_that_was_pressed_before_or_in_a_stall_does_not_drive_after_it(
    reads: list[str], asleep: float
) -> None:
    """The computer is suspended for `asleep` s of the stall. Keys are typed during the stall."""
    drive = Drive()
    drive.step("i", times=5)
    sent = len(drive.robot.sent)
    drive.now += 60.0
    drive.asleep += asleep
    for read in reads:
        drive.ride.step(read)
        drive.now += 0.005
    drive.step(times=10)
    assert set(drive.robot.sent[sent:]) <= {0.0}
    assert drive.step("i", times=4)[-1] == 0.5


# a held key that the robot does not follow

NOT_FOLLOWING = [
    *(replace(STOPPED, mode=mode) for mode in ("stopped", "fault", "inactive")),
    ZERO_FIRST,
]


def held(why: RobotState) -> Drive:
    """Return a drive with a held key. A state then shows why the robot does not obey it."""
    drive = Drive()
    drive.step(times=5)
    assert drive.step("i", times=20)[-1] == 0.5
    drive.robot.shows = why
    drive.step("i")
    return drive


@each("why", NOT_FOLLOWING)
@each("pause", [0.0, 0.4, 1.0])
def test_a_key_that_is_held_while_the_robot_ceases_to_follow_does_not_drive_after_a_pause(
    why: RobotState, pause: float
) -> None:
    drive = held(why)
    assert not drive.drives("i")
    drive.robot.shows = FOLLOWED
    assert not drive.drives("", round(pause / 0.05))
    assert not drive.drives("i")


def test_a_delayed_space_does_not_release_a_key_that_no_longer_drives() -> None:
    """The key is held before and after a stall. Only a space that arrives in time releases it."""
    drive = held(STOPPED)
    drive.robot.shows = FOLLOWED
    drive.step("i", times=10)
    drive.now += 1.2 * GRACE_S
    assert not drive.drives(" ", 1)
    assert not drive.drives("", 5)
    assert not drive.drives("i")
    drive.step(" ")
    assert drive.drives("i")


@each(("key", "seconds"), [(" ", 0.05), ("k", 0.05), ("", REPEAT_S + RELEASE_TIMEOUT_S + 0.1)])
def test_a_key_drives_again_after_a_stop_or_its_release(key: str, seconds: float) -> None:
    drive = held(ZERO_FIRST)
    drive.step("i", times=10)
    drive.robot.shows = FOLLOWED
    drive.for_s(key, seconds)
    assert drive.step("i", times=4)[-2:] == [0.5, 0.5]


def test_the_operator_is_told_why_keys_have_no_effect_and_what_a_held_key_needs() -> None:
    drive = Drive()
    drive.robot.shows = STOPPED
    drive.step(times=10)
    drive.for_s("i", GRACE_S - 0.1)
    assert drive.objection == ""
    drive.step("i", times=12)
    assert drive.objection == "stopped by request"
    drive.robot.shows = replace(FOLLOWED, mode="ready", source="")
    drive.step("i", times=12)
    assert drive.objection == RELEASE_REASON
    assert "press space, then press the key again" in RELEASE_REASON
    drive.step(" ")
    assert drive.objection == ""
    drive.robot.shows = replace(FOLLOWED, mode="ready", source="", sources=[])
    drive.step("i", times=20)
    assert "is not one of commands.sources" in drive.objection


# the last report


class Ended:
    """A drive that has ended. Each `take` shows the robot's next state, and then the last one."""

    def __init__(self, *states: RobotState) -> None:
        Drive()
        self.states = list(states)

    def take(self) -> None:
        if len(self.states) > 1:
            self.states.pop(0)

    def screen_data(self) -> Teleop:
        return Teleop("acsar", "tcp/127.0.0.1:7448", "teleop", 0.5, 1.0, self.states[0], 0.0)


def test_the_last_report_waits_until_the_robot_no_longer_follows_the_drive(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("os.isatty", lambda _: True)
    moving = replace(STATE, source="teleop", reason="commanded by teleop")
    still = replace(moving, linear=0.0, angular=0.0, wheels=[0.0] * 4)
    ready = replace(still, mode="ready", reason="waiting for a command", source="")
    other = replace(still, reason="commanded by nav", source="nav")
    for states, last in (
        ((moving, moving, still, still, ready), "ready: waiting for a command"),
        ((still, still, other, ready), "driving: commanded by nav"),
    ):
        print_last_report(cast(KeyboardDrive, Ended(*states)))
        assert f"drive ended: the robot stands still; {last}" in capsys.readouterr().out

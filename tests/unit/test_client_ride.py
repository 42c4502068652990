"""The rules of a ride: zeros first, the newest wish, an objection ends it, zeros until rest."""

from __future__ import annotations

from msgspec.structs import replace

from acsard.client.follower import ROBOT_SILENCE_TIMEOUT_S, SETTLED_S, Follower
from acsard.client.ride import (
    MAX_SOURCE_TIMEOUT_S,
    OPEN_TIMEOUT_S,
    OPENING_PERIOD_S,
    SEND_PERIOD_S,
    SLOWS_S,
    STALE_S,
    Ride,
)
from acsard.core.messages.schema import RobotState, SourceState
from acsard.core.values import REST, Twist
from tests.each import each
from tests.unit.screens import STATE

OURS, RELEASED = "joe/1/aa", 100.0
AHEAD, LEFT = Twist(0.5, 0.0), Twist(0.0, 1.0)


def with_age(state: RobotState, age: float | None) -> RobotState:
    return replace(state, sources=[SourceState("app", 50, age, "", "nothing")])


MOVING = with_age(replace(STATE, source="app", sender=OURS), 0.02)
RESTING = replace(MOVING, linear=0.0, angular=0.0)
STOPPED = replace(RESTING, mode="stopped", reason="stopped by ann", source="")


class Rider:
    """A ride with a clock, whose robot publishes `shows` ten times a second."""

    def __init__(self, shows: RobotState | None = MOVING) -> None:
        self.now, self.shows = 100.0, shows
        self.follower = Follower(self.now)
        self.ride = Ride("app", OURS, self.follower, self.now)
        self._published = self.now

    def wish(self, twist: Twist | None, seconds: float) -> list[Twist]:
        """Wish this each 10 ms, and return the commands that were due."""
        sent = []
        for _ in range(round(seconds / 0.01)):
            self.ride.wish(twist, self.now)
            command = self.ride.due(self.now)
            sent += [command] if command is not None else []
            self.now += 0.01
            if self.shows is not None and self.now - self._published > 0.099:
                self._published = self.now
                self.follower.published(self.shows, self.now)
                self.ride.state(self.shows, self.now)
        return sent


def test_zeros_come_before_a_speed_until_a_state_shows_that_the_robot_follows() -> None:
    rider = Rider(replace(RESTING, mode="ready", source=""))
    assert rider.wish(AHEAD, 1.0) == [REST] * round(1.0 / OPENING_PERIOD_S)
    rider.shows = MOVING
    sent = rider.wish(AHEAD, 1.0)
    assert 1 <= sent.count(REST) <= 10
    assert sent[-1] == AHEAD


def test_a_wish_is_repeated_while_it_is_wanted_and_a_newer_one_replaces_it_at_once() -> None:
    rider = Rider()
    rider.wish(AHEAD, 1.0)
    assert rider.wish(AHEAD, 1.0) == [AHEAD] * round(1.0 / SEND_PERIOD_S)
    assert rider.wish(LEFT, 0.01) == [LEFT]
    # A program that wishes nothing new sends no speed, and one without a wish no zero.
    assert rider.ride.due(rider.now + STALE_S) == REST
    assert Rider().wish(None, 1.0) == []


def test_an_objection_ends_the_ride_until_the_person_lets_go() -> None:
    rider = Rider()
    rider.wish(AHEAD, 1.0)
    rider.shows = STOPPED
    rider.wish(AHEAD, 0.2)
    assert rider.ride.ended == "stopped by ann"
    rider.shows = MOVING
    assert set(rider.wish(AHEAD, 5.0)) <= {REST}
    rider.wish(REST, 0.01)
    assert rider.ride.ended == ""
    assert rider.wish(AHEAD, 1.0)[-1] == AHEAD


def test_a_short_silence_of_a_robot_that_follows_does_not_interrupt_the_speed() -> None:
    rider = Rider()
    rider.wish(AHEAD, 1.0)
    rider.shows = None
    assert set(rider.wish(AHEAD, ROBOT_SILENCE_TIMEOUT_S - 0.2)) == {AHEAD}
    assert rider.wish(AHEAD, 0.5)[-1] == REST


def test_a_robot_that_never_accepts_the_zeros_ends_the_ride() -> None:
    rider = Rider(replace(RESTING, mode="ready", source="", reason="nav drives"))
    rider.wish(AHEAD, OPEN_TIMEOUT_S - 0.1)
    assert rider.ride.ended == ""
    rider.wish(AHEAD, 0.2)
    assert rider.ride.ended


def test_zeros_that_were_not_accepted_before_the_person_let_go_do_not_count() -> None:
    rider = Rider(replace(RESTING, mode="ready", source="", reason="nav drives"))
    rider.wish(AHEAD, OPEN_TIMEOUT_S - 0.2)
    rider.wish(None, 0.5)
    rider.wish(AHEAD, OPEN_TIMEOUT_S - 0.2)
    assert rider.ride.ended == ""


def test_a_zero_of_a_program_is_sent_once_and_keeps_no_other_sender_waiting() -> None:
    rider = Rider()
    assert rider.wish(REST, 0.01) == [REST]
    assert rider.wish(None, 5.0) == []


# the zeros at the end


def is_over_after(state: RobotState, seconds: float) -> bool:
    """Return whether a ride is over for which this state is published after its last speed."""
    follower = Follower(RELEASED)
    ride = Ride("app", OURS, follower, RELEASED)
    ride.moved(RELEASED)
    ride.state(state, RELEASED + seconds)
    return ride.is_over(RELEASED + seconds)


@each(
    "state",
    [
        RESTING,
        replace(RESTING, linear=0.005, angular=-0.01),
        replace(MOVING, sender="ann/2/bb"),
        replace(MOVING, source="teleop"),
        with_age(replace(MOVING, mode="stopped"), None),
    ],
)
def test_zeros_end_if_a_state_shows_that_the_sender_stopped_the_robot(
    state: RobotState,
) -> None:
    assert is_over_after(state, SETTLED_S + 0.05)
    assert not is_over_after(state, SETTLED_S - 0.05), "it may be older than the last speed"


@each(
    "state",
    [
        MOVING,
        replace(RESTING, angular=0.5),
        replace(RESTING, angular=-0.5),
        replace(RESTING, linear=-0.5),
        replace(RESTING, linear=None, angular=None),
        # The daemon has not received the commands that the network holds.
        with_age(RESTING, 0.25),
        with_age(RESTING, None),
        with_age(replace(RESTING, mode="ready", source="", sender=""), 0.25),
    ],
)
def test_zeros_go_on_while_no_state_shows_that_they_arrived(state: RobotState) -> None:
    assert not is_over_after(state, SETTLED_S + 0.2)


@each("state", [MOVING, replace(RESTING, linear=None, angular=None)])
def test_zeros_end_if_another_moves_the_robot_or_its_speed_is_unknown(
    state: RobotState,
) -> None:
    rider = Rider(MOVING)
    rider.wish(AHEAD, 1.0)
    rider.shows = state
    zeros = len(rider.wish(None, 5.0)) * SEND_PERIOD_S
    assert SLOWS_S <= zeros < SLOWS_S + 0.5


def test_zeros_go_on_while_the_robot_slows_down_and_end_after_the_longest_timeout() -> None:
    rider = Rider(MOVING)
    rider.wish(AHEAD, 1.0)
    for tenths in range(50, 0, -1):
        rider.shows = replace(MOVING, linear=tenths / 100, angular=0.0)
        assert rider.wish(None, 0.1)
    rider.shows = RESTING
    rider.wish(None, 0.2)
    assert rider.wish(None, 5.0) == []
    rider = Rider()
    rider.wish(AHEAD, 1.0)
    rider.shows = None
    assert rider.wish(None, MAX_SOURCE_TIMEOUT_S - 0.1)[-1] == REST
    rider.wish(None, 0.2)
    assert rider.wish(None, 5.0) == []

"""Tests of the rule that says how long a sender repeats the zero that ends its drive."""

from __future__ import annotations

from msgspec.structs import replace

from acsard.client.commander import MAX_SOURCE_TIMEOUT_S
from acsard.client.final_zeros import FinalZeros
from acsard.client.follower import SETTLED_S
from acsard.core.messages.schema import RobotState, SourceState
from tests.each import each
from tests.unit.top.screens import STATE

OURS, RELEASED = "joe/1/aa", 100.0


def with_age(state: RobotState, age: float | None) -> RobotState:
    return replace(state, sources=[SourceState("app", 50, age, "", "nothing")])


MOVING = with_age(replace(STATE, source="app", sender=OURS), 0.02)
RESTING = replace(MOVING, linear=0.0, angular=0.0)


def wanted_after(first: RobotState, second: RobotState, pause: float = SETTLED_S) -> bool:
    """Return whether a zero is wanted after two states that arrive after a release."""
    zeros = FinalZeros("app", OURS)
    zeros.drove(RELEASED)
    zeros.received(first, RELEASED + 0.1)
    zeros.received(second, RELEASED + 0.1 + pause)
    return zeros.wanted(RELEASED + 0.2 + pause)


def test_a_sender_that_never_drove_repeats_no_zero() -> None:
    assert not FinalZeros("app", OURS).wanted(RELEASED)


@each(
    "state",
    [
        RESTING,
        replace(RESTING, linear=None, angular=None),
        replace(RESTING, linear=0.005, angular=-0.01),
        replace(MOVING, sender="ann/2/bb"),
        replace(MOVING, source="teleop"),
        with_age(replace(MOVING, mode="stopped"), None),
    ],
)
def test_no_zero_is_wanted_if_the_states_show_that_the_sender_has_stopped_the_robot(
    state: RobotState,
) -> None:
    assert not wanted_after(state, state, 0.25)


@each(
    "state",
    [
        MOVING,
        replace(RESTING, angular=0.5),
        # The daemon has not received the commands that the network holds.
        with_age(RESTING, 0.5),
        with_age(RESTING, None),
        with_age(replace(RESTING, mode="ready", source="", sender=""), 0.5),
    ],
)
def test_a_zero_is_wanted_while_the_states_do_not_show_that_it_arrived(state: RobotState) -> None:
    assert wanted_after(state, state, 0.25)
    assert wanted_after(RESTING, state, 0.25)


def test_one_state_that_may_be_older_than_the_release_is_not_enough() -> None:
    assert wanted_after(RESTING, RESTING, 0.1)


def test_states_from_before_the_last_speed_do_not_count() -> None:
    zeros = FinalZeros("app", OURS)
    zeros.received(RESTING, RELEASED - 1.0)
    zeros.drove(RELEASED)
    zeros.received(RESTING, RELEASED + 0.1)
    assert zeros.wanted(RELEASED + 0.1)


def test_a_zero_is_wanted_for_the_longest_timeout_at_most() -> None:
    zeros = FinalZeros("app", OURS)
    zeros.drove(RELEASED)
    assert zeros.wanted(RELEASED + MAX_SOURCE_TIMEOUT_S - 0.1)
    assert not zeros.wanted(RELEASED + MAX_SOURCE_TIMEOUT_S)

"""Tests of the judge of the latches: each way by which a cause may go, and one that it may not."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from tests.simulate.causes import Call, Cause, Causes
from tests.simulate.promises import BrokenError
from tests.simulate.roads import NS

ANN, BOB = Cause("stop", ("stopped", "", "ann")), Cause("stop", ("stopped", "", "bob"))
FAULT, OFF = Cause("fault", ("driver_fault", "", "")), Cause("inactive", ("switched_off", "", ""))


def held(*causes: Cause) -> Causes:
    """Return the judge of a robot that is held since 1 s by these causes: 1, 2 and so on."""
    judge = Causes()
    judge.step(NS, dict(enumerate(causes, 1)))
    judge.step(NS + NS // 100, dict(enumerate(causes, 1)))
    return judge


def released(
    judge: Causes, left: dict[int, Cause], numbers: tuple[int, ...] | None, asked_s: float = 9.0
) -> None:
    """Let a clear arrive and be answered in a step that has these causes."""
    at_ns = int(asked_s * NS)
    judge.call(7, Call("clear", numbers, at_ns))
    judge.answered(7, True)
    judge.step(at_ns, left)


@pytest.mark.parametrize(
    "play",
    [
        lambda: released(held(ANN, BOB), {2: BOB}, (1,)),
        lambda: released(held(ANN, FAULT), {}, (1, 2)),
        lambda: released(held(ANN, FAULT), {1: ANN}, None),
        lambda: released(held(ANN, BOB), {}, None),
        lambda: released(held(ANN, BOB), {2: BOB, 3: ANN}, ()),
        lambda: released(held(ANN, OFF), {2: OFF}, (1, 2)),
    ],
)
def test_a_call_releases_what_it_names_and_without_numbers_the_faults_first(
    play: Callable[[], None],
) -> None:
    play()


@pytest.mark.parametrize(
    "play",
    [
        lambda: released(held(ANN, BOB), {}, (1,)),
        lambda: released(held(ANN, BOB), {1: ANN, 2: BOB}, (1,)),
        lambda: released(held(ANN, FAULT), {}, None),
        lambda: released(held(ANN), {}, None, asked_s=2.9),
        lambda: released(held(ANN, OFF), {}, (1, 2)),
        lambda: held(ANN).step(9 * NS, {}),
    ],
)
def test_a_cause_that_goes_or_stays_otherwise_is_a_finding(play: Callable[[], None]) -> None:
    with pytest.raises(BrokenError, match="a call releases what it names"):
        play()


def test_a_refused_call_releases_nothing() -> None:
    judge = held(ANN)
    judge.call(7, Call("clear", (1,), 9 * NS))
    judge.answered(7, False)
    with pytest.raises(BrokenError):
        judge.step(9 * NS, {})


def test_no_number_is_used_twice() -> None:
    judge = held(ANN)
    released(judge, {}, (1,))
    with pytest.raises(BrokenError, match="used twice"):
        judge.step(10 * NS, {1: BOB})


def test_causes_outlast_a_restart_unless_the_file_lacks_them() -> None:
    for lost in (False, True):
        judge = held(ANN, BOB)
        judge.restart(lost)
        if lost:
            judge.step(2 * NS, {})
            continue
        with pytest.raises(BrokenError):
            judge.step(2 * NS, {1: ANN})


def test_a_call_without_numbers_must_work_two_seconds_behind_the_newest_cause() -> None:
    judge = held(ANN)
    assert not judge.is_shown(3 * NS)
    assert judge.is_shown(4 * NS)

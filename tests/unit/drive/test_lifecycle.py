"""The mode beside its table: on or off, latched why, and whether a clear came too soon."""

from __future__ import annotations

import pytest

from acsard.drive.lifecycle import Lifecycle
from acsard.drive.modes import Mode, RefusedError, Trigger


def ready() -> Lifecycle:
    life = Lifecycle(active=True)
    life.link(up=True)
    return life


def test_it_waits_for_its_link_or_is_switched_off_at_the_start() -> None:
    assert Lifecycle(active=True).mode is Mode.WAITING
    assert Lifecycle(active=False).mode is Mode.INACTIVE


def test_activating_tells_whether_it_was_off() -> None:
    life = Lifecycle(active=False)
    assert life.activate(linked=True)
    assert life.mode is Mode.READY
    assert not life.activate(linked=True)


def test_a_stop_latches_until_a_later_clear() -> None:
    life = ready()
    life.stop(now_ns=100)
    assert (life.mode, life.latched) == (Mode.STOPPED, "stopped by request")
    life.clear(asked_ns=101, now_ns=110, linked=True)
    assert (life.mode, life.latched) == (Mode.READY, "")


@pytest.mark.parametrize(("asked_ns", "now_ns"), [(99, 110), (100, 110), (101, 100)])
def test_a_clear_that_did_not_know_of_the_stop_is_refused(asked_ns: int, now_ns: int) -> None:
    life = ready()
    life.stop(now_ns=100)
    with pytest.raises(RefusedError, match="call it again"):
        life.clear(asked_ns, now_ns, linked=True)
    assert life.mode is Mode.STOPPED


def test_without_a_stop_a_clear_is_never_too_soon() -> None:
    life = ready()
    life.fault("wheel", 0)
    life.clear(asked_ns=1, now_ns=1, linked=True)
    assert life.mode is Mode.READY


def test_a_clear_without_a_link_waits_for_it() -> None:
    life = ready()
    life.stop(now_ns=1)
    life.clear(asked_ns=2, now_ns=3, linked=False)
    assert life.mode is Mode.WAITING


def test_a_robot_that_was_off_is_off_after_stop_and_clear() -> None:
    life = ready()
    life.deactivate()
    life.stop(now_ns=1)
    life.clear(asked_ns=2, now_ns=3, linked=True)
    assert life.mode is Mode.INACTIVE


def test_the_first_fault_is_the_one_that_is_told() -> None:
    life = ready()
    assert life.fault("first", 0)
    assert not life.fault("second", 0)
    assert (life.mode, life.latched) == (Mode.FAULT, "first")


def test_a_fault_after_a_stop_takes_its_place() -> None:
    life = ready()
    life.stop(now_ns=1)
    assert life.fault("wheel", 0)
    assert (life.mode, life.latched) == (Mode.FAULT, "wheel")


def test_stopping_in_fault_or_on_the_way_down_says_what_holds_the_robot() -> None:
    life = ready()
    life.fault("wheel", 0)
    assert "in fault" in life.stop(now_ns=1)
    assert life.latched == "wheel"
    life.fire(Trigger.LEAVE)
    assert "going down" in life.stop(now_ns=2)
    assert not life.fault("too late", 0)


def test_a_clear_that_was_asked_before_the_fault_does_not_release_it() -> None:
    life = ready()
    life.stop(10)
    life.clear(asked_ns=11, now_ns=11, linked=True)
    life.fault("wheel", 30)
    with pytest.raises(RefusedError, match="fault"):
        life.clear(asked_ns=20, now_ns=30, linked=True)
    assert life.latched == "wheel"
    life.clear(asked_ns=40, now_ns=40, linked=True)
    assert life.mode is Mode.READY


def test_a_fault_that_goes_on_does_not_put_its_clear_off() -> None:
    life = ready()
    life.fault("wheel", 30)
    assert not life.fault("wheel", 50)
    life.clear(asked_ns=40, now_ns=50, linked=True)
    assert life.mode is Mode.READY


def test_a_clear_of_nothing_changes_nothing() -> None:
    life = ready()
    life.fire(Trigger.COMMAND)
    assert not life.clear(asked_ns=1, now_ns=1, linked=True)
    assert life.mode is Mode.DRIVING

"""A suspend of the computer is reported once."""

from __future__ import annotations

from acsard.host.asleep import MOMENT_NS, Asleep
from acsard.host.clock import asleep_ns


def test_a_sleep_is_told_once_and_the_next_one_too() -> None:
    slept = [5 * MOMENT_NS]
    asleep = Asleep(lambda: slept[0])
    assert not asleep.was()
    for _ in range(2):
        slept[0] += MOMENT_NS
        assert asleep.was()
        assert not asleep.was()


def test_who_loses_the_processor_between_the_two_clocks_has_not_slept() -> None:
    readings = [0, 3 * MOMENT_NS, 0, 0]
    asleep = Asleep(lambda: readings.pop(0))
    assert not asleep.was()
    assert not asleep.was()


def test_this_machine_is_awake() -> None:
    asleep = Asleep(asleep_ns)
    assert not any(asleep.was() for _ in range(1000))

"""A viewer whose commands have no effect gets the reason once."""

from __future__ import annotations

from acsard.client.commander import GRACE_S
from acsard.core.values import NS_PER_S
from acsard.foxglove.notices import Objections

OBJECTS_NS = int(GRACE_S * NS_PER_S)

WHY = "stopped by request"


def test_the_first_moment_is_no_news() -> None:
    told = Objections()
    assert not told.look(WHY, 0)
    assert not told.look(WHY, OBJECTS_NS - 1)
    assert told.look(WHY, OBJECTS_NS)
    assert told.told == WHY


def test_it_is_told_once_and_taken_back_when_over() -> None:
    told = Objections()
    changes = [told.look(WHY if n < 20 else "", n * OBJECTS_NS) for n in range(30)]
    assert changes.count(True) == 2
    assert changes[1]
    assert changes[20]
    assert told.told == ""


def test_another_reason_is_told_at_once() -> None:
    told = Objections()
    told.look(WHY, 0)
    told.look(WHY, OBJECTS_NS)
    assert told.look("fault", OBJECTS_NS + 1)
    assert told.told == "fault"


def test_what_is_over_soon_is_never_told() -> None:
    told = Objections()
    assert not any(told.look(WHY if n % 2 else "", n * (OBJECTS_NS - 1)) for n in range(20))

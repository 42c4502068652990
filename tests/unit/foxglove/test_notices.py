"""Each viewer gets each notice once. A viewer that connects later gets the lasting notices."""

from __future__ import annotations

from typing import Any

import pytest

from acsard.client.commander import GRACE_S
from acsard.core.values import NS_PER_S
from acsard.foxglove.notices import MAX_WAITING, REPEAT_RATE, Notices, Objections
from acsard.host import clock
from tests.unit.foxglove.status_messages import Server

OBJECTS_NS = int(GRACE_S * NS_PER_S)

WHY = "stopped by request"


def sent_texts(notices: Notices, *, newcomers: bool = False) -> list[str]:
    """Send the waiting notices and return what a viewer saw."""
    server: Any = Server()
    notices.send(server, lambda line: None, newcomers=newcomers)
    return list(server.shown)


def test_a_notice_is_repeated_only_after_a_while(monkeypatch: pytest.MonkeyPatch) -> None:
    notices, again_ns = Notices(lambda text: None, lambda: None), int(NS_PER_S / REPEAT_RATE.hz)
    for at_ns in (0, again_ns - 1, again_ns):
        monkeypatch.setattr(clock, "mono_ns", lambda at_ns=at_ns: at_ns)
        notices.enqueue("warning", "drive", "too slow")
    assert sent_texts(notices) == ["too slow", "too slow"]


def test_a_lasting_notice_is_repeated_only_with_another_text_or_after_it_was_over() -> None:
    notices = Notices(lambda text: None, lambda: None)
    for text in ("gone", "gone", "no reply", "gone"):
        notices.enqueue("error", "daemon", text, status_id="daemon")
    assert sent_texts(notices) == ["gone", "no reply", "gone"]
    notices.enqueue("error", "daemon", "gone", status_id="daemon")
    assert sent_texts(notices) == []
    notices.remove("daemon")
    notices.enqueue("error", "daemon", "gone", status_id="daemon")
    assert sent_texts(notices) == ["without daemon", "gone"]


def test_a_new_viewer_gets_the_lasting_statuses_until_they_are_over() -> None:
    notices = Notices(lambda text: None, lambda: None)
    notices.enqueue("error", "daemon", "gone", status_id="daemon")
    notices.enqueue("info", "set", "done")
    assert sent_texts(notices) == ["gone", "done"]
    assert sent_texts(notices, newcomers=True) == ["gone"]
    notices.remove("daemon")
    assert sent_texts(notices) == ["without daemon"]
    assert sent_texts(notices, newcomers=True) == []


def test_the_newest_notices_wait_for_the_viewers_and_each_wakes_the_main_thread() -> None:
    wakes: list[int] = []
    notices = Notices(lambda text: None, lambda: wakes.append(1))
    for number in range(MAX_WAITING + 3):
        notices.enqueue("info", "test", str(number))
    assert sent_texts(notices) == [str(number) for number in range(3, MAX_WAITING + 3)]
    assert len(wakes) == MAX_WAITING + 3


# why commands do not drive


def test_an_objection_is_reported_only_after_a_delay() -> None:
    objections = Objections()
    assert not objections.update(WHY, 0)
    assert not objections.update(WHY, OBJECTS_NS - 1)
    assert objections.update(WHY, OBJECTS_NS)
    assert objections.reported == WHY


def test_an_objection_is_reported_once_and_withdrawn_when_it_is_over() -> None:
    objections = Objections()
    changes = [objections.update(WHY if n < 20 else "", n * OBJECTS_NS) for n in range(30)]
    assert changes.count(True) == 2
    assert changes[1]
    assert changes[20]
    assert objections.reported == ""


def test_another_objection_is_reported_without_a_delay() -> None:
    objections = Objections()
    objections.update(WHY, 0)
    objections.update(WHY, OBJECTS_NS)
    assert objections.update("fault", OBJECTS_NS + 1)
    assert objections.reported == "fault"


def test_an_objection_that_is_over_soon_is_never_reported() -> None:
    objections = Objections()
    assert not any(objections.update(WHY if n % 2 else "", n * (OBJECTS_NS - 1)) for n in range(20))

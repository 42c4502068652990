"""The role is the highest that answers, whatever the order, and silence is none."""

from __future__ import annotations

from itertools import permutations
from types import SimpleNamespace
from typing import Any

import pytest

from acsard.bus import identity as rooms
from acsard.bus.identity import Identity, identity
from acsard.values import ROLES


def of(*answering: str) -> Identity:
    def ask(name: str, take: Any) -> None:
        asked.append(name)
        if len(asked) == len(ROLES):  # all are asked before any is waited for
            for role in answering:
                take(SimpleNamespace(key_expr=f"acsard/acsar/whoami/{role}"))

    asked: list[str] = []
    return identity(ask, "", "joe/1/aa")


@pytest.fixture(autouse=True)
def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rooms, "WHOAMI_S", 0.05)
    monkeypatch.setattr(rooms, "WHOAMI_MORE_S", 0.02)


def test_the_highest_role_that_answers_is_ours_in_any_order() -> None:
    for count in range(1, len(ROLES) + 1):
        for answering in permutations(ROLES[:count]):
            assert of(*answering).role == ROLES[count - 1]


def test_no_answer_and_a_strangers_are_no_role() -> None:
    assert of().role == of("admin").role == ""


def test_what_a_role_lacks_is_told_with_the_role_it_takes_and_else_nothing() -> None:
    viewer = Identity("viewer", "anna", "joe/1/aa")
    assert viewer.lacks("srv/clear") == (
        "your certificate anna is viewer: it may follow and stop, not drive; "
        "srv/clear is for a certificate that is operator"
    )
    assert viewer.lacks("srv/stop") == viewer.lacks("state") == ""
    assert Identity("maintainer", "", "x").lacks("config") == ""
    assert Identity("", "", "x").lacks("config") == ""


def test_a_certificate_without_a_role_is_named_with_what_to_do_whatever_the_key() -> None:
    nobody = Identity("", "anna", "joe/1/aa")
    for told in (nobody.words(), nobody.unlisted, nobody.lacks("state"), nobody.lacks("srv/set")):
        assert "your certificate anna is in no role's list" in told
        assert "viewers, operators or maintainers of [access]" in told
        assert "no daemon" in told  # which looks the same from here
    assert Identity("viewer", "anna", "x").unlisted == Identity("", "", "x").unlisted == ""

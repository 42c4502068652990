"""Who a client is, and the connections that end with their program."""

from __future__ import annotations

from itertools import permutations
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from acsard import client
from acsard.client import identity as rooms
from acsard.client.identity import ClientIdentity, identity
from acsard.core.values import ROLES


def of(*answering: str) -> ClientIdentity:
    def ask(name: str, take: Any) -> None:
        asked.append(name)
        if len(asked) == len(ROLES):  # every key is queried before the first reply is awaited
            for role in answering:
                take(SimpleNamespace(key_expr=f"acsard/acsar/whoami/{role}"))

    asked: list[str] = []
    return identity(ask, "", "joe/1/aa")


@pytest.fixture(autouse=True)
def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rooms, "WHOAMI_S", 0.05)
    monkeypatch.setattr(rooms, "WHOAMI_MORE_S", 0.02)


def test_the_highest_role_that_answers_in_any_order_is_the_role_of_the_client() -> None:
    for count in range(1, len(ROLES) + 1):
        for answering in permutations(ROLES[:count]):
            assert of(*answering).role == ROLES[count - 1]


def test_neither_silence_nor_an_unknown_answer_gives_a_role() -> None:
    assert of().role == of("admin").role == ""


def test_a_missing_permission_is_reported_with_the_role_that_it_needs() -> None:
    viewer = ClientIdentity("viewer", "anna", "joe/1/aa")
    assert viewer.lacks("srv/clear") == (
        "your certificate anna has the role viewer: this role may read data and stop the robot, "
        "but not drive it; srv/clear needs at least the role operator"
    )
    assert viewer.lacks("srv/stop") == viewer.lacks("state") == ""
    assert ClientIdentity("maintainer", "", "x").lacks("config") == ""
    assert ClientIdentity("", "", "x").lacks("config") == ""
    words = "you connect without a certificate and have the role operator: "
    assert ClientIdentity("operator", "", "x").describe().startswith(words)
    assert viewer.lacks("json/no/such/key") == ""


def test_a_silent_robot_leads_to_questions_first_about_the_id_and_to_no_claim() -> None:
    nobody = ClientIdentity("", "anna", "joe/1/aa", "robot1", "tls/a.local:7449")
    for text in (nobody.describe(), nobody.lacks("state"), nobody.lacks("srv/stop")):
        assert text.startswith("no daemon answers as 'robot1' at tls/a.local:7449")
        assert "queried key: acsard/robot1/whoami/viewer" in text
        assert text.index("is --id right") < text.index("daemon run") < text.index("role's list")
        assert "your certificate, anna," in text
        assert "add" not in text
    stranger = ClientIdentity("", "", "joe/1/aa", "robot1", "tcp/127.0.0.1:7448")
    assert stranger.describe().startswith("no daemon answers as 'robot1' at tcp/127.0.0.1:7448")
    assert "certificate" not in stranger.describe()
    unknown = ClientIdentity("", "", "joe/1/aa", "robot1").describe()
    assert unknown.startswith("no daemon answers as 'robot1' (queried key: acsard/robot1/")
    assert ClientIdentity("", "", "joe/1/aa").describe().startswith("no daemon answers: is --id")
    assert ClientIdentity("viewer", "anna", "x").silence == stranger.silence == ""


NOBODY_LISTENS = "tls/127.0.0.1:1"


def test_a_directory_without_certificates_is_not_taken_for_a_missing_daemon(
    tmp_path: Path,
) -> None:
    with (
        pytest.raises(client.CertificateError, match="acsard tls") as error,
        client.connect(NOBODY_LISTENS, tls=str(tmp_path / "laptop-anna")),
    ):
        pass
    assert isinstance(error.value, ValueError)

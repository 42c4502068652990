"""What the client puts on each command, without a bus."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from acsard import client
from acsard.client import Client
from acsard.config.settings import DriveConfig, JointsConfig
from acsard.drive.kinematics import Kinematics
from acsard.incoming.commands import Arrival, Receiver
from acsard.values import Command

RECEIVER = Receiver(JointsConfig(), Kinematics(DriveConfig()))


class Session:
    """Takes what is put, as the daemon would hear it."""

    def __init__(self, zid: str) -> None:
        self._zid = zid
        self.heard: list[Command] = []

    def zid(self) -> str:
        return self._zid

    def new_timestamp(self) -> None:
        return None

    def put(self, key: str, payload: bytes, *, encoding: str, attachment: bytes, **_: Any) -> None:
        key = key.removeprefix("acsard/acsar/")
        arrival = Arrival(key, True, payload, encoding, 0, None, "", attachment=attachment)
        self.heard.append(RECEIVER.command(arrival))


@pytest.fixture
def session() -> Session:
    return Session("0123456789abcdef")


def client_of(session: Session) -> Client:
    fake: Any = session
    return Client(fake, "acsar", "app")


def test_each_command_has_its_sender_its_number_and_when_it_was_sent(session: Session) -> None:
    client = client_of(session)
    before_ns = time.time_ns()
    for _ in range(3):
        client.send(0.5)
    assert [one.sequence for one in session.heard] == [1, 2, 3]
    (sender,) = {one.sender for one in session.heard}
    assert sender.endswith("/01234567")
    stamps = [one.stamp_ns or 0 for one in session.heard]
    assert before_ns <= stamps[0] + 1_000_000
    assert stamps == sorted(stamps)
    assert stamps[-1] <= time.time_ns() + 1_000_000


def test_two_sessions_of_one_process_are_two_senders(session: Session) -> None:
    other = Session("fedcba9876543210")
    for one in (session, other):
        client_of(one).send(0.5)
    assert session.heard[0].sender != other.heard[0].sender


# certificates

NOBODY_LISTENS = "tls/127.0.0.1:1"


@pytest.fixture
def shared() -> Iterator[Path]:
    """A directory that all may enter, also where `tmp_path` is in one that only root may."""
    with tempfile.TemporaryDirectory() as name:
        Path(name).chmod(0o755)
        yield Path(name)


AS_NOBODY = """\
import os, sys
from acsard.client import connect
if os.geteuid() == 0:
    os.setgroups([])
    os.setgid(65534)
    os.setuid(65534)
try:
    with connect(sys.argv[1], tls=sys.argv[2]):
        pass
except PermissionError as error:
    print(error)
"""


def test_certificates_that_one_may_not_read_are_a_permission_error(shared: Path) -> None:
    for name in ("ca.pem", "certificate.pem", "key.pem"):
        (shared / name).write_text("of somebody else")
        (shared / name).chmod(0o600 if os.geteuid() == 0 else 0)
    words = [sys.executable, "-c", AS_NOBODY, NOBODY_LISTENS, str(shared)]
    done = subprocess.run(words, capture_output=True, text=True, timeout=30.0, check=True)
    assert str(shared / "ca.pem") in done.stdout


def test_a_directory_without_certificates_is_said_and_not_taken_for_a_missing_daemon(
    tmp_path: Path,
) -> None:
    with (
        pytest.raises(client.CertificateError, match="acsard lan") as error,
        client.connect(NOBODY_LISTENS, tls=str(tmp_path / "laptop-anna")),
    ):
        pass
    assert isinstance(error.value, ValueError)


def test_every_error_that_the_client_tells_of_can_be_had_from_it() -> None:
    assert client.__doc__ is not None
    told = {line.split()[0] for line in client.__doc__.splitlines() if line.startswith("    ")}
    errors = {name for name in told if name.endswith("Error")}
    assert errors == {n for n in client.__all__ if n.endswith("Error")} - {"AcsardError"}
    assert all(issubclass(getattr(client, name), client.AcsardError) for name in errors)

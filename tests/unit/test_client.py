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

import msgspec
import pytest

from acsard import client
from acsard.client import Client
from acsard.config.settings import DriveConfig, JointsConfig
from acsard.drive.kinematics import Kinematics
from acsard.incoming.commands import Arrival, Receiver
from acsard.values import REST, Command, Twist

RECEIVER = Receiver(JointsConfig(), Kinematics(DriveConfig()))


class Samples:
    """What comes on a key."""

    def __init__(self, *samples: Any) -> None:
        self._samples = list(samples)
        self.undeclared = False

    def try_recv(self) -> Any:
        return self._samples.pop(0) if self._samples else None

    def undeclare(self) -> None:
        self.undeclared = True


class Session:
    """Takes what is put, as the daemon would hear it."""

    def __init__(self, zid: str) -> None:
        self._zid = zid
        self.heard: list[Command] = []
        self.states = Samples()

    def zid(self) -> str:
        return self._zid

    def new_timestamp(self) -> None:
        return None

    def declare_subscriber(self, key: str, queue: Any) -> Samples:
        assert key == "acsard/acsar/state"
        return self.states

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


def test_a_drive_opens_with_zeros_for_longer_than_a_first_contact_takes(
    session: Session,
) -> None:
    client = client_of(session)
    client.drive(0.5, 0.2, seconds=0.2)
    twists = [one.twist for one in session.heard]
    first = twists.index(Twist(0.5, 0.2))
    assert set(twists[:first]) == {REST}
    opened_ns = (session.heard[first].stamp_ns or 0) - (session.heard[0].stamp_ns or 0)
    assert opened_ns >= 300_000_000
    assert twists[-1] == REST
    assert session.states.undeclared


def told(waits_for: str, age: float | None = 0.01, mode: str = "ready") -> Any:
    """A state that says this of our source."""
    state = {
        "stamp": {"sec": 1, "nanosec": 0}, "mode": mode, "reason": "", "x": 0, "y": 0, "yaw": 0,
        "linear": 0, "angular": 0, "wheels": [], "link": "up", "source": "", "refused": "",
        "sources": [{"name": "app", "priority": 50, "age": age, "waits_for": waits_for}],
        "counters": {},
    }  # fmt: skip
    return Sample(msgspec.json.encode(state))


class Sample:
    """One sample as Zenoh hands it over."""

    encoding = ""
    key_expr = "acsard/acsar/state"

    def __init__(self, data: bytes) -> None:
        self.payload = self
        self._data = data

    def to_bytes(self) -> bytes:
        return self._data


NEUTRAL = "neutral first: app must send a zero"


@pytest.mark.parametrize(
    ("last", "opens"),
    [
        (told(""), True),
        (told("teleop has the higher priority: until it is silent"), True),
        (told(NEUTRAL), False),
        (told("a command", None), False),
        (told("a command", 7.0), False),
        (told(NEUTRAL, mode="stopped"), True),
        (Sample(b"{}"), False),
    ],
)
def test_a_drive_begins_when_its_zeros_count_or_never_will(
    session: Session, last: Any, opens: bool
) -> None:
    session.states = Samples(*[told(NEUTRAL)] * 45, last)
    client_of(session).drive(0.5, seconds=0.05)
    first = [one.twist for one in session.heard].index(Twist(0.5, 0.0))
    opened_s = ((session.heard[first].stamp_ns or 0) - (session.heard[0].stamp_ns or 0)) / 1e9
    assert (opened_s < 1.5) is opens


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

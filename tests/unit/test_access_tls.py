"""Tests of the certificate files, and of the error message for each TLS failure."""

from __future__ import annotations

import errno
import shutil
import socket
import ssl
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from cryptography.hazmat.primitives import serialization

from acsard.bus import tls_trouble
from acsard.bus.tls_files import (
    AUTHORITY,
    common_name,
    expiry_times,
    name_warnings,
    require_usable,
)
from acsard.bus.tls_trouble import trouble
from acsard.core.codes import joined
from acsard.core.config.settings import BusConfig, Config, RobotConfig
from acsard.core.values import NS_PER_S
from acsard.host.errors import CertificateError
from acsard.machine import authority as making
from acsard.machine.authority import Authority

DAY_NS = 86400 * NS_PER_S


def make_certificates(where: Path, days: float = 10, authority_days: int = 10) -> Path:
    Authority.make(where, "test", authority_days).issue(where, "robot", ["127.0.0.1"], days)
    return where


def test_the_common_name_is_read_and_is_empty_for_an_unusable_certificate(
    tmp_path: Path,
) -> None:
    require_usable(str(make_certificates(tmp_path)))
    assert common_name(str(tmp_path)) == "robot"
    Authority.load(tmp_path).issue(tmp_path / "anna", "laptop-anna", [], 10)
    assert common_name(str(tmp_path / "anna")) == "laptop-anna"
    (tmp_path / "certificate.pem").write_text("junk")
    assert common_name(str(tmp_path)) == common_name(str(tmp_path / "nobody")) == ""


@pytest.mark.parametrize(
    ("router", "robot_id", "is_hidden"),
    [("tls/a:1", "robot2", True), ("tls/a:1", "robot", False), ("tcp/a:1", "robot2", False)],
)
def test_a_robot_that_its_router_would_hide_is_warned_of(
    tmp_path: Path, router: str, robot_id: str, is_hidden: bool
) -> None:
    make_certificates(tmp_path)
    bus = BusConfig(connect=(router,), tls=str(tmp_path))
    texts = name_warnings(Config(robot=RobotConfig(id=robot_id), bus=bus))
    assert ['robot.id = "robot2"' in text and '"robot"' in text for text in texts] == [True] * (
        is_hidden
    )


def mixed(where: Path) -> None:
    other = where / "other"
    other.mkdir()
    make_certificates(other)
    (where / "key.pem").write_bytes((other / "key.pem").read_bytes())


def with_password(where: Path) -> None:
    file, lock = where / "key.pem", serialization.BestAvailableEncryption(b"secret")
    key = serialization.load_pem_private_key(file.read_bytes(), None)
    pem, pkcs8 = serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8
    file.write_bytes(key.private_bytes(pem, pkcs8, lock))


BROKEN: dict[str, Callable[[Path], object]] = {
    "nothing": lambda where: [path.rename(where / path.stem) for path in where.glob("*.pem")],
    "no key": lambda where: [path.rename(where / "gone") for path in where.glob("key.pem")],
    "junk": lambda where: (where / "certificate.pem").write_text("junk"),
    "junk authority": lambda where: (where / "ca.pem").write_text("junk"),
    "another's key": mixed,
    "a key with a password": with_password,
}


@pytest.mark.parametrize("how", BROKEN)
def test_unusable_files_are_a_bad_configuration(tmp_path: Path, how: str) -> None:
    BROKEN[how](make_certificates(tmp_path))
    with pytest.raises(CertificateError) as caught:
        require_usable(str(tmp_path))
    assert str(tmp_path) in str(caught.value)
    assert "acsard tls" in str(caught.value)


def test_the_ends_of_the_certificate_and_of_its_authority_are_read(tmp_path: Path) -> None:
    expiries, later = (
        expiry_times(str(make_certificates(tmp_path, 10, 100))),
        expiry_times(str(make_certificates(tmp_path, 1, 1))),
    )
    # An authority is valid for five times the days that were asked for.
    days = {whose: round((expiries[whose] - later[whose]) / DAY_NS) for whose in expiries}
    assert days == {"": 10 - 1, AUTHORITY: 5 * 100 - 5 * 1}
    assert expiry_times(str(tmp_path / "nowhere")) == {}


@pytest.mark.parametrize(
    ("error", "code", "phrase"),
    [
        (OSError(errno.EHOSTUNREACH, "No route to host"), "tls_no_route", "(No route to host)"),
        (OSError(errno.ENETUNREACH, "Network is down"), "tls_no_route", "(Network is down)"),
        (OSError(errno.ECONNREFUSED, "refused"), "tls_no_program", "on port 7449 of robot.local"),
        (TimeoutError(), "tls_no_answer", "does not answer on port 7449"),
        (socket.gaierror(socket.EAI_NONAME, "unknown"), "tls_no_name", "hostname -I"),
    ],
)
def test_an_absent_host_is_distinguished_from_a_port_without_a_program(
    error: OSError, code: str, phrase: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def connection(*_: Any) -> None:
        raise error

    monkeypatch.setattr(socket, "create_connection", connection)
    why = trouble("tls/robot.local:7449", "")
    assert why is not None
    assert why.code == code
    assert phrase in joined(why).text


@pytest.fixture(scope="module")
def tls(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Certificates that are valid, expired, for later, for other names, and a stranger's."""
    place = tmp_path_factory.mktemp("tls")
    ours = Authority.make(place / "ca", "ours", 10)
    ours.issue(place / "good", "robot", ["127.0.0.1"], 1)
    ours.issue(place / "ended", "robot", ["127.0.0.1"], -1)
    ours.issue(place / "elsewhere", "robot", ["robot.example"], 1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(making, "datetime", Later)
        ours.issue(place / "later", "robot", ["127.0.0.1"], 1)
    Authority.make(place / "other", "other", 10).issue(place / "stranger", "x", ["127.0.0.1"], 1)
    shutil.copytree(place / "stranger", place / "mixed")  # knows the robot's authority
    shutil.copy(place / "good/ca.pem", place / "mixed")
    return place


class Later(datetime):
    """The clock of a machine that is two days ahead."""

    @classmethod
    def now(cls, tz: object = None) -> datetime:  # type: ignore[override]
        return datetime.now(UTC) + timedelta(days=2)


@contextmanager
def server(own: Path) -> Iterator[str]:
    """Serve one TLS connection with these certificates, or what a file without them stands for."""

    def serve() -> None:
        link, _ = listener.accept()
        with link, suppress(OSError):
            if own.name == "closes":
                return
            if own.name == "speaks":
                link.sendall(b"hello\r\n")
            else:
                context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
                context.load_cert_chain(own / "certificate.pem", own / "key.pem")
                context.load_verify_locations(own / "ca.pem")
                context.verify_mode = ssl.CERT_REQUIRED
                link = context.wrap_socket(link, server_side=True)
            link.recv(100)

    with socket.create_server(("127.0.0.1", 0)) as listener:
        thread = threading.Thread(target=serve)
        thread.start()
        yield f"tls/127.0.0.1:{listener.getsockname()[1]}"
        thread.join()


@pytest.mark.parametrize(
    ("robot", "client", "code"),
    [
        ("good", "good", None),
        ("closes", "good", "tls_closed"),
        ("speaks", "good", "tls_not_spoken"),
        ("ended", "good", "tls_server_expired"),
        ("later", "good", "tls_server_early"),
        ("elsewhere", "good", "tls_server_other_name"),
        ("good", "stranger", "tls_server_not_signed"),
        ("good", "mixed", "tls_own_refused"),
        ("good", "ended", "tls_own_expired"),
    ],
)
def test_each_trouble_of_a_connection_has_its_code(
    tls: Path, robot: str, client: str, code: str | None
) -> None:
    with server(tls / robot) as endpoint:
        why = trouble(endpoint, str(tls / client))
    assert (why and why.code) == code


def test_any_other_fault_of_a_certificate_has_the_reason_of_openssl() -> None:
    why = tls_trouble._server_certificate_error(23, "certificate revoked", "robot", "dir")
    assert why.code == "tls_server_invalid"
    assert "the certificate of robot is not valid (certificate revoked)" in why.text


@pytest.mark.slow
def test_a_server_that_never_answers_the_handshake_is_reported(tmp_path: Path) -> None:
    Authority.make(tmp_path, "test", 1, ["localhost"]).issue(tmp_path, "robot", ["localhost"], 1)
    with socket.create_server(("127.0.0.1", 0)) as deaf:
        why = trouble(f"tls/localhost:{deaf.getsockname()[1]}", str(tmp_path))
    assert why is not None
    assert why.code == "tls_handshake_hangs"

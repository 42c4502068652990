"""Tests of the certificate files, and of the error message for each TLS failure."""

from __future__ import annotations

import errno
import os
import socket
from collections.abc import Callable
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
from acsard.core.config.settings import BusConfig, Config, RobotConfig
from acsard.core.values import NS_PER_S
from acsard.host.errors import CertificateError
from acsard.machine.authority import Authority

DAY_NS = 86400 * NS_PER_S


def make_certificates(where: Path, days: float = 10, authority_days: int = 10) -> Path:
    Authority.make(where, "test", authority_days).issue(where, "robot", ["localhost"], days)
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
    ("number", "phrase", "untold"),
    [
        (errno.EHOSTUNREACH, "robot.local cannot be reached (No route to host)", "listens"),
        (errno.ENETUNREACH, "robot.local cannot be reached (Network is unreachable)", "listens"),
        (errno.ECONNREFUSED, "no program listens on port 7449 of robot.local", "not there"),
    ],
)
def test_an_absent_host_is_distinguished_from_a_port_without_a_program(
    number: int, phrase: str, untold: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def connection(*_: Any) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(socket, "create_connection", connection)
    message = trouble("tls/robot.local:7449", "")
    assert phrase in message
    assert untold not in message


@pytest.mark.parametrize(
    ("code", "reason", "phrase"),
    [
        (20, "unable to get local issuer certificate", "dir/ca.pem did not sign the certificate"),
        (23, "certificate revoked", "the certificate of robot is not valid"),
    ],
)
def test_a_rejected_server_certificate_has_the_reason_of_openssl(
    code: int, reason: str, phrase: str
) -> None:
    message = tls_trouble._server_certificate_error(code, reason, "robot", "dir")
    assert message.startswith(("the authority in ", "the certificate of robot"))
    assert phrase in message
    assert f"({reason})" in message
    assert ("did not sign" in message) is (code == 20)


@pytest.mark.slow
def test_a_server_that_never_answers_the_handshake_is_reported(tmp_path: Path) -> None:
    Authority.make(tmp_path, "test", 1, ["localhost"]).issue(tmp_path, "robot", ["localhost"], 1)
    with socket.create_server(("127.0.0.1", 0)) as deaf:
        message = trouble(f"tls/localhost:{deaf.getsockname()[1]}", str(tmp_path))
    assert "does not answer the TLS handshake" in message

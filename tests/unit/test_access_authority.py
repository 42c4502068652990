"""An authority's certificates are valid for the robot's names and private addresses only.

OpenSSL checks this in the tests.
"""

from __future__ import annotations

import errno
import ssl
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec

from acsard.host import atomic_file
from acsard.host.errors import MendableError
from acsard.machine import authority as making
from acsard.machine.authority import Authority
from tests.each import each

OWN = ["robot1", "robot.example", "203.0.113.9", "2001:db8:1:2::9"]

PERMITTED = [
    *OWN, "robot9.local", "localhost", "arm.robot.example", "192.168.1.7", "10.9.8.7", "172.16.0.1",
    "100.64.0.1", "127.0.0.1", "169.254.1.1", "fd00::1", "fe80::1", "::1", "2001:db8:1:2::1",
]  # fmt: skip

BARRED = [
    "bank.example", "example", "robot2", "robot1.example", "notrobot.example", "203.0.113.10",
    "8.8.8.8", "2001:db8:1:3::1",
]  # fmt: skip


@pytest.fixture(scope="module")
def authority(tmp_path_factory: pytest.TempPathFactory) -> tuple[Authority, Path]:
    where = tmp_path_factory.mktemp("authority")
    return Authority.make(where, "test", 1, OWN), where


def connects(where: Path, server: Path, name: str, client: Path) -> bool:
    """Return whether a TLS connection in memory succeeds. Each side checks the other one."""
    there, here = ssl.MemoryBIO(), ssl.MemoryBIO()
    serving = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    serving.verify_mode = ssl.CERT_REQUIRED
    asking = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    for context, own in ((serving, server), (asking, client)):
        context.load_verify_locations(where / "ca.pem")
        context.load_cert_chain(own / "certificate.pem", own / "key.pem")
    client_tls = asking.wrap_bio(there, here, server_hostname=name)
    other = serving.wrap_bio(here, there, server_side=True)
    try:
        for side in (client_tls, other, client_tls, other):
            with suppress(ssl.SSLWantReadError):
                side.do_handshake()
    except ssl.SSLCertVerificationError:
        return False
    return True


@pytest.mark.slow
@each("name", [*PERMITTED, *BARRED])
def test_a_certificate_is_valid_for_a_permitted_name_only(
    authority: tuple[Authority, Path], name: str, tmp_path: Path
) -> None:
    ours, where = authority
    ours.issue(tmp_path / name, "robot", [name], 1)
    ours.issue(tmp_path / "client", "operator", [], 1)
    assert ours.permits(name) == (name in PERMITTED)
    assert connects(where, tmp_path / name, name, tmp_path / "client") == (name in PERMITTED)


def test_the_constraints_are_critical(authority: tuple[Authority, Path]) -> None:
    certificate = x509.load_pem_x509_certificate((authority[1] / "ca.pem").read_bytes())
    extension = certificate.extensions.get_extension_for_class(x509.NameConstraints)
    assert extension.critical


def test_an_authority_of_another_program_without_constraints_may_sign_for_any_name(
    authority: tuple[Authority, Path], tmp_path: Path
) -> None:
    authority[0].issue(tmp_path, "unlimited", [], 1)
    certificate = x509.load_pem_x509_certificate((tmp_path / "certificate.pem").read_bytes())
    key = ec.generate_private_key(ec.SECP256R1())
    assert Authority(certificate, key).permits("bank.example")


def test_a_disk_that_refuses_a_file_leaves_the_earlier_key_and_certificate(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mine = Authority.make(tmp_path / "ca", "test", 1, OWN)
    mine.issue(tmp_path / "robot", "robot", ["robot1"], 1)
    before = {path: path.read_bytes() for path in (tmp_path / "robot").iterdir()}
    written, write = [], atomic_file.replace

    def full(path: Path, *words: object, **options: Any) -> None:
        written.append(path)
        if len(written) == 3:
            raise OSError(errno.ENOSPC, "No space left on device")
        write(path, *words, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(making, "replace", full)
    with pytest.raises(MendableError, match=r"cannot write .*: No space left on device"):
        mine.issue(tmp_path / "robot", "robot", ["robot1"], 1)
    assert {path: path.read_bytes() for path in (tmp_path / "robot").iterdir()} == before


@pytest.mark.parametrize("blocked", ["certificate.pem", "key.pem"])
def test_a_file_that_cannot_be_replaced_leaves_the_pair_that_belongs_together(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, blocked: str
) -> None:
    mine, own = Authority.make(tmp_path / "ca", "test", 1, OWN), tmp_path / "robot"
    mine.issue(own, "robot", ["robot1"], 1)
    before = {path: path.read_bytes() for path in own.iterdir()}
    modes = {path: path.stat().st_mode for path in own.iterdir()}
    rename = Path.replace

    def immutable(path: Path, target: Path) -> Path:
        if target.name == blocked and path.name.endswith(".new"):
            raise OSError(errno.EROFS, "Read-only file system")
        return rename(path, target)

    monkeypatch.setattr(Path, "replace", immutable)
    with pytest.raises(MendableError, match=r"cannot write .*: Read-only file system"):
        mine.issue(own, "robot", ["robot1"], 1)
    assert {path: path.read_bytes() for path in own.iterdir()} == before
    assert {path: path.stat().st_mode for path in own.iterdir()} == modes


def test_a_directory_in_the_place_of_a_file_leaves_no_half_of_a_pair(tmp_path: Path) -> None:
    mine, own = Authority.make(tmp_path / "ca", "test", 1, OWN), tmp_path / "robot"
    (own / "key.pem").mkdir(parents=True)
    with pytest.raises(MendableError, match=r"cannot write .*key.pem"):
        mine.issue(own, "robot", ["robot1"], 1)
    assert [path.name for path in own.iterdir()] == ["key.pem"]


def test_an_authority_without_an_identifier_of_its_key_can_sign(tmp_path: Path) -> None:
    key, now = ec.generate_private_key(ec.SECP256R1()), datetime.now(UTC)
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "other")])
    certificate = (
        x509.CertificateBuilder(name, name, key.public_key(), 1, now, now + timedelta(days=1))
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .sign(key, hashes.SHA256())
    )
    Authority(certificate, key).issue(tmp_path, "robot", ["robot1"], 1)
    assert (tmp_path / "certificate.pem").is_file()

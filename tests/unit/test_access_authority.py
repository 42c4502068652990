"""An authority's certificates are valid for the robot's names and private addresses only.

OpenSSL checks this in the tests.
"""

from __future__ import annotations

import errno
import os
import ssl
import tempfile
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec, ed25519

from acsard.host.errors import MendableError, NotPermittedError
from acsard.machine import authority as making
from acsard.machine.authority import Authority
from acsard.machine.certificates import CA_KEY, add, renew, renew_client
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


def test_a_certificate_of_an_authority_without_an_identifier_names_its_key(tmp_path: Path) -> None:
    key, name = ec.generate_private_key(ec.SECP256R1()), x509.Name([])
    now = datetime.now(UTC)
    builder = x509.CertificateBuilder(name, name, key.public_key(), 1, now, now + timedelta(days=1))
    Authority(builder.sign(key, hashes.SHA256()), key).issue(tmp_path, "robot", [], 1)
    issued = x509.load_pem_x509_certificate((tmp_path / "certificate.pem").read_bytes())
    found = issued.extensions.get_extension_for_class(x509.AuthorityKeyIdentifier).value
    assert found == x509.AuthorityKeyIdentifier.from_issuer_public_key(key.public_key())


@each(
    ("name", "names"),
    [
        ("robot4", ["robot4.local"]),
        ("robot1", ["robot1", "robot1.local"]),  # one of the authority's own names
        ("a.person", ["a.person.local"]),
        ("arm.local", ["arm.local"]),
        ("192.168.1.7", ["192.168.1.7.local", "192.168.1.7"]),
        ("8.8.8.8", ["8.8.8.8.local"]),
        ("anna+ben", []),
    ],
)
def test_a_client_has_the_host_names_that_its_name_can_be_and_the_authority_permits(
    name: str, names: list[str]
) -> None:
    with tempfile.TemporaryDirectory() as where:
        authority = Authority.make(Path(where), "test", 1, OWN)
        assert authority.names_in(add(Path(where), name, [], 1)) == names


def test_a_long_host_name_is_cut_to_the_64_characters_of_a_common_name(tmp_path: Path) -> None:
    Authority.make(tmp_path, "acsard at " + "x" * 60, 1)
    made = x509.load_pem_x509_certificate((tmp_path / "ca.pem").read_bytes())
    assert made.subject.rfc4514_string() == "CN=acsard at " + "x" * 54


def test_an_authority_whose_key_is_of_another_kind_is_refused(tmp_path: Path) -> None:
    Authority.make(tmp_path, "test", 1)
    other = ed25519.Ed25519PrivateKey.generate()
    (tmp_path / CA_KEY).write_bytes(
        other.private_bytes(
            serialization.Encoding.PEM,
            serialization.PrivateFormat.PKCS8,
            serialization.NoEncryption(),
        )
    )
    with pytest.raises(ValueError, match=r"ca-key\.pem is not a P-256 key"):
        Authority.load(tmp_path)


@pytest.mark.skipif(os.geteuid() != 0, reason="needs root, to become a user without permission")
def test_a_directory_that_refuses_a_file_is_named_with_the_remedy() -> None:
    with tempfile.TemporaryDirectory() as where:
        os.chmod(where, 0o755)
        os.seteuid(65534)
        try:
            with pytest.raises(NotPermittedError, match=r"cannot write .*: Permission denied; "):
                Authority.make(Path(where), "test", 1)
        finally:
            os.seteuid(0)


def test_a_full_disk_is_no_question_of_permission(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(making, "replace", full)
    with pytest.raises(MendableError, match=r"ca-key\.pem: No space left on device; ") as error:
        Authority.make(tmp_path, "test", 1)
    assert not isinstance(error.value, NotPermittedError)


@pytest.mark.skipif(os.geteuid() != 0, reason="needs root, to become a user without permission")
@each("work", [add, renew_client, lambda where, *more: renew(where, *more[1:])])
def test_another_user_may_not_sign_even_if_the_key_can_be_read(work: Callable[..., object]) -> None:
    with tempfile.TemporaryDirectory() as where:
        Authority.make(Path(where), "test", 1)
        for path in (Path(where), Path(where) / CA_KEY):
            path.chmod(0o755)
        os.setresuid(65534, 65534, 0)
        try:
            with pytest.raises(NotPermittedError, match="run this command with sudo"):
                work(Path(where), "anna", [], 1)
        finally:
            os.setresuid(0, 0, 0)

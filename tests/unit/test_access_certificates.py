"""Tests of `acsard tls`: the certificates it makes, their file permissions, and its output."""

from __future__ import annotations

import os
import shutil
import stat
import subprocess
import sys
import tomllib
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import (
    load_pem_private_key,
)
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID
from msgspec.structs import replace

from acsard.cli import main
from acsard.core.config.parsing import parse
from acsard.core.config.settings import Config
from acsard.host.own_identity import own_addresses
from acsard.machine.certificates import port
from tests.each import each

ROLES = ("viewer", "operator", "maintainer")


def tls(*words: str) -> int:
    """Run `acsard tls` and return its exit code."""
    try:
        return main(["tls", *words])
    except SystemExit as end:  # the parser exits this way
        return int(end.code or 0)


def certificate(directory: Path, name: str = "certificate.pem") -> x509.Certificate:
    return x509.load_pem_x509_certificate((directory / name).read_bytes())


def common_name(name: x509.Name) -> str:
    (attribute,) = name.get_attributes_for_oid(NameOID.COMMON_NAME)
    return str(attribute.value)


def files(directory: Path) -> dict[str, bytes]:
    """Return the content of every file below this directory, by relative path."""
    paths = (path for path in directory.rglob("*") if path.is_file())
    return {str(path.relative_to(directory)): path.read_bytes() for path in paths}


def tables(printed: str) -> bytes:
    """Return the printed lines that belong into acsard.toml."""
    lines = printed.splitlines()
    keep, inside = [], False
    for line in lines:
        inside = line.startswith("[") or (inside and " = " in line)
        keep += [line] if inside else []
    return "\n".join(keep).encode()


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the directory that `tls init` makes. Tests must not change it."""
    directory = tmp_path_factory.mktemp("certificates") / "tls"
    address = ("--address", "192.0.2.7", "--address", "robot.example", "--address", "2001:db8::7")
    assert tls("init", "--directory", str(directory), *address, "--days", "30") == 0
    return directory


@pytest.fixture(name="own")
def _own(made: Path, tmp_path: Path) -> Path:
    """Return a copy of the directory of `made` that a test may change."""
    return Path(shutil.copytree(made, tmp_path / "tls"))


PLACES = {".": "robot", **{f"clients/{role}": role for role in ROLES}}
"""The directories that `tls init` makes, and the common name of the certificate in each."""


def names_of(directory: Path) -> set[str]:
    extensions = certificate(directory).extensions
    names = extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    addresses = names.get_values_for_type(x509.IPAddress)
    return {*names.get_values_for_type(x509.DNSName), *map(str, addresses)}


def test_init_makes_an_authority_and_a_certificate_for_the_robot_and_each_role(made: Path) -> None:
    three = ("ca.pem", "certificate.pem", "key.pem")
    assert set(files(made)) == {
        *three, "ca-key.pem", *(f"clients/{role}/{name}" for role in ROLES for name in three)
    }  # fmt: skip
    # Only the owner may read a key, and every user a certificate.
    modes = {name: stat.S_IMODE((made / name).stat().st_mode) for name in files(made)}
    assert modes == {name: 0o600 if "key" in name else 0o644 for name in modes}
    host = os.uname().nodename
    names = {host, f"{host}.local", "localhost", "robot.example", "127.0.0.1", "192.0.2.7"}
    assert names | {"2001:db8::7", *own_addresses()} <= names_of(made)


def test_a_file_in_the_place_of_the_directory_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "tls").touch()
    for below in ("tls", "tls/robot"):
        assert tls("init", "--directory", str(tmp_path / below)) == 1
        assert f"{tmp_path / 'tls'} is not a directory; name a" in capsys.readouterr().err
    (tmp_path / "link").symlink_to("missing")
    assert tls("init", "--directory", str(tmp_path / "link" / "robot")) == 1
    assert f"{tmp_path / 'link'} is not a directory; name a" in capsys.readouterr().err


@each(
    ("listen", "expected"),
    [
        ((), "7449"),
        (("tcp/127.0.0.1:7448",), "7449"),
        (("tcp/127.0.0.1:7448", "tls/[::]:7999", "tls/0.0.0.0:8000"), "7999"),
    ],
)
def test_a_client_connects_to_the_first_port_with_tls(
    listen: tuple[str, ...], expected: str
) -> None:
    config = Config()
    assert port(replace(config, bus=replace(config.bus, listen=listen))) == expected


def test_the_authority_signs_certificates_and_nothing_below_it_does(made: Path) -> None:
    authority = certificate(made, "ca.pem")
    authority.verify_directly_issued_by(authority)
    basic = authority.extensions.get_extension_for_class(x509.BasicConstraints)
    assert (basic.critical, basic.value.ca, basic.value.path_length) == (True, True, 0)
    usage = authority.extensions.get_extension_for_class(x509.KeyUsage)
    assert (usage.critical, usage.value.key_cert_sign) == (True, True)
    assert not usage.value.digital_signature
    now, both = (
        datetime.now(UTC),
        {ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH},
    )
    for place, name in PLACES.items():
        issued, extensions = certificate(made / place), certificate(made / place).extensions
        issued.verify_directly_issued_by(authority)
        assert certificate(made / place, "ca.pem") == authority
        assert common_name(issued.subject) == name
        basic = extensions.get_extension_for_class(x509.BasicConstraints)
        assert (basic.critical, basic.value.ca) == (True, False)
        own = extensions.get_extension_for_class(x509.KeyUsage)
        assert (own.value.key_cert_sign, own.value.digital_signature) == (False, True)
        assert own.critical
        # It serves at both ends of a link, from a little before now for the days asked.
        assert set(extensions.get_extension_for_class(x509.ExtendedKeyUsage).value) == both
        assert now - timedelta(hours=2) < issued.not_valid_before_utc < now
        assert abs(issued.not_valid_after_utc - now - timedelta(days=30)) < timedelta(minutes=10)
        assert authority.not_valid_after_utc > issued.not_valid_after_utc
        key = load_pem_private_key((made / place / "key.pem").read_bytes(), None)
        assert isinstance(key, ec.EllipticCurvePrivateKey)
        assert (key.curve.name, key.public_key()) == ("secp256r1", issued.public_key())
    numbers = {certificate(made / place).serial_number for place in PLACES}
    assert len(numbers | {authority.serial_number}) == len(PLACES) + 1


# no other user can read a key at any time


WATCHED = """\
import os, sys
from acsard.cli import main
def hook(event, arguments):
    if event == "os.chmod" and isinstance(arguments[0], int):
        file = os.path.basename(os.readlink(f"/proc/self/fd/{arguments[0]}"))
        before = os.fstat(arguments[0]).st_mode & 0o777
        print(file.split(".pem")[0], oct(before), oct(arguments[1]), file=sys.stderr)
sys.addaudithook(hook)
os.umask(0)
sys.exit(main(["tls", *sys.argv[1:]]))
"""
"""A program without umask that reports every change of a new file's mode, before and after."""


@pytest.mark.slow
def test_a_key_is_never_readable_by_others_not_even_while_it_is_written(own: Path) -> None:
    key = own / "key.pem"
    key.chmod(0o666)
    words = ["init", "--force", "--directory", str(own)]
    done = subprocess.run(
        [sys.executable, "-c", WATCHED, *words], capture_output=True, text=True, timeout=30.0
    )
    changes = [line.split() for line in done.stderr.splitlines()]
    assert (done.returncode, len(changes)) == (0, 14)  # two files of the authority, three of each
    for name, before, after in changes:
        assert before == "0o600"
        assert after == ("0o600" if "key" in name else "0o644")
    for name in files(own):
        if "key" in name:
            assert stat.S_IMODE((own / name).stat().st_mode) == 0o600, name


# files that already exist


def test_init_with_force_makes_a_new_authority_and_prints_what_lets_the_roles_in(
    own: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    old, elsewhere = certificate(own / "clients/operator"), tmp_path / "elsewhere"
    # A key is not written through a symbolic link.
    elsewhere.write_text("untouched")
    (own / "key.pem").unlink()
    (own / "key.pem").symlink_to(elsewhere)
    assert tls("init", "--force", "--directory", str(own)) == 0
    assert elsewhere.read_text() == "untouched"
    assert not (own / "key.pem").is_symlink()
    authority = certificate(own, "ca.pem")
    with pytest.raises(InvalidSignature):
        old.verify_directly_issued_by(authority)
    certificate(own / "clients/operator").verify_directly_issued_by(authority)
    config = parse(tables(capsys.readouterr().out))
    assert (config.bus.tls, config.bus.insecure) == (str(own), False)
    assert [endpoint.partition("/")[0] for endpoint in config.bus.listen] == ["tcp", "tls"]
    assert (config.access.viewers, config.access.operators) == (("viewer",), ("operator",))
    assert config.access.maintainers == ("maintainer",)


@pytest.mark.parametrize(
    ("name", "role"),
    [*(("anna", role) for role in ROLES), ("anna+ben: the_old.one@home", "viewer")],
)
def test_add_issues_one_certificate_and_prints_the_lines_that_give_it_its_role(
    own: Path, capsys: pytest.CaptureFixture[str], role: str, name: str
) -> None:
    before = files(own)
    assert tls("add", name, "--role", role, "--directory", str(own), "--days", "7") == 0
    after = files(own)
    assert {path: after[path] for path in before} == before
    new = own / "clients" / name
    assert {path.name for path in new.iterdir()} == {"ca.pem", "certificate.pem", "key.pem"}
    assert stat.S_IMODE((new / "key.pem").stat().st_mode) == 0o600
    issued = certificate(new)
    assert common_name(issued.subject) == name
    issued.verify_directly_issued_by(certificate(own, "ca.pem"))
    left = issued.not_valid_after_utc - datetime.now(UTC)
    assert abs(left - timedelta(days=7)) < timedelta(minutes=10)
    printed = tables(capsys.readouterr().out)
    assert set(tomllib.loads(printed.decode())) == {"access"}
    access = parse(printed).access
    listed = {"viewer": access.viewers, "operator": access.operators}
    listed |= {"maintainer": access.maintainers}
    assert listed == {r: (r, name) if r == role else (r,) for r in ROLES}


@pytest.mark.parametrize("name", ["", "robot4"])
def test_renew_replaces_that_certificate_alone_and_keeps_its_names(own: Path, name: str) -> None:
    there = ("--directory", str(own))
    assert tls("add", "robot4", *there, "--address", "10.0.0.4", "--days", "5") == 0
    place, which = (own / "clients" / name, f"clients/{name}/") if name else (own, "")
    before, old, names = files(own), certificate(place), names_of(place)
    words = ("--name", name) if name else ()
    assert tls("renew", *words, *there, "--days", "40", "--address", "10.0.0.9") == 0
    after = files(own)
    changed = {file for file in after if after[file] != before[file]}
    assert changed == {f"{which}certificate.pem", f"{which}key.pem"}
    assert common_name(certificate(place).subject) == (name or "robot")
    assert certificate(place).not_valid_after_utc > old.not_valid_after_utc
    kept = {"robot4.local", "10.0.0.4"} if name else {"localhost", "robot.example", "192.0.2.7"}
    assert names_of(place) == {*names, "10.0.0.9"} > kept

"""The doctor names the certificate that expires. Its advice works exactly as printed."""

from __future__ import annotations

import os
import re
import shlex
import shutil
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from cryptography.hazmat.primitives.asymmetric import ec

from acsard.bus import certificate_watch
from acsard.bus.tls_files import expiry_times, require_usable
from acsard.cli import main
from acsard.core.config.settings import BusConfig, Config
from acsard.core.values import NS_PER_S
from acsard.host import clock
from acsard.host.errors import NotPermittedError
from acsard.machine.authority import Authority
from acsard.machine.certificate_findings import certificates, router_certificates
from acsard.machine.finding import Finding
from tests.each import each

DAY_NS = 86400 * NS_PER_S

NOBODY = 65534

PEM = ("ca.pem", "certificate.pem", "key.pem")


@pytest.fixture
def fleet(tmp_path: Path) -> Path:
    """Return an authority's directory with a certificate for robot4."""
    directory = tmp_path / "fleet"
    assert main(["tls", "init", "--directory", str(directory)]) == 0
    assert main(["tls", "add", "robot4", "--directory", str(directory)]) == 0
    return directory


def finding(directory: Path) -> Finding:
    (result,) = certificates(str(directory))
    return result


def days_left(directory: Path) -> int:
    return round((expiry_times(str(directory))[""] - clock.now().wall_ns) / DAY_NS)


def typed(mend: str, where: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run the `acsard` command that an advice contains, in this directory."""
    (command,) = re.findall(r"`acsard ([^`]+)`", mend)
    monkeypatch.chdir(where)
    assert main(shlex.split(command)) == 0


def test_the_advised_command_replaces_a_key_that_only_zenoh_refuses(
    fleet: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        # OpenSSL accepts a key of this curve, and Zenoh does not.
        patch.setattr(ec, "SECP256R1", ec.SECP521R1)
        Authority.load(fleet).issue(fleet, "robot", ["localhost"], 100)
    result = finding(fleet)
    assert result.level == "failure"
    assert f"the key {fleet}/key.pem (failed to parse private key" in result.text
    typed(result.mend, fleet, monkeypatch)
    assert finding(fleet).level == "ok"


@pytest.mark.parametrize("days", [9.9, -3.0])
def test_the_advised_commands_renew_the_certificate_of_a_robot_of_a_fleet(
    fleet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, days: float
) -> None:
    """The authority's key is not on robot4.

    The operator renews the certificate on another computer.
    """
    Authority.load(fleet).issue(fleet / "clients" / "robot4", "robot4", ["10.0.0.4"], days)
    there = tmp_path / "etc tls"
    shutil.copytree(fleet / "clients" / "robot4", there)
    result = finding(there)
    assert result.level == ("warning" if days > 0 else "failure")
    typed(result.mend, fleet, monkeypatch)
    assert result.mend.endswith(f"; then copy clients/robot4/*.pem from there to {there}")
    for name in PEM:
        shutil.copy(fleet / "clients" / "robot4" / name, there)
    require_usable(str(there))
    assert (finding(there).level, days_left(there)) == ("ok", 730)


def test_the_advice_about_an_authority_makes_a_new_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    directory = tmp_path / "fleet"
    Authority.make(directory, "fleet", 2).issue(directory, "robot", [], 700)
    result = finding(directory)
    assert result.text == f"{directory}: expires in 10 days (certificate of the authority)"
    typed(result.mend, directory, monkeypatch)
    assert finding(directory).level == "ok"


def test_the_advised_command_makes_the_first_certificate_of_an_empty_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    directory = tmp_path / "tls"
    findings = [*certificates(str(directory))]
    assert {item.level for item in findings} == {"failure"}
    first, *_ = re.findall(r"`(acsard tls init [^`]+)`", findings[0].mend)
    typed(f"`{first}`", tmp_path, monkeypatch)
    assert finding(directory).level == "ok"


@pytest.fixture
def other_user() -> Iterator[None]:
    """Run the test as a user who is not root, if root runs the tests."""
    root = os.geteuid() == 0
    if root:
        os.seteuid(NOBODY)
    yield
    if root:
        os.seteuid(0)


@pytest.mark.parametrize("mode", [0o600, 0o311], ids=["may not enter", "may not list"])
def test_for_a_directory_that_this_user_may_not_look_into_sudo_is_advised(
    other_user: None, mode: int
) -> None:
    with TemporaryDirectory() as place:
        directory = Path(place) / "tls"
        directory.mkdir(mode=mode)
        try:
            (result, *_) = certificates(str(directory))
            assert "sudo" in result.mend
            Path(place).chmod(0o600)
            with pytest.raises(NotPermittedError, match="sudo"):
                require_usable(str(directory))
        finally:
            Path(place).chmod(0o700)
            directory.chmod(0o700)


@each(("mode", "open_key"), [(0o600, False), (0o400, False), (0o640, True), (0o604, True)])
def test_a_key_that_the_group_or_others_may_read_is_named(mode: int, open_key: bool) -> None:
    with TemporaryDirectory() as place:
        Authority.make(Path(place), "test", 30).issue(Path(place), "robot", ["localhost"], 90)
        (Path(place) / "key.pem").chmod(mode)
        found = [one.code for one in certificates(place)]
    assert ("certificates_open_key" in found) is open_key
    assert found[-1] == "certificate_valid"


def test_without_certificates_there_is_nothing_to_find() -> None:
    assert list(certificates("")) == []


def expiring(fleet: Path) -> None:
    Authority.load(fleet).issue(fleet, "robot", ["localhost"], 9.9)
    (fleet / "ca-key.pem").unlink()


def other_authority(fleet: Path) -> None:
    Authority.make(fleet / "other", "other", 30, ["localhost"])
    (fleet / "ca.pem").write_bytes((fleet / "other" / "ca.pem").read_bytes())


def pipe(fleet: Path) -> None:
    (fleet / "key.pem").unlink()
    os.mkfifo(fleet / "key.pem")


SPOILED: dict[str, Callable[[Path], object]] = {
    "sound certificates": lambda fleet: None,
    "they expire soon, and the authority's key is elsewhere": expiring,
    "users other than the owner can read the key": lambda fleet: (fleet / "key.pem").chmod(0o644),
    "the certificate of another authority": other_authority,
    "a key that is no file": pipe,
    "no key beside the authority's": lambda fleet: (fleet / "key.pem").unlink(),
    "a robot of a fleet without its key": lambda fleet: (fleet / "clients/robot4/key.pem").unlink(),
    "no directory": shutil.rmtree,
}


def test_each_finding_about_certificates_has_the_approved_words(
    fleet: Path, monkeypatch: pytest.MonkeyPatch, approved: Callable[[Path, str], None]
) -> None:
    lines = list[str]()

    def add(what: str, findings: Iterable[Finding]) -> None:
        lines.append(f"--- {what}")
        for one in findings:
            lines.append(f"{one.level}: {one.subject}: {one.text}")
            lines.extend([f"    -> {one.mend}"] if one.mend else [])

    for what, spoil in SPOILED.items():
        place = fleet.parent / "tls"
        shutil.copytree(fleet, place)
        spoil(place)
        own = "robot4" in what or "fleet" in what
        add(what, certificates(str(place / "clients/robot4" if own else place)))
        shutil.rmtree(place, ignore_errors=True)
    ends_ns = {"tls/router.local:7447": clock.now().wall_ns + 9 * DAY_NS, "tls/away:7447": None}
    monkeypatch.setattr(certificate_watch, "peer_ends_ns", lambda endpoint, tls: ends_ns[endpoint])
    bus = BusConfig(mode="client", connect=("tcp/127.0.0.1:1", *ends_ns), tls=str(fleet))
    add("the certificate of a router expires soon", router_certificates(Config(bus=bus)))
    text = "\n".join(lines).replace(str(fleet.parent), "HERE") + "\n"
    approved(Path(__file__).with_name("words") / "doctor_certificates.txt", text)

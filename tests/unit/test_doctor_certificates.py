"""The doctor names the certificate that expires. Its advice works exactly as printed."""

from __future__ import annotations

import os
import re
import shlex
import shutil
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from cryptography.hazmat.primitives.asymmetric import ec

from acsard.bus import certificate_watch
from acsard.bus.tls import AUTHORITY, expiry_times, require_usable
from acsard.cli import main
from acsard.core.config.settings import BusConfig, Config
from acsard.core.values import NS_PER_S
from acsard.host import clock
from acsard.host.errors import NotPermittedError
from acsard.machine.authority import Authority
from acsard.machine.certificate_findings import certificates, renewal, router_certificates
from acsard.machine.finding import Finding

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


def test_sound_certificates_need_no_advice(fleet: Path) -> None:
    expected = Finding("certificates", "ok", f"{fleet}: valid for 730 days")
    assert finding(fleet) == expected


def test_the_advised_command_renews_the_robots_own_certificate(
    fleet: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Authority.load(fleet, str).issue(fleet, "robot", ["localhost"], 9.9)
    result = finding(fleet)
    assert (result.level, result.text) == ("warning", f"{fleet}: expires in 10 days")
    typed(result.mend, fleet, monkeypatch)
    assert finding(fleet).level == "ok"


def test_the_advised_command_replaces_a_key_that_only_zenoh_refuses(
    fleet: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        # OpenSSL accepts a key of this curve, and Zenoh does not.
        patch.setattr(ec, "SECP256R1", ec.SECP521R1)
        Authority.load(fleet, str).issue(fleet, "robot", ["localhost"], 100)
    result = finding(fleet)
    assert result.level == "failure"
    assert f"the key {fleet}/key.pem (failed to parse private key" in result.text
    typed(result.mend, fleet, monkeypatch)
    assert finding(fleet).level == "ok"


def test_without_the_authoritys_key_the_advice_asks_for_it(fleet: Path) -> None:
    Authority.load(fleet, str).issue(fleet, "robot", ["localhost"], 9.9)
    (fleet / "ca-key.pem").unlink()
    assert finding(fleet).mend.endswith(", after you have copied ca-key.pem into that directory")


@pytest.mark.parametrize("days", [9.9, -3.0])
def test_the_advised_commands_renew_the_certificate_of_a_robot_of_a_fleet(
    fleet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, days: float
) -> None:
    """The authority's key is not on robot4.

    The operator renews the certificate on another computer.
    """
    Authority.load(fleet, str).issue(fleet / "clients" / "robot4", "robot4", ["10.0.0.4"], days)
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


def test_the_advice_about_a_router_names_its_certificate(fleet: Path) -> None:
    advice = renewal(str(fleet / "clients" / "robot4"), "the router tls/router.local:7447")
    assert "`acsard tls renew --name router.local --directory .`" in advice
    assert advice.endswith("then copy clients/router.local/*.pem from there to the router")
    assert "init --force" in renewal(str(fleet), AUTHORITY)


def test_an_expiring_certificate_of_a_router_is_a_finding(
    fleet: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    end_ns = clock.now().wall_ns + 9 * DAY_NS
    ends_ns = {"tls/router.local:7447": end_ns, "tls/away.local:7447": None}
    monkeypatch.setattr(certificate_watch, "peer_ends_ns", lambda endpoint, tls: ends_ns[endpoint])
    bus = BusConfig(
        mode="client", connect=("tcp/127.0.0.1:7447", *ends_ns), tls=str(fleet / "clients/robot4")
    )
    (result,) = router_certificates(Config(bus=bus))
    assert (result.subject, result.level) == ("router", "warning")
    assert result.text == "expires in 9 days (certificate of the router tls/router.local:7447)"
    assert "--name router.local" in result.mend


def test_the_advised_command_makes_the_first_certificate_of_an_empty_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    directory = tmp_path / "tls"
    findings = [*certificates(str(directory))]
    assert {item.level for item in findings} == {"failure"}
    first, *_ = re.findall(r"`(acsard tls init [^`]+)`", findings[0].mend)
    typed(f"`{first}`", tmp_path, monkeypatch)
    assert finding(directory).level == "ok"


def test_the_advised_command_replaces_a_missing_key_beside_the_authoritys_key(
    fleet: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (fleet / "key.pem").unlink()
    typed(next(iter(certificates(str(fleet)))).mend, fleet, monkeypatch)
    assert finding(fleet).level == "ok"


def test_for_a_missing_key_of_a_fleet_robot_no_new_authority_is_advised(fleet: Path) -> None:
    own = fleet / "clients" / "robot4"
    (own / "key.pem").unlink()
    for result in certificates(str(own)):
        assert "tls init" not in result.mend
        assert (
            "copy ca.pem, certificate.pem and key.pem from there into this directory" in result.mend
        )


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_for_a_directory_of_root_sudo_with_the_program_path_is_advised(fleet: Path) -> None:
    Authority.load(fleet, str).issue(fleet, "robot", ["localhost"], 9.9)
    fleet.chmod(0o555)
    # Outside an activated environment the command names the Python.
    program = r"/\S+(acsard| -m acsard)"
    assert re.match(rf"run `sudo {program} tls renew --directory ", finding(fleet).mend)


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


def test_for_a_key_that_other_users_can_read_chmod_is_advised(fleet: Path) -> None:
    (fleet / "key.pem").chmod(0o644)
    (result, _) = certificates(str(fleet))
    assert result.mend == f"chmod 600 {fleet}/key.pem"


def test_the_certificate_of_another_authority_is_reported(fleet: Path, tmp_path: Path) -> None:
    Authority.make(tmp_path / "other", "other", 30, ["localhost"])
    (fleet / "ca.pem").write_bytes((tmp_path / "other" / "ca.pem").read_bytes())
    result = finding(fleet)
    assert (result.level, "has not signed" in result.text) == ("warning", True)


def test_a_key_that_is_not_a_file_is_not_read(fleet: Path) -> None:
    (fleet / "key.pem").unlink()
    os.mkfifo(fleet / "key.pem")
    assert "is not a file" in finding(fleet).text

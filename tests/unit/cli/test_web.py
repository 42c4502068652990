"""Tests of `acsard web`: its errors when no browser could connect, and its tokens."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from acsard.cli import main
from acsard.host.errors import Exit
from acsard.machine.authority import Authority
from acsard.web.callers import LOCAL_NAME
from tests.each import each


def test_an_invitation_without_a_reachable_address_names_the_file_that_was_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("acsard.toml").touch()  # as in a clone of the repository; the service uses another file
    assert main(["web", "--invite", "viewer"]) == 2
    output = capsys.readouterr().err
    assert "acsard.toml" in output
    assert "--config" in output


@pytest.fixture
def told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> Callable[..., str]:
    """Return a function that runs `acsard web` with exit code 0 and returns its output.

    It uses a temporary certificate and state directory.
    """
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path / "state"))
    Authority.make(Path("tls"), "test", 1).issue(Path("tls"), "robot", ["localhost"], 1)
    where = ["--tls", "tls", "--address", "https://127.0.0.1:8443"]

    def called(*words: str, robot: str = "robot1") -> str:
        capsys.readouterr()
        assert main(["web", *where, "--id", robot, *words]) == 0
        return capsys.readouterr().out

    return called


def test_a_visitor_is_invited_for_an_hour_which_the_link_and_the_list_say(
    told: Callable[..., str],
) -> None:
    assert ", for 1 h; the link" in told("--invite", "viewer", "--hours", "1")
    assert ", for 30 d; the link" in told("--invite", "operator")
    rows = told("--tokens").splitlines()
    assert [row.rpartition(", ")[2] for row in rows] == ["1 h left", "30 d left"]


def test_the_option_tls_gives_the_certificate_of_an_https_address_in_the_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("acsard.toml").write_text('[web]\naddress = ["https://127.0.0.1:8443"]\n')
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path / "state"))
    assert main(["web", "--tokens", "--tls", "tls"]) == 0
    assert main(["web", "--tokens"]) == 78
    assert "acsard tls init" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "hint"),
    [
        (("--days", "0"), "--hours"),
        (("--days", "0.0003"), "--hours"),
        (("--hours", "0"), "1 to 72"),
        (("--hours", "73"), "--days"),
        (("--hours", "1", "--days", "1"), "not allowed with"),
    ],
)
def test_an_invalid_or_repeated_lifetime_of_a_token_is_refused_with_a_hint(
    words: tuple[str, ...], hint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        main(["web", "--invite", "viewer", *words])
    assert hint in capsys.readouterr().err


def test_a_token_cannot_have_the_name_of_the_clients_on_the_robot_itself(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit):
        main(["web", "--invite", "operator", "--name", LOCAL_NAME])
    assert "'here' is the name of each browser on the robot itself" in capsys.readouterr().err


@each("option", ["--name phone", "--days 3", "--hours 3"])
@each("doing", ["", "--tokens", "--revoke phone"])
def test_the_options_of_an_invitation_require_invite(
    option: str, doing: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["web", *doing.split(), *option.split()]) == Exit.USAGE
    name = option.split()[0]
    error = f"{name} is for a new token: add --invite ROLE, or leave {name} out"
    assert error in capsys.readouterr().err


def test_a_second_robot_of_the_same_user_has_tokens_of_its_own(told: Callable[..., str]) -> None:
    told("--invite", "operator", "--name", "phone")
    told("--invite", "viewer", "--name", "phone", robot="robot2")
    assert "operator" in told("--tokens")
    assert "operator" not in told("--tokens", robot="robot2")
    assert "no tokens for the robot robot3" in told("--tokens", robot="robot3")

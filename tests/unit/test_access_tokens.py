"""Only hashes of tokens are stored, only their owner can read them, and they expire."""

from __future__ import annotations

import errno
import json
import os
import stat
import time
from pathlib import Path

import pytest

from acsard.cli import main
from acsard.core.values import Role
from acsard.host import clock
from acsard.host.errors import MendableError, NotPermittedError, UsageError
from acsard.machine.authority import Authority
from acsard.web import tokens
from acsard.web.callers import AdmittedClient
from acsard.web.tokens import ReadTokens, Vault
from tests.each import each


def owner(vault: Vault, text: str) -> AdmittedClient | None:
    """Return the owner of a token by the file as it is now."""
    return read(vault).owner([text])


def read(vault: Vault) -> ReadTokens:
    tokens = ReadTokens(vault)
    tokens.read()
    return tokens


def digests(vault: Vault) -> set[str]:
    return {token.digest for token in vault.valid()}


def test_a_token_is_valid_until_it_is_revoked(tmp_path: Path) -> None:
    keeper, server = Vault(tmp_path / "state", "robot1"), Vault(tmp_path / "state", "robot1")
    assert server.all() == []
    text, _ = keeper.invite("operator", "phone", 30)
    found = owner(server, text)
    assert found is not None
    assert (found.role, found.name) == ("operator", "phone")
    assert found.token in digests(server)
    keeper.revoke("phone")
    assert owner(server, text) is None
    assert found.token not in digests(server)


def test_one_token_may_open_the_pages_of_many_robots(tmp_path: Path) -> None:
    text = 32 * "a5"
    for robot in ("robot1", "robot2"):
        vault = Vault(tmp_path / robot, robot)
        assert vault.invite("viewer", "prometheus", 365, text=text)[0] == text
        found = owner(vault, text)
        assert found is not None
        assert (found.role, found.name) == ("viewer", "prometheus")
        assert text not in vault.path.read_text()
    with pytest.raises(UsageError, match="already, as prometheus"):
        vault.invite("viewer", "other", 365, text=text)
    vault.revoke("prometheus")
    assert owner(vault, text) is None
    assert owner(Vault(tmp_path / "robot1", "robot1"), text) is not None


@pytest.mark.parametrize("role", ["operator", "maintainer"])
def test_no_token_that_robots_share_lets_its_finder_drive_them(role: Role, tmp_path: Path) -> None:
    vault, text = Vault(tmp_path, "robot1"), 32 * "a5"
    with pytest.raises(UsageError, match=f"not for the role {role}.*Leave out --token"):
        vault.invite(role, "all", 1, text=text)
    assert owner(vault, text) is None


@pytest.mark.parametrize("text", ["password", 42 * "a", 129 * "a", 42 * "a" + "\n", 43 * "ä"])
def test_a_token_that_a_stranger_may_guess_is_refused(tmp_path: Path, text: str) -> None:
    with pytest.raises(UsageError, match="openssl rand -hex 32"):
        Vault(tmp_path, "robot1").invite("viewer", "tv", 1, text=text)


def test_the_token_itself_is_not_stored_on_the_disk(tmp_path: Path) -> None:
    vault = Vault(tmp_path / "state", "robot1")
    text, _ = vault.invite("viewer", "tv", 1)
    contents = b"".join(path.read_bytes() for path in tmp_path.rglob("*") if path.is_file())
    assert text.encode() not in contents
    assert stat.S_IMODE(vault.path.stat().st_mode) == 0o600
    assert stat.S_IMODE(vault.path.parent.stat().st_mode) == 0o700


def test_a_role_and_a_field_of_a_later_version_leave_the_other_tokens_valid(tmp_path: Path) -> None:
    vault = Vault(tmp_path, "acsar")
    text, token = vault.invite("operator", "phone", 1)
    pilot, other = vault.invite("viewer", "pilot", 1)
    content = json.loads(vault.path.read_bytes())
    rows = content["tokens"]
    rows[0]["later"], rows[1]["role"], content["later"] = 1, "pilot", 2
    rows.append({"name": "later", "secret": "of another form"})
    vault.path.write_text(json.dumps(content))
    assert digests(vault) == {token.digest, other.digest}
    assert owner(vault, text) == AdmittedClient("operator", "phone", token.digest)
    assert owner(vault, pilot) is None
    vault.revoke("pilot")
    content = json.loads(vault.path.read_bytes())
    row, unknown = content["tokens"]
    assert unknown == {"name": "later", "secret": "of another form"}
    assert (row["name"], row["later"], content["later"]) == ("phone", 1, 2)


class Clocks:
    """The clocks of a robot without a battery, whose wall clock begins in 1970 at each start."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.wall_s, self.steady_s = 1_800_000_000.0, 1000.0
        monkeypatch.setattr(time, "time", lambda: self.wall_s)
        monkeypatch.setattr(clock, "steady_s", lambda: self.steady_s)

    def advance(self, seconds: float) -> None:
        self.wall_s += seconds
        self.steady_s += seconds

    def restart(self) -> None:
        self.wall_s = self.steady_s = 5.0


@pytest.fixture
def clocks(monkeypatch: pytest.MonkeyPatch) -> Clocks:
    return Clocks(monkeypatch)


def test_a_token_that_expired_stays_expired_after_a_start_without_the_time(
    tmp_path: Path, clocks: Clocks
) -> None:
    server = Vault(tmp_path, "robot1")
    text, token = server.invite("maintainer", "me", 1)
    other, _ = server.invite("viewer", "tv", 30)
    for _ in range(25):
        assert (owner(server, text) is not None) is (clocks.wall_s < token.ends)
        clocks.advance(3600.0)
    clocks.restart()
    server = Vault(tmp_path, "robot1")
    assert owner(server, text) is None
    assert read(server).left_s(token.digest) == 0
    # A robot without a network never learns the time, and its valid tokens still work.
    assert owner(server, other) is not None


def test_without_the_time_a_token_lasts_its_days_of_running(tmp_path: Path, clocks: Clocks) -> None:
    text, _ = Vault(tmp_path, "robot1").invite("maintainer", "me", 1)
    valid = list[bool]()
    for _ in range(3):  # starts, each of which runs for 10 hours and 1 minute
        clocks.restart()
        server = Vault(tmp_path, "robot1")
        for _ in range(10):
            valid.append(owner(server, text) is not None)
            clocks.advance(3600.0)
        owner(server, text)
        clocks.advance(59.0)  # not written yet, so lost
    assert sum(valid) == 24
    assert not valid[-1]


def test_a_disk_that_cannot_store_the_time_leaves_the_tokens_valid(
    tmp_path: Path, clocks: Clocks, monkeypatch: pytest.MonkeyPatch
) -> None:
    vault = Vault(tmp_path, "robot1")
    _, ended = vault.invite("viewer", "guest", 1)
    _, token = vault.invite("viewer", "tv", 2)
    clocks.advance(ended.ends - clocks.wall_s)

    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(tokens, "replace", full)
    assert digests(vault) == {token.digest}
    with pytest.raises(MendableError, match=r"cannot write .*: No space left on device"):
        vault.invite("viewer", "phone", 1)


def test_a_damaged_file_has_no_valid_token_and_is_not_written_over(tmp_path: Path) -> None:
    vault = Vault(tmp_path, "robot1")
    text, _ = vault.invite("maintainer", "me", 1)
    for unknown in ("", "x", "x" * 10_000, "ü", "\0", "\udcff"):
        assert owner(vault, unknown) is None
    whole = vault.path.read_bytes()
    for damaged in (whole[:-3], whole.replace(b'"me"', '"mü"'.encode("latin-1")), b"[" * 100_000):
        vault.path.write_bytes(damaged)
        assert owner(vault, text) is None
        assert digests(vault) == set()
        for change in (lambda: vault.invite("viewer", "tv", 1), lambda: vault.revoke("me")):
            with pytest.raises(UsageError, match="does not hold tokens"):
                change()
        assert vault.path.read_bytes() == damaged


def test_a_name_is_given_once_and_an_unknown_one_cannot_be_revoked(tmp_path: Path) -> None:
    vault = Vault(tmp_path, "robot1")
    vault.invite("viewer", "tv", 1)
    with pytest.raises(UsageError, match="web revoke"):
        vault.invite("operator", "tv", 1)
    with pytest.raises(UsageError, match="the robot's tokens: tv"):
        vault.revoke("phone")


def test_robots_that_share_the_file_know_their_own_tokens_alone(tmp_path: Path) -> None:
    first, second = Vault(tmp_path, "robot1"), Vault(tmp_path, "robot2")
    ours, _ = first.invite("operator", "phone", 1)
    theirs, token = second.invite("viewer", "phone", 1)
    assert owner(first, ours) is not None
    assert owner(second, ours) is None
    assert owner(first, theirs) is None
    assert [entry.robot for entry in second.all()] == ["robot2"]
    assert digests(second) == {token.digest}
    assert read(first).left_s(token.digest) == 0
    first.revoke("phone")
    assert (first.all(), [entry.name for entry in second.all()]) == ([], ["phone"])
    with pytest.raises(UsageError, match="the robot's tokens: none"):
        first.revoke("phone")


def test_the_link_of_an_invitation_and_the_list_say_how_long_it_lasts(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path / "state"))
    Authority.make(Path("tls"), "test", 1).issue(Path("tls"), "robot", ["localhost"], 1)
    for words, lasts in (
        (("viewer", "--hours", "1"), "1 h"),
        (("operator",), "30 d"),
        (("maintainer", "--days", "3"), "3 d"),
    ):
        web = ["web", "--tls", "tls", "--address", "https://127.0.0.1:8443", "invite"]
        assert main([*web, *words]) == 0
        assert f", for {lasts}; the link" in capsys.readouterr().out
    assert main(["web", "tokens"]) == 0
    rows = capsys.readouterr().out.splitlines()
    assert [row.rpartition(", ")[2] for row in rows] == ["1 h left", "30 d left", "3 d left"]


@pytest.mark.skipif(os.geteuid() != 0, reason="needs root, to become a user without permission")
def test_a_user_who_may_not_write_the_tokens_is_told_to_use_sudo(tmp_path: Path) -> None:
    os.seteuid(65534)
    try:
        with pytest.raises(NotPermittedError, match="with sudo"):
            Vault(tmp_path / "state", "acsar").invite("viewer", "tv", 1)
    finally:
        os.seteuid(0)


def test_a_token_that_the_service_of_this_machine_does_not_read_is_named(tmp_path: Path) -> None:
    own, service = Vault(tmp_path / "own", "acsar"), tmp_path / "service"
    assert own.unknown_to(service) == ""
    service.mkdir()
    assert "run this command with sudo" in own.unknown_to(service)
    assert Vault(service, "acsar").unknown_to(service) == ""


@each(
    ("user", "has_service", "variables", "expected"),
    [
        (0, True, {}, "service"),
        (0, False, {}, "home/.local/state/acsard-web"),
        (1000, True, {}, "home/.local/state/acsard-web"),
        (1000, False, {"XDG_STATE_HOME": "data"}, "data/acsard-web"),
        (0, True, {"STATE_DIRECTORY": "of/unit:second"}, "of/unit"),
    ],
)
def test_tokens_are_those_of_the_service_for_root_and_else_of_the_user(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    user: int, has_service: bool, variables: dict[str, str], expected: str,
) -> None:  # fmt: skip
    monkeypatch.setattr(os, "geteuid", lambda: user)
    monkeypatch.setattr(tokens, "SERVICE_DIRECTORY", tmp_path / "service")
    monkeypatch.setattr(Path, "home", lambda: tmp_path / "home")
    for name in ("STATE_DIRECTORY", "XDG_STATE_HOME"):
        monkeypatch.delenv(name, raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, ":".join(str(tmp_path / part) for part in value.split(":")))
    if has_service:
        (tmp_path / "service").mkdir(exist_ok=True)
    elif (tmp_path / "service").exists():
        (tmp_path / "service").rmdir()
    assert tokens.place() == tmp_path / expected

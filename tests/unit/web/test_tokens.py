"""Tokens: only hashes are kept, only their owner reads them, and they end."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import msgspec
import pytest
from msgspec.structs import replace

from acsard.host.errors import NotPermittedError, UsageError
from acsard.web.tokens import Token, Vault


def test_an_invitation_is_somebody_until_it_is_revoked(tmp_path: Path) -> None:
    keeper, server = Vault(tmp_path / "state"), Vault(tmp_path / "state")
    assert server.all() == []
    text, _ = keeper.invite("operator", "phone", 30)
    who = server.who(text)
    assert who is not None
    assert (who.role, who.name) == ("operator", "phone")
    assert server.counts(who.token)
    keeper.revoke("phone")
    assert server.who(text) is None
    assert not server.counts(who.token)


def test_the_token_itself_is_nowhere_on_the_disk(tmp_path: Path) -> None:
    vault = Vault(tmp_path / "state")
    text, _ = vault.invite("viewer", "tv", 1)
    kept = b"".join(path.read_bytes() for path in tmp_path.rglob("*") if path.is_file())
    assert text.encode() not in kept
    assert stat.S_IMODE(vault.path.stat().st_mode) == 0o600
    assert stat.S_IMODE(vault.path.parent.stat().st_mode) == 0o700


def test_one_that_has_ended_is_nobody(tmp_path: Path) -> None:
    vault = Vault(tmp_path)
    text, token = vault.invite("viewer", "tv", 1)
    vault.path.write_bytes(msgspec.json.encode([replace(token, ends=token.made - 1)]))
    assert vault.who(text) is None
    assert not vault.counts(token.digest)


@pytest.mark.parametrize("text", ["", "x", "x" * 10_000, "ü", "\0"])
def test_what_never_was_a_token_is_nobody(tmp_path: Path, text: str) -> None:
    vault = Vault(tmp_path)
    vault.invite("viewer", "tv", 1)
    assert vault.who(text) is None


def test_a_damaged_file_lets_nobody_in(tmp_path: Path) -> None:
    vault = Vault(tmp_path)
    text, _ = vault.invite("maintainer", "me", 1)
    vault.path.write_bytes(vault.path.read_bytes()[:-3])
    assert vault.who(text) is None


def test_a_name_is_given_once_and_an_unknown_one_cannot_be_revoked(tmp_path: Path) -> None:
    vault = Vault(tmp_path)
    vault.invite("viewer", "tv", 1)
    with pytest.raises(UsageError, match="--revoke"):
        vault.invite("operator", "tv", 1)
    with pytest.raises(UsageError, match="there are: tv"):
        vault.revoke("phone")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_where_one_may_not_write_it_says_so(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    with pytest.raises(NotPermittedError, match="sudo"):
        Vault(tmp_path / "state").invite("viewer", "tv", 1)


def test_what_is_kept_has_no_more_than_it_needs() -> None:
    assert Token.__struct_fields__ == ("name", "role", "digest", "made", "ends")

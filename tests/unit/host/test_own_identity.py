"""Tests of the name that a process gives itself, for any user."""

from __future__ import annotations

import os
import pwd
import sys

import pytest

from acsard.core.messages.signature import (
    MAX_INT64,
    MAX_NAME_LENGTH,
    Signature,
    public_name,
    unpack,
)
from acsard.daemon.bus.inbox import MAX_ATTACHMENT_BYTES
from acsard.host.own_identity import own_name, sender_id


@pytest.mark.parametrize(
    ("program", "suffix"),
    [
        ("/home/joe/patrol.py", " patrol"),
        ("/opt/venv/bin/acsard", " acsard"),
        ("/opt/lib/acsard/__main__.py", " acsard"),
        ("-c", ""),
        ("", ""),
    ],
)
def test_the_own_name_has_user_machine_and_program(
    monkeypatch: pytest.MonkeyPatch, program: str, suffix: str
) -> None:
    monkeypatch.setattr(sys, "argv", [program])
    user, machine = pwd.getpwuid(os.getuid()).pw_name, os.uname().nodename.partition(".")[0]
    assert own_name() == f"{user}@{machine}{suffix}"


def test_a_user_without_a_name_is_shown_as_a_number(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "getuid", lambda: 4_000_000_000)
    assert own_name().startswith("4000000000@")


@pytest.mark.parametrize("name", ["joe", "a/b/c", "\U0001f916" * 100])
def test_a_sender_id_is_unique_and_fits_into_an_attachment(name: str) -> None:
    sender, other = sender_id(name), sender_id(name)
    assert sender != other
    assert sender.rpartition("/")[0] == name[:MAX_NAME_LENGTH]
    signature = Signature(sender, MAX_INT64, MAX_INT64)
    assert unpack(signature.pack()) == signature
    assert len(signature.pack()) <= MAX_ATTACHMENT_BYTES


def test_a_program_that_keeps_its_secret_keeps_its_public_name() -> None:
    assert public_name(sender_id("joe", "s3cret")) == public_name("joe/s3cret")
    assert public_name(sender_id("joe")) != public_name(sender_id("joe"))

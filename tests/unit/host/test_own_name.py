"""What a process calls itself, whoever runs it."""

from __future__ import annotations

import os
import pwd
import sys

import pytest

from acsard.host.own_name import own_name


@pytest.mark.parametrize(
    ("program", "told"),
    [
        ("/home/joe/patrol.py", " patrol"),
        ("/opt/venv/bin/acsard", " acsard"),
        ("/opt/lib/acsard/__main__.py", " acsard"),
        ("-c", ""),
        ("", ""),
    ],
)
def test_it_is_the_user_the_machine_and_the_program(
    monkeypatch: pytest.MonkeyPatch, program: str, told: str
) -> None:
    monkeypatch.setattr(sys, "argv", [program])
    user, machine = pwd.getpwuid(os.getuid()).pw_name, os.uname().nodename.partition(".")[0]
    assert own_name() == f"{user}@{machine}{told}"


def test_a_user_that_nobody_knows_is_a_number(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "getuid", lambda: 4_000_000_000)
    assert own_name().startswith("4000000000@")

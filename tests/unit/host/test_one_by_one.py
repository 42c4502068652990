"""Tests of the terminal that reads single keys for keyboard driving."""

from __future__ import annotations

import os
import pty
import select
import sys
import termios

import pytest

from acsard.host.one_by_one import one_by_one

CTRL_S = b"\x13"


def test_ctrl_s_is_a_key_and_holds_up_nothing_and_the_terminal_is_left_as_it_was(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    master, slave = pty.openpty()
    with os.fdopen(slave) as terminal, os.fdopen(master, "rb", 0) as far:
        monkeypatch.setattr(sys, "stdin", terminal)
        before = termios.tcgetattr(terminal)
        assert before[0] & termios.IXON
        with one_by_one():
            os.write(far.fileno(), CTRL_S)
            assert os.read(terminal.fileno(), 9) == CTRL_S
            os.write(terminal.fileno(), b"written")
            assert select.select([far], [], [], 5.0)[0]
            assert far.read(9) == b"written"
        assert termios.tcgetattr(terminal) == before

"""Children that are started, watched and ended, and the own name."""

from __future__ import annotations

import os
import pwd
import signal
import socket
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsard.core.messages.signature import (
    MAX_INT64,
    MAX_NAME_LENGTH,
    Signature,
    unpack,
)
from acsard.core.values import NS_PER_S
from acsard.daemon.bus.inbox import MAX_ATTACHMENT_BYTES
from acsard.host import child as module
from acsard.host import clock
from acsard.host.child import (
    Child,
    Parent,
    Silence,
    end,
    environment,
    how_it_ended,
)
from acsard.host.own_identity import own_name, sender_id

WAIT_S = 20.0

ALIVE = "import os, time; os.write(0, b'.'); "
UNTIL_CLOSED = "import os; os.read(0, 1)"


def program(text: str) -> list[str]:
    return [sys.executable, "-S", "-c", text]


def started(text: str) -> subprocess.Popen[bytes]:
    """Start a program and wait until it has printed a line."""
    process = subprocess.Popen(program(text), stdout=subprocess.PIPE)
    assert process.stdout is not None
    assert process.stdout.readline()
    return process


def is_alive(pid: int) -> bool:
    """Return whether a process runs.

    A process that has ended but is not yet reaped does not run.
    """
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def wait_for_end(pid: int) -> None:
    end_ns = clock.mono_ns() + WAIT_S * NS_PER_S
    while is_alive(pid):
        assert clock.mono_ns() < end_ns
        threading.Event().wait(0.01)


# one run of a child


@pytest.mark.parametrize(
    ("text", "code", "words"),
    [
        ("", 0, "ended with exit code 0"),
        ("raise SystemExit(78)", 78, "ended with exit code 78"),
        ("import os; os.kill(os.getpid(), 9)", -9, "was ended by signal 9"),
    ],
)
def test_a_run_returns_how_the_child_ended(text: str, code: int, words: str) -> None:
    child = Child(program(text))
    assert (child.run(), child.silent, how_it_ended(code)) == (code, "", words)
    with pytest.raises(OSError, match="No such file"):
        Child(["/nowhere/acsard"]).run()


@pytest.mark.parametrize("early", [True, False])
def test_a_child_that_is_released_sees_the_end_of_its_input(early: bool) -> None:
    child, codes = Child(program(UNTIL_CLOSED)), []
    thread = threading.Thread(target=lambda: codes.append(child.run()))
    if early:
        child.release()
    thread.start()
    while child._parent_end is None and not early:
        threading.Event().wait(0.001)
    child.release()
    thread.join(WAIT_S)
    assert codes == [0]


@pytest.mark.parametrize(
    ("text", "timeout"),
    [
        ("import time; time.sleep(100)", "START_TIMEOUT_NS"),
        (ALIVE + "os.kill(os.getpid(), 19)", "SILENCE_TIMEOUT_NS"),
    ],
)
def test_a_child_without_signs_of_life_is_killed(
    text: str, timeout: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "START_TIMEOUT_NS", 3600 * NS_PER_S)
    monkeypatch.setattr(module, timeout, 0)
    child = Child(program(text))
    assert child.run() == -signal.SIGKILL
    assert "stopped or hung" in child.silent


def test_a_child_has_its_own_session_and_no_notify_socket_of_its_parent(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("NOTIFY_SOCKET", "/run/us")
    monkeypatch.setenv("MORE", "1")
    output = tmp_path / "found"
    text = "import os; print(os.getsid(0) == os.getpid(), 'NOTIFY_SOCKET' in os.environ, "
    assert Child(program(f"{text} file=open({str(output)!r}, 'w'))")).run() == 0
    assert output.read_text() == "True False\n"
    assert "MORE" in environment()


# the end by signals


SLEEPS = "import signal, time; print(1, flush=True); time.sleep(100)"


@pytest.mark.parametrize(
    ("text", "patience_s", "code"),
    [
        (SLEEPS, WAIT_S, -signal.SIGTERM),
        (
            SLEEPS.replace("print", "signal.signal(15, signal.SIG_IGN); print"),
            0.05,
            -signal.SIGKILL,
        ),
        ("print(1, flush=True)", 0.05, 0),
    ],
)
def test_a_child_is_ended_by_sigterm_or_killed_and_left_alone_if_it_has_ended(
    text: str, patience_s: float, code: int
) -> None:
    process = started(text)
    if code == 0:
        process.wait(WAIT_S)
    end(process, patience_s)
    assert process.returncode == code


def test_a_child_ends_when_its_parent_is_killed() -> None:
    inner = (
        "import signal, time; from acsard.host.child import end_with_parent; "
        "end_with_parent(signal.SIGKILL); print(1, flush=True); time.sleep(100)"
    )
    outer = (
        "import subprocess, sys, time; "
        f"child = subprocess.Popen([sys.executable, '-c', {inner!r}], stdout=subprocess.PIPE); "
        "child.stdout.readline(); print(child.pid, flush=True); time.sleep(100)"
    )
    process = subprocess.Popen([sys.executable, "-c", outer], stdout=subprocess.PIPE)
    assert process.stdout is not None
    grandchild = int(process.stdout.readline())
    assert is_alive(grandchild)
    process.kill()
    process.wait(WAIT_S)
    wait_for_end(grandchild)


# the parent, as the child sees it


def test_a_parent_that_closed_its_end_is_gone_and_beats_raise_no_error() -> None:
    ours, its = socket.socketpair()
    with its:
        parent = Parent(its.fileno())
        assert not parent.is_gone()  # nothing to read
        ours.send(b"?")
        assert not parent.is_gone()
        parent.beat()
        ours.close()
        assert parent.is_gone()  # it left a sign of life unread
        assert parent.is_gone()
        parent.beat()


# the silence of a child


S = 10**9
MOST = 3 * S


def test_a_silence_is_too_long_when_it_exceeds_the_limit() -> None:
    silence = Silence(MOST)
    assert [silence.too_long(False, S // 2) for _ in range(7)] == [False] * 6 + [True]


@given(st.lists(st.integers(0, 10**13), max_size=6))
def test_a_stall_of_the_machine_does_not_count_as_silence(stalls: list[int]) -> None:
    silence = Silence(MOST)
    assert not any(silence.too_long(False, stall) for stall in stalls)


@pytest.mark.parametrize(
    ("program", "suffix"),
    [
        ("/home/joe/patrol.py", " patrol"),
        ("/opt/venv/bin/acsard", " acsard call"),
        ("/opt/lib/acsard/__main__.py", " acsard call"),
        ("-c", ""),
        ("", ""),
    ],
)
def test_the_own_name_has_user_machine_and_program(
    monkeypatch: pytest.MonkeyPatch, program: str, suffix: str
) -> None:
    monkeypatch.setattr(sys, "argv", [program, "call", "stop"])
    user, machine = pwd.getpwuid(os.getuid()).pw_name, os.uname().nodename.partition(".")[0]
    assert own_name() == f"{user}@{machine}{suffix}"


@pytest.mark.parametrize("name", ["joe", "a/b/c", "\U0001f916" * 100])
def test_a_sender_id_is_unique_and_fits_into_an_attachment(name: str) -> None:
    sender, other = sender_id(name), sender_id(name)
    assert sender != other
    assert sender.rpartition("/")[0] == name[:MAX_NAME_LENGTH]
    signature = Signature(sender, MAX_INT64, MAX_INT64)
    assert unpack(signature.pack()) == signature
    assert len(signature.pack()) <= MAX_ATTACHMENT_BYTES

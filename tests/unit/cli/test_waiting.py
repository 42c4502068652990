"""A tool explains once why it waits, and only if no message arrives."""

from __future__ import annotations

import threading
import time

import pytest

from acsard.cli.connection import explained

NEVER_S = 3600.0


def ended() -> bool:
    return not any(thread.name == "waiting" for thread in threading.enumerate())


def await_end() -> None:
    end = time.monotonic() + 10.0
    while not ended():
        assert time.monotonic() < end, "it still waits"
        time.sleep(0.001)


def test_a_wait_is_explained_in_one_line_on_stderr(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with explained(lambda: "waiting for\x1b[2J acsard/ghost/state", after_s=0.0):
        await_end()
    output = capsys.readouterr()
    assert output.out == ""
    assert output.err.count("\n") == 1
    assert output.err.startswith("acsard: waiting for")
    assert output.err.strip().isprintable()


def test_a_wait_that_a_message_ended_is_not_explained(capsys: pytest.CaptureFixture[str]) -> None:
    with explained(lambda: "why", after_s=NEVER_S) as notify:
        assert not ended()
        notify()
        await_end()
    assert capsys.readouterr().err == ""


def test_a_message_during_the_diagnosis_suppresses_the_explanation(
    capsys: pytest.CaptureFixture[str],
) -> None:
    looking, come = threading.Event(), threading.Event()

    def look() -> str:
        looking.set()
        come.wait(10.0)
        return "why"

    with explained(look, after_s=0.0) as notify:
        assert looking.wait(10.0)
        notify()
        come.set()
        await_end()
    assert capsys.readouterr().err == ""


def test_leaving_the_context_ends_the_waiting_thread() -> None:
    with explained(lambda: "why", after_s=NEVER_S):
        pass
    await_end()


def test_a_silence_that_ends_with_the_timeout_is_explained_before_it_ends(
    capsys: pytest.CaptureFixture[str],
) -> None:
    def look() -> str:
        time.sleep(0.05)
        return "it is published only when it changes"

    with explained(look, after_s=NEVER_S, timeout_s=0.01):
        time.sleep(0.02)
    assert capsys.readouterr().err == "acsard: it is published only when it changes\n"


def wait_for_lines(lines: int, capsys: pytest.CaptureFixture[str]) -> str:
    """Wait until standard error has this many lines, and return its text."""
    output, end = "", time.monotonic() + 10.0
    while output.count("\n") < lines:
        assert time.monotonic() < end, f"told only: {output}"
        time.sleep(0.001)
        output += capsys.readouterr().err
    return output


def test_each_silence_is_explained_once(capsys: pytest.CaptureFixture[str]) -> None:
    with explained(lambda: "", lambda: "its certificate has ended", 0.01) as notify:
        for _ in range(2):
            notify()
            assert wait_for_lines(1, capsys) == "acsard: its certificate has ended\n"
    await_end()
    assert capsys.readouterr().err == ""


def test_a_silence_without_a_found_cause_is_diagnosed_again(
    capsys: pytest.CaptureFixture[str],
) -> None:
    causes = iter(["", "", "the way to it is cut"])
    with explained(lambda: "", lambda: next(causes), 0.001) as notify:
        notify()
        assert wait_for_lines(1, capsys) == "acsard: the way to it is cut\n"
    await_end()

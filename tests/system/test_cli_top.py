"""`acsard top` shows the robot on a terminal, and prints to a pipe."""

from __future__ import annotations

import re
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.system.harness import Bus, Daemon, Program, acsard, environment, finish, until
from tests.system.terminals import SCREEN, Terminal, at_terminal

SIZE = 80, 24

FRAME = "\x1b[H"
"""The beginning of each screen: the cursor goes home."""


@contextmanager
def top(daemon: Daemon) -> Iterator[tuple[Terminal, Program]]:
    """Run `acsard top` on a separate terminal of 80x24 characters."""
    words = ("top", "--config", str(daemon.config))
    with at_terminal(daemon.config.parent, *words, term=SCREEN, piped="stderr") as session:
        yield session


def last_screen(terminal: Terminal) -> list[str]:
    """Return the lines of the last complete screen without colours, or [] if there is none yet."""
    for frame in reversed(terminal.screen.split(FRAME)):
        lines = re.sub(r"\x1b\[[0-9;]*m", "", frame).split("\r\n")
        if len(lines) >= SIZE[1] and len(lines[-1]) >= SIZE[0]:
            return [line.rstrip() for line in lines]
    return []


def shows(terminal: Terminal, text: str, within: float) -> list[str]:
    """Wait for the text, and return the first screen that contains it."""

    def look() -> list[str] | None:
        lines = last_screen(terminal)
        return lines if any(text in line for line in lines) else None

    return until(look, within, f"{text!r} on the screen")


def piped(daemon: Daemon) -> Program:
    """Run `acsard top` with a pipe as output, although FORCE_COLOR asks for colours."""
    env = environment(COLUMNS="80", FORCE_COLOR="1")
    return Program(acsard("top", "--config", str(daemon.config)), daemon.config.parent, env)


@pytest.mark.slow
def test_top_shows_the_robot_in_a_pipe_and_at_a_terminal_and_outlives_its_daemon(
    tmp_path: Path,
) -> None:
    # Everything is in one test, because of the 2 s that a silence takes.
    with Daemon(tmp_path) as daemon, piped(daemon) as once, top(daemon) as (terminal, program):
        lines = shows(terminal, " READY ", 10.0)
        assert len(lines) == SIZE[1]
        assert max(map(len, lines)) <= SIZE[0]
        texts = ("waiting for a command", "SIMULATOR", "teleop", "mcu_round_trip")
        for text in (daemon.endpoint, *texts):
            assert any(text in line for line in lines), text

        with Bus(daemon.endpoint) as bus, bus.commanding(0.5):
            lines = shows(terminal, " DRIVING ", 5.0)
            assert any(line.startswith("▶ app") for line in lines)

        assert (once.ended(10.0), once.stderr) == (0, "")
        assert re.match(r" [A-Z]+  ", once.out[1])
        assert all(len(line) <= 80 and line.isprintable() for line in once.out)
        assert re.search(r"lines in +[\d.-]+/s +[\d,]+ ", once.stdout)

        daemon.signal(signal.SIGKILL)
        daemon.ended(5.0)
        lines = shows(terminal, "s: is the daemon running?", 5.0)
        assert len(lines) == SIZE[1]
        with Daemon(tmp_path, endpoint=daemon.endpoint, name="again"):
            shows(terminal, " READY ", 5.0)
            during = terminal.settings
            terminal.press("q")
            assert program.ended(3.0) == 0
        after = terminal.settings
    # On exit it shows the cursor again, and restores the screen and the terminal.
    assert terminal.screen.endswith("\x1b[?25h\x1b[?1049l")
    assert "Traceback" not in terminal.screen + program.stderr
    assert during != after
    with Terminal() as fresh:
        assert after == fresh.settings


@pytest.mark.slow
def test_top_once_shows_the_current_state_even_if_it_is_published_rarely(tmp_path: Path) -> None:
    with Daemon(tmp_path, config={"rates": {"telemetry": 0.1}}) as daemon:
        done = finish(acsard("top", "--once", "--config", str(daemon.config)), tmp_path)
    assert (done.code, done.err) == (0, "")
    assert re.search(r"^ [A-Z]+  ", done.out, re.M)
    assert "NOTHING RECEIVED" not in done.out
    assert re.search(r"lines in +[\d.]+/s +[\d,]+ ", done.out)

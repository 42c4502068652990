"""`acsard drive` at a terminal: its screen, its keys, and each way in which it ends."""

from __future__ import annotations

import fcntl
import os
import pty
import signal
import struct
import subprocess
import termios
import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from acsard.client import connect
from tests.system.harness import (
    Bus,
    Daemon,
    Program,
    acsard,
    environment,
    until,
)
from tests.system.terminals import (
    ON_TERMINAL,
    SCREEN,
    UNDER_A_SHELL,
    Terminal,
    at_terminal,
    key_held,
    screens,
)

WAITS = "waiting for a command"
"""The first words of the reason while no client drives the robot."""


@contextmanager
def driving(
    shared: Daemon, *words: str, how: str = ON_TERMINAL, columns: int = 80
) -> Iterator[tuple[Terminal, Program]]:
    """Run `acsard drive` at a terminal of this width."""
    drive = ("drive", "--config", str(shared.config), *words)
    with at_terminal(
        shared.config.parent, *drive, how=how, term=SCREEN, columns=columns, piped="stderr"
    ) as (terminal, program):
        until(lambda: [screen for screen in screens(terminal) if WAITS in screen], 10.0, "it")
        yield terminal, program


@pytest.mark.slow
@pytest.mark.variations(2)
@pytest.mark.parametrize("columns", [40, 80])
def test_drive_shows_reason_pose_and_help_on_a_screen_of_any_width(
    shared: Daemon, bus: Bus, columns: int
) -> None:
    with driving(shared, columns=columns) as (terminal, _):
        with key_held(terminal, "i"):
            until(lambda: "DRIVING" in screens(terminal)[-1], 5.0, "driving")
        frames = screens(terminal)
    assert all("u  i  o" in frame for frame in frames if "as teleop" in frame)
    screen = next(frame for frame in frames if WAITS in frame)
    content = " ".join(screen.split())
    for text in ("READY", "no source has sent a usable one within", "yaw", "rad/s", "u i o"):
        assert text in content
    assert all(len(line.rstrip()) <= columns for line in screen.split("\r\n"))
    # Each screen overwrites the one before: nothing scrolls.
    assert "\x1b[?1049h" in terminal.screen
    assert all(frame.count("\n") < 24 for frame in frames)


@pytest.mark.slow
def test_ctrl_z_ends_a_drive_by_a_zero_with_the_terminal_as_it_was(
    shared: Daemon, bus: Bus
) -> None:
    with Terminal() as fresh:
        usual = fresh.settings
    with driving(shared) as (terminal, program), bus.follow("cmd/teleop") as commands:
        with key_held(terminal, "i"):
            until(lambda: (bus.state()["linear"] or 0.0) > 0.1, 5.0, "moving")
        typed = time.monotonic()
        terminal.press("\x1a")
        commands.find(lambda value: value["linear"]["x"] == 0, 2.0, "a zero", after=typed)
        assert program.ended(3.0) == 0
        assert terminal.settings == usual
    bus.at_rest()


@pytest.mark.slow
def test_a_terminal_closed_under_a_shell_stops_its_drive_by_a_zero_not_by_silence(
    shared: Daemon, bus: Bus
) -> None:
    # The program gets the signal twice: from its keys or its shell, and once more while it sends
    # its zeros.
    with (
        bus.follow("cmd/teleop") as commands,
        driving(shared, how=UNDER_A_SHELL) as (terminal, _),
    ):
        with key_held(terminal, "i"):
            until(lambda: (bus.state()["linear"] or 0.0) > 0.2, 5.0, "moving")
        closed = time.monotonic()
        terminal.close()
        commands.find(lambda value: value["linear"]["x"] == 0, 1.0, "a zero", after=closed)
    bus.at_rest()


@pytest.mark.slow
def test_ctrl_c_while_driving_stops_and_leaves_with_0_and_the_terminal_as_it_was(
    shared: Daemon, bus: Bus
) -> None:
    with driving(shared) as (terminal, program):
        during = terminal.settings
        with key_held(terminal, "i"):
            until(lambda: (bus.state()["linear"] or 0.0) > 0.3, 5.0, "moving")
        with bus.follow("cmd/teleop") as commands:
            terminal.press("\x03")
            left = time.monotonic()
            assert program.ended(3.0) == 0
            commands.find(lambda value: value["linear"]["x"] == 0, 2.0, "a zero", after=left)
        bus.at_rest()
        words = "drive ended: the robot stands still; ready: "
        until(lambda: words in terminal.screen, 2.0, "the last word")
        after = terminal.settings
    assert "Traceback" not in terminal.screen + program.stderr
    assert during != after
    with Terminal() as fresh:
        assert after == fresh.settings


def test_drive_at_a_terminal_without_a_screen_ends_with_2(shared: Daemon) -> None:
    words = ("drive", "--config", str(shared.config))
    with at_terminal(shared.config.parent, *words, piped="stderr") as (_, program):
        assert program.ended(10.0) == 2
    assert "TERM" in program.stderr


@pytest.mark.slow
def test_a_drive_ends_with_zeros_although_its_terminal_reads_nothing(shared: Daemon) -> None:
    terminal, other = pty.openpty()
    fcntl.ioctl(other, termios.TIOCSWINSZ, struct.pack("HHHH", 50, 250, 0, 0))
    words = acsard("drive", "--config", str(shared.config))
    env = environment() | {"TERM": "xterm"}
    with (
        connect(shared.endpoint) as robot,
        subprocess.Popen(words, stdin=other, stdout=other, stderr=other, env=env) as process,
    ):
        os.close(other)
        try:
            until(lambda: len(os.read(terminal, 4096)) > 100, 10.0, "the first screen")

            def drives() -> bool:
                os.write(terminal, b"i")
                time.sleep(0.05)
                return (robot.get("state").linear or 0.0) > 0.1

            until(drives, 10.0, "that the key drives the robot")
            # The screen is drawn four times a second, so it fills the terminal's buffer soon.
            end = time.monotonic() + 4.0
            while time.monotonic() < end:
                drives()
            process.send_signal(signal.SIGTERM)
            assert process.wait(10.0) == 0
            assert not robot.get("state").linear
        finally:
            process.kill()
            os.close(terminal)

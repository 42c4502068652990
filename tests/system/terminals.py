"""Simulates a person at a terminal, and runs `acsard` at a separate terminal."""

from __future__ import annotations

import fcntl
import os
import pty
import re
import select
import struct
import subprocess
import sys
import termios
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tests.system.harness import Program, environment

SCREEN = "xterm-256color"
"""The kind of a terminal that can show a screen."""

ON_TERMINAL = """\
import fcntl, os, sys, termios
fcntl.ioctl(0, termios.TIOCSCTTY, 0)
os.execv(sys.executable, [sys.executable, "-m", "acsard", *sys.argv[1:]])
"""
"""Makes its standard input the controlling terminal, as a shell does, so that ^C is a signal."""


UNDER_A_SHELL = """\
import fcntl, os, sys, termios
fcntl.ioctl(0, termios.TIOCSCTTY, 0)
words = ["bash", "--norc", "-ic", '"$@"; true', "bash", sys.executable, "-m", "acsard"]
os.execvp("bash", [*words, *sys.argv[1:]])
"""
"""The same program, as a job of a shell."""


class Terminal:
    """A person at a terminal: presses keys and reads the screen."""

    def __init__(self) -> None:
        self.screen = ""
        self._master, self.slave = pty.openpty()
        self._open = True
        self._leave = threading.Event()
        self._reader = threading.Thread(target=self._read)

    def __enter__(self) -> Terminal:
        self._reader.start()
        return self

    def __exit__(self, *error: object) -> None:
        if self._open:
            self.close()

    def close(self) -> None:
        """Close the terminal, as a person closes its window."""
        self._open = False
        self._leave.set()
        self._reader.join()
        os.close(self._master)
        os.close(self.slave)

    def press(self, key: str) -> None:
        os.write(self._master, key.encode())

    @property
    def settings(self) -> list[object]:
        return list(termios.tcgetattr(self.slave))

    def _read(self) -> None:
        while not self._leave.is_set():
            if select.select([self._master], [], [], 0.05)[0]:
                self.screen += os.read(self._master, 4096).decode(errors="replace")


@contextmanager
def key_held(
    terminal: Terminal, key: str, drives: Callable[[], bool] = lambda: True
) -> Iterator[None]:
    """Hold a key down while the body runs. The key repeats 20 times a second.

    A computer that is too busy may end a ride before it `drives`. The person then lets go for a
    second.
    """
    released = threading.Event()

    def repeat() -> None:
        since, driven = time.monotonic(), False
        while not released.wait(0.05):
            terminal.press(key)
            driven = driven or drives()
            if not driven and time.monotonic() > since + 3.0:
                released.wait(1.0)
                since = time.monotonic()

    thread = threading.Thread(target=repeat)
    thread.start()
    try:
        yield
    finally:
        released.set()
        thread.join()


def screens(terminal: Terminal) -> list[str]:
    """Return all complete screens that the program has drawn so far, without colours."""
    frames = terminal.screen.split("\x1b[H")[1:-1]
    return [re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", frame) for frame in frames]


@contextmanager
def at_terminal(
    where: Path,
    *words: str,
    how: str = ON_TERMINAL,
    term: str = "dumb",
    columns: int = 80,
    piped: str = "",
) -> Iterator[tuple[Terminal, Program]]:
    """Run `acsard` at a separate terminal with 24 lines.

    `term` is the kind of terminal and `columns` its width. `piped` names an output stream that goes
    into a pipe instead.
    """
    with Terminal() as terminal:
        size = struct.pack("HHHH", 24, columns, 0, 0)
        fcntl.ioctl(terminal.slave, termios.TIOCSWINSZ, size)
        env = environment(TERM=term)
        for name in ("COLUMNS", "LINES", "NO_COLOR"):
            env.pop(name, None)
        streams: dict[str, Any] = dict.fromkeys(("stdin", "stdout", "stderr"), terminal.slave)
        if piped:
            streams[piped] = subprocess.PIPE
        command = [sys.executable, "-c", how, *words]
        with Program(command, where, env, **streams, start_new_session=True) as program:
            yield terminal, program

"""Starts child processes, watches their signs of life, and ends them.

Each child has its own session, so a Ctrl-C at the terminal reaches only the parent, which then ends
its children. A child does not outlive its parent: a socket (`Child` and `Parent`), which is the
child's standard input, carries its signs of life, and the child ends when the parent closes it. The
parent kills a child that falls silent.
"""

from __future__ import annotations

import ctypes
import os
import select
import signal
import socket
import stat
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from acsard.core.values import NS_PER_S, Ns
from acsard.host import clock

# With them, a child could notify systemd in its parent's name.
SYSTEMD_VARIABLES = ("NOTIFY_SOCKET", "INVOCATION_ID")

HEARTBEAT_S = 0.5  # longest pause between two signs of life, and between two checks

# The TLS gateway ends itself after 1 s without progress, so this is for a process that cannot.
SILENCE_TIMEOUT_NS = 3 * NS_PER_S

# Long, because a child that needs longer is killed and started again and again. On a busy computer
# the page took half a minute.
START_TIMEOUT_NS = 60 * NS_PER_S


class Silence:
    """Measures how long another process has given no sign of life.

    Between two calls of `too_long` at most 0.5 s counts, because the computer may have stopped both
    processes meanwhile.
    """

    def __init__(self, timeout_ns: Ns) -> None:
        self._timeout_ns, self._ns = timeout_ns, 0

    def too_long(self, alive: bool, passed_ns: Ns) -> bool:
        """Return whether the silence is too long, `passed_ns` after the last call."""
        self._ns = 0 if alive else self._ns + min(passed_ns, NS_PER_S // 2)
        return self._ns > self._timeout_ns


# The parent's side: start and end


def acsard(*words: str) -> list[str]:
    """Return the command that runs acsard with the arguments `words`."""
    # In /opt/acsard only this program knows where the libraries are (`machine/versions.py`).
    lib = Path(__file__).parents[2]
    if lib.name == "lib" and (program := lib.parent / "bin" / "acsard").is_file():
        return [sys.executable, "-I", str(program), *words]
    # With -P Python ignores the working directory, so it runs the installed package.
    return [sys.executable, "-P", "-m", "acsard", *words]


def environment() -> dict[str, str]:
    """Return this process's environment variables, without `SYSTEMD_VARIABLES`."""
    return {key: value for key, value in os.environ.items() if key not in SYSTEMD_VARIABLES}


def how_it_ended(code: int) -> str:
    """Return how a process ended, such as "ended with exit code 1"; `code` < 0 is a signal."""
    return f"was ended by signal {-code}" if code < 0 else f"ended with exit code {code}"


def end(process: subprocess.Popen[bytes], timeout_s: float) -> None:
    """End a child with SIGTERM, and with SIGKILL after `timeout_s`."""
    process.terminate()
    try:
        process.wait(timeout_s)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


class Child:
    """A child process, as its parent sees it. The program must use the class `Parent`."""

    def __init__(self, command: Sequence[str]) -> None:
        self._command = command
        self._parent_end: socket.socket | None = None
        self._over = False
        self.silent = ""  # why the child was killed, in words

    def run(self) -> int:
        """Run the child until it ends, and return its exit code, or minus the signal that ended it.

        If the child falls silent, kill it and set `silent`. Raises `OSError` if it cannot be
        started.
        """
        parent_end, child_end = socket.socketpair()
        with parent_end:
            with child_end:
                process: subprocess.Popen[bytes] = subprocess.Popen(
                    self._command,
                    stdin=child_end.fileno(),
                    stdout=2,
                    start_new_session=True,
                    env=environment(),
                )
            self._parent_end = parent_end
            if self._over:  # `release` was called while the child was being started
                self.release()
            if self._falls_silent(parent_end):
                process.kill()
            return process.wait()

    def _falls_silent(self, parent_end: socket.socket) -> bool:
        # False: the child ended, or `release` was called.
        silence, before_ns, alive = Silence(START_TIMEOUT_NS), clock.mono_ns(), False
        while True:
            beat = (
                parent_end.recv(4096)
                if select.select([parent_end], [], [], HEARTBEAT_S)[0]
                else None
            )
            if beat == b"":
                return False
            if beat and not alive:
                alive, silence = True, Silence(SILENCE_TIMEOUT_NS)
            now_ns = clock.mono_ns()
            if silence.too_long(bool(beat), now_ns - before_ns):
                self.silent = (
                    "sent no more signs of life (stopped or hung), so its parent killed it"
                )
                return True
            before_ns = now_ns

    def release(self) -> None:
        """Make the child end by closing its standard input. Any thread may call this."""
        self._over = True
        if self._parent_end is not None:
            try:
                self._parent_end.shutdown(socket.SHUT_RDWR)
            except OSError:
                pass  # the child has ended, or has closed its end of the socket


# The child's side


class Parent:
    """The connection of a child to the parent that started it as a `Child`.

    `fd` is the child's standard input. If a person started this process, `beat` does nothing.
    """

    def __init__(self, fd: int) -> None:
        self.fd = fd
        # `fd` is a pipe or terminal if a person started this.
        self._listens = stat.S_ISSOCK(os.fstat(fd).st_mode)
        if self._listens:
            os.set_blocking(fd, False)

    def beat(self) -> None:
        """Send a sign of life, without waiting."""
        if self._listens:
            with suppress(OSError):
                os.write(self.fd, b".")  # fails if the buffer is full or the parent has gone

    def is_gone(self) -> bool:
        """Return whether the parent has closed the socket; call this only if `fd` is readable."""
        try:
            return not os.read(self.fd, 64)
        except BlockingIOError:
            return False
        except OSError:
            return True  # the parent ended before it had read all signs of life


def end_signals() -> tuple[signal.Signals, ...]:
    """Return the signals that end a daemon; SIGHUP only if `nohup` does not ignore it."""
    signals = (signal.SIGTERM, signal.SIGINT, signal.SIGQUIT)
    ignored = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    return signals if ignored else (*signals, signal.SIGHUP)


def end_with_parent(number: signal.Signals) -> None:
    """Let the kernel send `number` when the parent, or the thread that started this one, ends."""
    ctypes.CDLL(None).prctl(1, number)  # PR_SET_PDEATHSIG in linux/prctl.h

"""Reports of recordings as the page has them: drawn by a process of its own, one at a time.

It is what `acsard log report` draws, by a child at the lowest priority that is bounded in time, in
memory and in what it says, and ends with us or once nobody asks for it any more. What it says is
kept in memory, packed, until another is drawn; no file is written.

A report is a page full of strangers' words (names, sentences). It escapes them, its own policy lets
two programs run and nothing be loaded, and the one here takes our origin away from it: whatever ran
in it had neither the cookie nor the interface of this page.
"""

from __future__ import annotations

import asyncio
import gzip
import os
import resource
import signal
import sys
from asyncio.subprocess import DEVNULL, PIPE, Process
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Literal

from msgspec import Struct

from acsard.host import clock
from acsard.host.threads import in_thread
from acsard.values import NS_PER_S

# -P: what is installed, and not what lies in the directory that we were started in.
COMMAND = (sys.executable, "-P", "-m", "acsard", "log", "report", "--held")

POLICY = (
    "sandbox allow-scripts; default-src 'none'; script-src 'unsafe-inline'; style-src "
    "'unsafe-inline'; img-src data: blob:; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'"
)
"""Without `allow-same-origin` it has an origin that is nobody's. Which of the programs in it may
run, the report's own policy says by their hashes: both hold."""

NICE = 19

FIRST_TO_GO = b"1000"
"""Of `oom_score_adj`: when memory runs out, ours or the computer's, it goes before the page."""

DRAW_S = 600.0
"""A full file of the black box, an hour or four, takes minutes on a small computer."""

ALONE_NS = 60 * NS_PER_S
"""Nobody has asked for so long how far it is: it is given up."""

KEEP_NS = 900 * NS_PER_S
"""So long a report is there to be opened."""

LOOK_S = 1.0

BYTES = 32 << 20
"""Of a report; one takes 5 to 8 MB."""

MEMORY = 256 << 20
"""Of the child."""

SAID = 2000
"""Characters of what it says when it fails."""

TOO_LONG = (
    f"it takes longer than {DRAW_S / 60:.0f} min here: fetch the recording, and draw it on a "
    "faster machine by acsard log report"
)
TOO_MUCH = (
    f"it takes over {MEMORY >> 20} MB of memory: draw it on another machine, by acsard log report"
)
KILLED = (
    "it was ended from outside, for want of memory most likely: draw it on another machine, by "
    "acsard log report"
)
TOO_BIG = f"it has over {BYTES >> 20} MB: draw a part of it, by acsard log report --from --to"

State = Literal["drawing", "ready", "failed", "busy"]


class Progress(Struct, frozen=True, omit_defaults=True):
    """How far one is."""

    report: State
    text: str = ""
    """Why it failed, or what to wait for."""
    percent: int = 0
    seconds: float = 0.0
    """Since it was begun."""
    href: str = ""
    """Where it is, from the page on."""


class _Drawing:
    """One that is being drawn, or has been."""

    def __init__(self, path: Path, stamp: tuple[int, int]) -> None:
        self.path, self.stamp = path, stamp
        self.percent = 0
        self.begun_ns = self.asked_ns = clock.mono_ns()
        self.packed = b""
        """By gzip, once it is there."""
        self.failed = ""
        self.told = False
        """That it has ended."""

    @property
    def ended(self) -> bool:
        return bool(self.packed or self.failed)


class Reports:
    """The newest."""

    def __init__(self, command: Sequence[str] = COMMAND) -> None:
        self._command = command
        self._one: _Drawing | None = None
        self._work: asyncio.Task[None] | None = None

    def ask(self, path: Path, stamp: tuple[int, int]) -> Progress:
        """How far the report of this recording is, which is begun where there is none; `stamp`
        changes with it."""
        one, now_ns = self._one, clock.mono_ns()
        if one is not None and not one.ended and one.path != path:
            return Progress("busy", f"another report is being drawn: {one.path.name}")
        if one is None or one.path != path or (one.told and (one.failed or one.stamp != stamp)):
            one = self._one = _Drawing(path, stamp)
            self._work = asyncio.get_running_loop().create_task(self._draw(one))
        one.asked_ns, one.told = now_ns, one.ended
        if one.failed:
            return Progress("failed", one.failed)
        if one.packed:
            return Progress("ready", href=f"report/{path.name}")
        seconds = (now_ns - one.begun_ns) / NS_PER_S
        return Progress("drawing", percent=one.percent, seconds=round(seconds, 1))

    def drawn(self, name: str) -> bytes | None:
        """The report of the recording of this name, by gzip; None where it is not there."""
        one = self._one
        return one.packed or None if one is not None and one.path.name == name else None

    def tidy(self) -> None:
        """To be called now and then: what nobody waits for is given up, what is old forgotten."""
        one = self._one
        if one is None:
            return
        old_ns = clock.mono_ns() - one.asked_ns
        if old_ns > (KEEP_NS if one.ended else ALONE_NS):
            self.end()

    def end(self) -> None:
        """No more of it."""
        if self._work is not None:
            self._work.cancel()
        self._one = self._work = None

    async def _draw(self, one: _Drawing) -> None:
        try:
            async with asyncio.timeout(DRAW_S):
                body = await self._drawn(one)
                one.packed = await in_thread(lambda: gzip.compress(body, 6, mtime=0), None)
        except TimeoutError:
            one.failed = TOO_LONG
        except (OSError, _FailedError) as error:
            one.failed = str(error)

    async def _drawn(self, one: _Drawing) -> bytes:
        """Raises `_FailedError` with what the child says."""
        child = await asyncio.create_subprocess_exec(
            *self._command, str(one.path), stdin=DEVNULL, stdout=PIPE, stderr=PIPE,
            start_new_session=True,
        )  # fmt: skip
        try:
            _hold_down(child)
            body, said = await asyncio.gather(_body(child), _listened(child, one))
            code = await child.wait()
        finally:
            if child.returncode is None:
                child.kill()
                await child.wait()
        if code == -signal.SIGKILL:
            raise _FailedError(KILLED)
        if code:
            raise _FailedError(_why(said) or f"the program that draws it ended with {code}")
        return body


class _FailedError(Exception):
    """Why it was not drawn, in words."""


def _why(said: str) -> str:
    """What the child has said, as a sentence."""
    last = said.rpartition("\n")[2]
    if last.startswith("MemoryError"):
        return TOO_MUCH
    return last if said.startswith("Traceback") else said


def _hold_down(child: Process) -> None:
    """It takes what nobody else wants, and no more than so much of it."""
    try:
        with suppress(OSError):
            Path(f"/proc/{child.pid}/oom_score_adj").write_bytes(FIRST_TO_GO)
        os.setpriority(os.PRIO_PROCESS, child.pid, NICE)
        resource.prlimit(child.pid, resource.RLIMIT_DATA, (MEMORY, MEMORY))
    except ProcessLookupError:
        pass  # it has ended already, and says why


async def _body(child: Process) -> bytes:
    assert child.stdout is not None
    body = bytearray()
    while part := await child.stdout.read(1 << 16):
        body += part
        if len(body) > BYTES:
            raise _FailedError(TOO_BIG)
    return bytes(body)


async def _listened(child: Process, one: _Drawing) -> str:
    """A number of percent a line; anything else is why it fails."""
    assert child.stderr is not None
    said = ""
    while part := await child.stderr.read(1 << 12):
        *lines, rest = (said + part.decode(errors="replace")).split("\n")
        words = [line for line in lines if not line.isdecimal()]
        numbers = [int(line) for line in lines if line.isdecimal() and len(line) <= 3]
        one.percent = min(100, max([one.percent, *numbers]))
        said = "\n".join([*words, rest])[-SAID:]
    return said.strip().removeprefix("acsard: ")

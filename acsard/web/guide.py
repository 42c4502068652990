"""A check or a calibration that somebody goes through in his browser: the very command, as a child.

One at a time. What the child tells and asks goes to the connection that began it, and from that one
alone come answers and keys, by `--json-lines` (asking/json_lines.py). When the connection ends the
child is ended as by Ctrl-C, so that its zeros go out; it listens for us too, and does not outlive
us. Nothing waits here: an answer goes to an open question, once, or is refused.
"""

from __future__ import annotations

import asyncio
import signal
import sys
from collections.abc import Callable, Sequence

import msgspec
from msgspec import Struct

from acsard.calibration.guided.needs import NEEDS, SIMULATED
from acsard.host import clock
from acsard.host.exits import WORDS, Exit
from acsard.host.threads import in_thread
from acsard.values import NS_PER_S
from acsard.web.boards import NO_DEVICE, Board, boards
from acsard.web.calls import Ending
from acsard.web.errands import Reach, words
from acsard.web.frames import Begin, FrameError, Press, Reply
from acsard.web.told import Ended, Guided, Running

ENDING_S = 1.0
"""Whoever pressed STOP hears by then whether it has ended."""

LINE_BYTES = 65536
"""Of what the child says at once."""

LAST_BYTES = 4000
"""Of what it said to standard error."""

RELAY_NS = NS_PER_S // 20
"""So often at most it is told that the browser is heard: about twice as often as that says so
(page/guide.js), so that none of its signs is lost on the way."""

PATIENCE_S = 6.0
"""For its zeros and its end, once it was told to leave."""

CLOSING_S = 2.0
"""The same when this server ends."""

BOARDS_S = 5.0

Say = Callable[[Guided], None]


class Choices(Struct, frozen=True):
    """What may be begun."""

    ways: dict[str, str]
    """Of calibrating, and what each needs."""
    way: str
    """The one to begin with; "" is the usual one."""
    advice: str
    """Why that one, and which others there are to choose from here."""
    ports: Sequence[Board]
    note: str
    """What this server cannot do, and what to type instead."""


class _Said(Struct, frozen=True):
    """What we have to know of a line of the child's."""

    question: int = 0
    leg: bool = False
    progress: float = 0.0


class Guide:
    """What goes on, and who looks on."""

    def __init__(self, reach: Reach, configured: str) -> None:
        """`configured` is the serial port of the configuration."""
        self._reach, self._configured = reach, configured
        self._viewers: dict[object, Say] = {}
        self._errand: _Errand | None = None
        self._task: asyncio.Task[None] | None = None

    async def choices(self, *, simulated: bool) -> Choices:
        """What may be begun now, with a robot that is simulated or not."""
        found = await self._boards()
        way, advice = SIMULATED if simulated else ("", "")
        return Choices(NEEDS, way, advice, found, NO_DEVICE if len(found) == 1 else "")

    def join(self, viewer: object, say: Say) -> None:
        """He is told who goes through what; or that nobody does any more, if he was away."""
        self._viewers[viewer] = say
        say(Guided(Running("")) if self._errand is None else self._errand.about(viewer))

    def leave(self, viewer: object) -> None:
        """His connection has ended, and what he has begun ends with it."""
        self._viewers.pop(viewer, None)
        if (errand := self._of(viewer)) is not None:
            errand.leave()

    def begin(self, viewer: object, by: str, asked: Begin) -> str:
        """Start it; why not, or ""."""
        if self._errand is not None:
            return f"{self._errand.by} goes through a {self._errand.name} already; one at a time"
        self._errand = _Errand(viewer, by, asked.begin, self._viewers[viewer])
        self._tell_all()
        self._task = asyncio.get_running_loop().create_task(self._live(self._errand, asked))
        return ""

    def reply(self, viewer: object, reply: Reply) -> str:
        """Hand on an answer; why not, or ""."""
        errand = self._of(viewer)
        if errand is None or not errand.answer(reply):
            return f"no question {reply.reply} is open"
        return ""

    def press(self, viewer: object, press: Press) -> None:
        """A key, or Ctrl-C; there may be nothing any more that it would stop."""
        if (errand := self._of(viewer)) is None:
            return
        if press.press == "key":
            errand.key()
        else:
            errand.leave()

    async def stop(self) -> Ending:
        """Somebody stops the robot: whoever began what goes on, it is ended, and that is said. The
        daemon does not hear of a check: it cannot have the port."""
        if self._errand is None or self._task is None:
            return Ending()
        self._errand.leave()
        what = f"the {self._errand.name} of {self._errand.by}"
        done, _ = await asyncio.wait([self._task], timeout=ENDING_S)
        return Ending(f"{what} has ended" if done else f"{what} is being ended", bool(done))

    def heard(self, viewer: object) -> None:
        """He says something: the child hears that he is there."""
        if (errand := self._of(viewer)) is not None:
            errand.relay()

    async def close(self) -> None:
        """End what goes on; the child does not outlive us."""
        if self._task is None or self._errand is None:
            return
        self._errand.leave()
        try:
            async with asyncio.timeout(CLOSING_S):
                await asyncio.shield(self._task)
        except TimeoutError:
            self._errand.kill()
            await self._task

    def _of(self, viewer: object) -> _Errand | None:
        errand = self._errand
        return errand if errand is not None and errand.viewer is viewer else None

    async def _live(self, errand: _Errand, asked: Begin) -> None:
        try:
            code, text = await errand.run(words(asked, self._reach, await self._ports(asked)))
        except (FrameError, OSError, TimeoutError) as error:
            code, text = int(Exit.USAGE), str(error) or "the list of serial ports does not come"
        finally:
            self._errand = None
        meaning = WORDS.get(code, "ended") if not errand.left else "stopped"
        errand.say(Guided(Ended(code, meaning, text)))
        self._tell_all()

    async def _ports(self, asked: Begin) -> list[str]:
        if asked.begin != "check":
            return []
        return [one.port for one in await self._boards()]

    async def _boards(self) -> list[Board]:
        return await in_thread(lambda: boards(self._configured), BOARDS_S)

    def _tell_all(self) -> None:
        for viewer, say in self._viewers.items():
            say(self._errand.about(viewer) if self._errand else Guided(Running("")))


class _Errand:
    """One child and the connection that it is for."""

    def __init__(self, viewer: object, by: str, name: str, say: Say) -> None:
        self.viewer, self.by, self.name, self.say = viewer, by, name, say
        self.left = False
        self._process: asyncio.subprocess.Process | None = None
        self._question = 0
        """Its number, while it has no answer."""
        self._leg = self._rides = False
        self._relayed_ns = 0
        self._last = b""

    def about(self, viewer: object) -> Guided:
        """That it goes on, as this one is told."""
        return Guided(Running(self.name, self.by, viewer is self.viewer))

    async def run(self, given: Sequence[str]) -> tuple[int, str]:
        """From start to end: exit code, and its last words on standard error. Raises `OSError`."""
        if self.left:
            return int(Exit.FAILURE), ""
        # A session of its own: what is typed at our terminal reaches it by us alone, once.
        process = self._process = await asyncio.create_subprocess_exec(
            sys.executable, "-P", "-m", "acsard", *given, limit=LINE_BYTES, start_new_session=True,
            stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.PIPE,
        )  # fmt: skip
        if self.left:
            self._interrupt()
        try:
            await asyncio.gather(self._hear(process), self._overhear(process))
            code = await process.wait()
        finally:
            self.kill()
        return code if code >= 0 else 128 - code, self._words()

    def answer(self, reply: Reply) -> bool:
        """To the open question; False when that is another one."""
        if not self._question or reply.reply != self._question:
            return False
        self._question, self._rides = 0, self._leg
        self._write({"answer": reply.reply, "value": reply.value})
        return True

    def key(self) -> None:
        """As at the terminal, where a leg is driven; the first one counts."""
        if self._rides:
            self._rides = False
            self._write({"key": True})

    def relay(self) -> None:
        """Who is to stop it is heard."""
        now_ns = clock.mono_ns()
        if now_ns - self._relayed_ns >= RELAY_NS:
            self._relayed_ns = now_ns
            self._write({})

    def leave(self) -> None:
        """As Ctrl-C does, once; and for good if it does not end."""
        if self.left:
            return
        self.left = True
        if self._process is not None:
            self._interrupt()

    def kill(self) -> None:
        """At once, without its zeros."""
        if self._process is not None and self._process.returncode is None:
            self._process.kill()

    def _interrupt(self) -> None:
        assert self._process is not None
        if self._process.returncode is None:
            self._process.send_signal(signal.SIGINT)
        asyncio.get_running_loop().call_later(PATIENCE_S, self.kill)

    def _write(self, message: object) -> None:
        # Never much: an answer to each question, a key to each leg, and signs of life.
        if self._process is not None and self._process.returncode is None:
            assert self._process.stdin is not None
            self._process.stdin.write(msgspec.json.encode(message) + b"\n")

    async def _hear(self, process: asyncio.subprocess.Process) -> None:
        assert process.stdout is not None
        try:
            async for line in process.stdout:
                self._take(line)
        except ValueError:  # a line that is too long
            self.leave()
            while await process.stdout.read(4096):
                pass

    def _take(self, line: bytes) -> None:
        try:
            said = msgspec.json.decode(line, type=_Said)
        except (msgspec.MsgspecError, ValueError):
            return  # not for us: a library that prints
        if said.question:
            self._question, self._leg, self._rides = said.question, said.leg, False
        if said.progress >= 1.0:
            self._rides = False
        self.say(Guided(msgspec.Raw(line)))

    async def _overhear(self, process: asyncio.subprocess.Process) -> None:
        assert process.stderr is not None
        while said := await process.stderr.read(4096):
            self._last = (self._last + said)[-LAST_BYTES:]

    def _words(self) -> str:
        lines = self._last.decode(errors="replace").splitlines()
        if self.left and lines[-1:] == ["KeyboardInterrupt"]:
            return ""  # it was about to start
        return "\n".join(line.removeprefix("acsard: ") for line in lines).strip()

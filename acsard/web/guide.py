"""Runs a board check or a calibration for a browser, in a child process of the program `acsard`.

Only one child runs at a time. The lines that the child prints (`terminal/json_prompt.py`) go only
to the WebSocket that started the child, and only this WebSocket may answer the child's questions.
If this WebSocket ends, the server interrupts the child as Ctrl-C does, so the child still sends
zero speeds. The child also ends when this server ends, because the child watches its standard
input.
"""

from __future__ import annotations

import asyncio
import os
import re
import signal
from asyncio.subprocess import PIPE, Process
from collections.abc import Callable, Collection, Sequence

import msgspec
from msgspec import Struct

from acsard.bus.address import Address
from acsard.calibration.guided.drive_plan import NEEDS, SIMULATED
from acsard.core.config.settings import SIMULATOR
from acsard.host import clock
from acsard.host.child import acsard, how_it_ended, running
from acsard.host.errors import EXIT_TEXTS, Exit
from acsard.host.rate_limits import Bucket, Rate
from acsard.host.threads import in_thread
from acsard.machine.serial_ports import serial_devices
from acsard.web.calls import Ending
from acsard.web.socket_messages import Begin, Ended, FrameError, Guided, Press, Reply, Running

SLOW_PORTS = "listing the serial ports took too long: try again"

MAX_ERROR_BYTES = 4000
"""The error text shows at most this many bytes from the end of the child's standard error."""

END_TIMEOUT_S = 6.0
"""An interrupted child process is killed if it has not exited after this time, s. Until then the
child can send zero speeds."""

NO_DEVICE = (
    "The page's server sees no serial port. Is the board plugged in? If the server runs as a "
    "service, it has no access to devices: run `sudo systemctl stop acsard` and `acsard mcu "
    "check` in a terminal on the robot."
)

ABSENT_PORT = "configured, but it does not exist now"

KEY = re.compile(r"(?=.{1,80}\Z)[A-Za-z0-9_][A-Za-z0-9_-]*(/[A-Za-z0-9_-]+)*\Z")

Say = Callable[[Guided], None]


class Board(Struct, frozen=True):
    """A serial port and a description of the device that is connected to it."""

    port: str
    what: str


class Choices(Struct, frozen=True):
    """The checks and calibrations that the page may start."""

    methods: dict[str, str]
    """Maps each calibration method to a description of its requirements."""
    method: str
    """The recommended calibration method. If it is "", the default method is recommended."""
    advice: str
    """Text with the reason for the recommendation, and with alternatives; "" for the default."""
    ports: Sequence[Board]
    note: str
    """Advice with the commands to type if this server sees no serial port; otherwise ""."""


class _ChildLine(Struct, frozen=True):
    """The fields that this server reads in an output line of the child."""

    question: int = 0
    leg: bool = False
    progress: float = 0.0


class Guide:
    """Runs one check or calibration at a time, and tells all viewers of the page which one runs."""

    def __init__(self, address: Address, config: str, port: str) -> None:
        """Create an instance in which no check or calibration runs.

        `address` is the address of the daemon. `config` is the path of the configuration file from
        the command line, or "". `port` is the serial port in the configuration.
        """
        self._address, self._config, self._configured = address, config, port
        self._viewers: dict[object, Say] = {}
        self._job: _Job | None = None
        self._task: asyncio.Task[None] | None = None

    async def choices(self, *, simulated: bool) -> Choices:
        """Return the checks and calibrations that the page may start now.

        `simulated` says whether the page's robot is simulated. The recommended calibration method
        depends on it.
        """
        candidates = await self._boards()
        way, advice = SIMULATED if simulated else ("", "")
        sees_one = any(
            board.port != SIMULATOR and board.what != ABSENT_PORT for board in candidates
        )
        return Choices(NEEDS, way, advice, candidates, "" if sees_one else NO_DEVICE)

    def join(self, viewer: object, say: Say) -> None:
        """Add a viewer, and tell the viewer which check or calibration is running.

        If none is running, tell the viewer that too. A viewer that connects again may have missed
        the end of a check or calibration. `say` sends a message to the viewer.
        """
        self._viewers[viewer] = say
        say(Guided(Running("")) if self._job is None else self._job.about(viewer))

    def leave(self, viewer: object) -> None:
        """Remove a viewer whose connection has ended, and interrupt the child that it started."""
        self._viewers.pop(viewer, None)
        if (job := self._of(viewer)) is not None:
            job.leave()

    def begin(self, viewer: object, by: str, asked: Begin) -> str:
        """Start the check or calibration `asked` for a viewer, and return "".

        If another one is still running, return the reason for the refusal instead. `by` is the name
        of the viewer's user.
        """
        if self._job is not None:
            return (
                f"a {self._job.text} is already running (started by {self._job.by}), and "
                "only one check or calibration can run at a time: wait until it ends"
            )
        self._job = _Job(viewer, by, asked.begin, self._viewers[viewer])
        self._tell_all()
        self._task = asyncio.get_running_loop().create_task(self._run_job(self._job, asked))
        return ""

    def reply(self, viewer: object, reply: Reply) -> str:
        """Pass a viewer's answer to the child that the viewer started, and return "".

        If the child does not wait for this answer, return the reason for the refusal instead.
        """
        job = self._of(viewer)
        if job is None or not job.answer(reply):
            return (
                f"question {reply.reply} is not open on this page: answer the newest question that "
                "this page shows"
            )
        return ""

    def press(self, viewer: object, press: Press) -> None:
        """Pass a key press to the child that the viewer started, or interrupt the child.

        The field `press` of the message is "key" for the key press, and "leave" to interrupt. If
        the child has ended, do nothing.
        """
        if (job := self._of(viewer)) is None:
            return
        if press.press == "key":
            job.key()
        else:
            job.leave()

    async def stop(self) -> Ending:
        """Interrupt the running check or calibration, and wait up to 1 s for its end.

        The result says whether it has ended.

        Call this whenever any client stops the robot. The daemon alone cannot stop the wheels
        during a check, because the check has opened the serial port in place of the daemon.
        """
        if self._job is None or self._task is None:
            return Ending()
        self._job.leave()
        what = f"the {self._job.text} started by {self._job.by}"
        done, _ = await asyncio.wait([self._task], timeout=1.0)
        return Ending(f"{what} has ended" if done else f"{what} is being ended", bool(done))

    def on_message(self, viewer: object) -> None:
        """Send a sign of life to the child that the viewer started.

        Call this for each message of a viewer. While the robot may move, the child ends if no sign
        of life arrives for some time.
        """
        if (job := self._of(viewer)) is not None:
            job.relay()

    async def close(self) -> None:
        """Interrupt the running child, and kill it if it does not exit within 2 s."""
        if self._task is None or self._job is None:
            return
        self._job.leave()
        try:
            async with asyncio.timeout(2.0):
                await asyncio.shield(self._task)
        except TimeoutError:
            self._job.kill()
            await self._task

    def _of(self, viewer: object) -> _Job | None:
        job = self._job
        return job if job is not None and job.viewer is viewer else None

    async def _run_job(self, job: _Job, asked: Begin) -> None:
        try:
            ports = await self._boards() if asked.begin == "check" else []
            allowed = [board.port for board in ports]
            code, text = await job.run(arguments(asked, self._address, self._config, allowed))
        # Python raises `RuntimeError` if it cannot start a thread for the child process.
        except (FrameError, OSError, TimeoutError, RuntimeError) as error:
            code, text = Exit.USAGE, str(error) or SLOW_PORTS
        finally:
            self._job = None
        meaning = "stopped" if job.left else EXIT_TEXTS.get(code) or how_it_ended(code)
        job.say(Guided(Ended(code if code >= 0 else 128 - code, meaning, text)))
        self._tell_all()

    async def _boards(self) -> list[Board]:
        return await in_thread(lambda: boards(self._configured), 5.0)

    def _tell_all(self) -> None:
        for viewer, say in self._viewers.items():
            say(self._job.about(viewer) if self._job else Guided(Running("")))


def boards(configured: str) -> list[Board]:
    """Return the serial ports and the simulator, from which the user chooses for a board check.

    `configured` is the port in the configuration. It comes first in the result, even if it does not
    exist now. Call this function in a thread, because it blocks.
    """
    texts: dict[str, str] = {}
    for device in serial_devices():
        name = device.names[0] if device.names else device.device
        own = configured in (device.device, *device.names)
        notes = [device.board or device.description, "configured" if own else ""]
        notes += [f"in use by {holder.name} (process {holder.pid})" for holder in device.holders]
        texts[configured if own else name] = ", ".join(filter(None, notes))
    if configured != SIMULATOR and configured not in texts:
        texts = {configured: "configured" if os.path.exists(configured) else ABSENT_PORT, **texts}
    texts[SIMULATOR] = "the simulator: no real robot moves"
    # The wheels turn during a check, so the configured port comes first: an operator who does not
    # read the list must check the board of this robot.
    ports = sorted(texts, key=lambda port: port != configured)
    return [Board(port, texts[port]) for port in ports]


def arguments(begin: Begin, address: Address, file: str, ports: Collection[str]) -> list[str]:
    """Return the arguments with which `acsard` runs the check or calibration `begin`.

    A text from the browser becomes only the value of an option, so a browser cannot add options.
    `address` is the address of the daemon, for a calibration. `file` is the configuration file, or
    "". `ports` are the ports that a check may use. Raises `FrameError` if a value in `begin` is not
    permitted.
    """
    config = [f"--config={file}"] if file else []
    if begin.begin == "check":
        if begin.method or begin.positions:
            raise FrameError("begin", "`method` and `positions` are only for a calibration")
        if begin.port not in ports:
            raise FrameError("begin", f"port must be one of {', '.join(sorted(ports))}")
        return ["mcu", "check", "--json-lines", *config, f"--port={begin.port}"]
    if begin.port:
        raise FrameError("begin", "`port` is only for a check of the board, not for a calibration")
    options = [f"--connect={address.endpoint}", f"--id={address.robot_id}"]
    if address.tls:
        options.append(f"--tls={address.tls}")
    return ["calibrate", "--json-lines", *config, *options, *_method(begin)]


def _method(begin: Begin) -> list[str]:
    if begin.method and begin.method not in NEEDS:
        raise FrameError("begin", f"method must be one of {', '.join(NEEDS)}")
    if (begin.method == "positions") != bool(begin.positions):
        raise FrameError(
            "begin",
            "the method positions needs `positions`, a Zenoh key; no other method uses it",
        )
    if begin.positions and not KEY.match(begin.positions):
        raise FrameError(
            "begin", "`positions` must be a Zenoh key of letters, digits, `_`, `-` and `/`"
        )
    options = {"method": begin.method, "positions": begin.positions}
    return [f"--{name}={value}" for name, value in options.items() if value]


class _Job:
    """A check or calibration in a child process, and the WebSocket that started it."""

    def __init__(self, viewer: object, by: str, name: str, say: Say) -> None:
        self.viewer, self.by, self.name, self.say = viewer, by, name, say
        self.left = False
        self._process: Process | None = None
        self._question = 0
        """Number of the child's unanswered question; 0 if every question is answered."""
        self._leg = self._drive_running = False
        # The browser sends signs of life at about half this rate (page/guide.js), so none is lost.
        self._relayed = Bucket(Rate(20.0))
        self._last = b""

    @property
    def text(self) -> str:
        return "calibration" if self.name == "calibrate" else self.name

    def about(self, viewer: object) -> Guided:
        return Guided(Running(self.name, self.by, viewer is self.viewer))

    async def run(self, options: Sequence[str]) -> tuple[int, str]:
        """Run `acsard` with the arguments `options`, and return the pair (exit code, error output).

        If a signal ended the child, the exit code is the negative number of the signal. Raises
        `OSError` if the child cannot be started.
        """
        if self.left:
            return Exit.FAILURE, ""
        async with running(acsard(*options), stdin=PIPE, stdout=PIPE, stderr=PIPE) as process:
            self._process = process
            if self.left:
                self._interrupt()
            await asyncio.gather(self._read_output(process), self._read_errors(process))
            code = await process.wait()
        return code, self._error_text()

    def answer(self, reply: Reply) -> bool:
        if not self._question or reply.reply != self._question:
            return False
        self._question, self._drive_running = 0, self._leg
        self._write({"answer": reply.reply, "value": reply.value})
        return True

    def key(self) -> None:
        """Tell the child that the user pressed a key, to end the present drive of a calibration.

        Do nothing if no such drive is running.
        """
        if self._drive_running:
            self._drive_running = False
            self._write({"key": True})

    def relay(self) -> None:
        """Tell the child that the user's browser can still interrupt it (a sign of life)."""
        if self._relayed.take(clock.mono_ns()):
            self._write({})

    def leave(self) -> None:
        """Interrupt the child as Ctrl-C does. Kill the child if it does not exit in time."""
        if self.left:
            return
        self.left = True
        if self._process is not None:
            self._interrupt()

    def kill(self) -> None:
        """Kill the child without letting it send zero speeds."""
        if self._process is not None and self._process.returncode is None:
            self._process.kill()

    def _interrupt(self) -> None:
        assert self._process is not None
        if self._process.returncode is None:
            self._process.send_signal(signal.SIGINT)
        asyncio.get_running_loop().call_later(END_TIMEOUT_S, self.kill)

    def _write(self, message: object) -> None:
        # No flow control is needed, because the messages are few and small.
        if self._process is not None and self._process.returncode is None:
            assert self._process.stdin is not None
            self._process.stdin.write(msgspec.json.encode(message) + b"\n")

    async def _read_output(self, process: Process) -> None:
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
            message = msgspec.json.decode(line, type=_ChildLine)
        except (msgspec.MsgspecError, ValueError):
            return  # not a protocol line: a library printed it
        if message.question:
            self._question, self._leg, self._drive_running = message.question, message.leg, False
        if message.progress >= 1.0:
            self._drive_running = False
        self.say(Guided(msgspec.Raw(line)))

    async def _read_errors(self, process: Process) -> None:
        assert process.stderr is not None
        while chunk := await process.stderr.read(4096):
            self._last = last_part(self._last + chunk)

    def _error_text(self) -> str:
        lines = self._last.decode(errors="replace").splitlines()
        if self.left and lines[-1:] == ["KeyboardInterrupt"]:
            return ""  # interrupted while the interpreter was starting
        return "\n".join(line.removeprefix("acsard: ") for line in lines).strip()


def last_part(output: bytes) -> bytes:
    """Return the last complete lines of `output`, with at most `MAX_ERROR_BYTES` in total.

    If the last line alone is longer, return its last characters.
    """
    tail = output[-MAX_ERROR_BYTES:]
    if len(output) <= MAX_ERROR_BYTES:
        return tail
    # These values are the bytes after the first byte of a UTF-8 character.
    return tail.partition(b"\n")[2] or tail.lstrip(bytes(range(0x80, 0xC0)))

"""A robot as any program sees it: processes, a board on a serial line, and a client of the bus.

This module imports nothing of acsard. The tests see only what any program sees: the wire, the bus
and the shell. Every wait ends as soon as its condition holds, or fails at a deadline that a busy
machine can meet. Every process is ended by its own pid.

    with Peer(tmp_path / "mcu") as board, running(tmp_path, board.path) as (daemon, bus):
        with bus.follow("state") as states, bus.commanding(0.3):
            states.find(lambda state: state["mode"] == "driving", 2.0, "it drives")
        bus.at_rest()
        assert board.lines[-1].line == ZERO_LINE

- Waiting: `until(look, within, what)`; `Following.find` waits for a message; `Program.says` for a
  line of output. Never sleep for an event.
- Processes: `Program` (any), `Daemon` (`acsard run` with its own configuration, address and latch
  file), `finish` (to its end), `acsard(...)` (a command line). `typed.py` runs a command in the
  test's process.
- The board: `Peer` is in the test's process, `FarPeer` has a process and reliable times. Both keep
  each line and its time. `Peer.unplug`, `plug`, `deaf` and `reply` are its faults.
- The bus: `Bus` puts JSON (`put`), asks (`ask` for all replies, `get` for the one), follows
  keys (`follow`), and waits for the robot (`linked`, `at_rest`, `stands`, `comes_to`).
  `Bus.commanding` drives; `repeated` sends anything 20 times a second.
- A busy machine: compare a time with `bystander.lost(since)`, which this machine lost meanwhile,
  and with `kept_waiting(pid)`, which the threads of a process waited for a core. `broken` says
  whether the link was lost although no test cut it; `Periods` counts control periods.
- `shared` and `bus` in `conftest.py` are one robot for all tests of a module, for tests that leave
  it at rest. A module's `CONFIG` is its configuration.
"""

from __future__ import annotations

import atexit
import bisect
import functools
import itertools
import json
import os
import pty
import secrets
import select
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import tty
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple, Self, TypeVar

import msgspec
import zenoh

T = TypeVar("T")

ROOT = Path(__file__).resolve().parents[2]

START_S = 15.0
"""A start takes 0.2 s; this limit is for a machine that is busy with other work."""

PATIENCE_S = 15.0
"""The extra time that every wait gives a busy machine, beyond the time on an idle one.

A wait measures nothing: tests compare durations with `bystander.lost`.
"""

END_S = 5.0
"""A daemon that has not ended by then is killed, and the test fails by its exit code."""

BUSY_ENCODING = "text/plain;busy"
"""Of the reply of a daemon that has too many open queries: ask again."""

ZERO_LINE = b"ap00.00,bp00.00,cp00.00,dp00.00\r\n"

ZERO = {"linear": {"x": 0.0}, "angular": {"z": 0.0}}


def until(look: Callable[[], T | None], within: float = 10.0, what: str = "") -> T:
    """Call `look` repeatedly until it returns a true value, and return that value.

    Fails after `within` seconds with a message that contains `what`.
    """
    deadline, pause = time.monotonic() + within + PATIENCE_S, 0.005
    while not (result := look()):
        if time.monotonic() > deadline:
            raise AssertionError(f"not in {within + PATIENCE_S:g} s: {what}")
        time.sleep(pause)
        pause = min(1.2 * pause, 0.03)  # most looks ask the daemon, which costs both a millisecond
    return result


def twist(linear: float, angular: float = 0.0) -> dict[str, dict[str, float]]:
    """Return a twist as plain values. `linear` is in m/s, `angular` in rad/s."""
    return {"linear": {"x": linear}, "angular": {"z": angular}}


def free_endpoint() -> str:
    """Return a loopback address on which no program listens, another one at each call."""
    while True:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            port = probe.getsockname()[1]
        if port not in _given_ports:
            _given_ports.add(port)
            return f"tcp/127.0.0.1:{port}"


# The kernel may choose the port of a closed socket again.
_given_ports = set[int]()


def environment(**more: str) -> dict[str, str]:
    """Return the environment for a program, without the settings of this test run."""
    hidden = ("INVOCATION_ID", "ACSARD_CONFIG", "ACSARD_RECORD", "RUST_LOG", "STATE_DIRECTORY")
    env = {key: value for key, value in os.environ.items() if key not in hidden}
    paths = [str(ROOT), *filter(None, [env.get("PYTHONPATH")])]
    env |= {"PYTHONPATH": os.pathsep.join(paths), "PYTHONUNBUFFERED": "1"}
    return env | {"XDG_STATE_HOME": _states()} | more


@functools.cache
def _states() -> str:
    """Create a directory for the latch files, so that no test stops a real robot."""
    where = tempfile.mkdtemp(prefix="acsard-tests-")
    atexit.register(shutil.rmtree, where, ignore_errors=True)
    return where


# processes


def children(pid: int, words: str) -> list[int]:
    """Return the pids of a process's children whose command line contains these words."""
    born = [file.read_text().split() for file in Path(f"/proc/{pid}/task").glob("*/children")]
    pids = []
    for child in itertools.chain.from_iterable(born):
        try:
            line = Path(f"/proc/{child}/cmdline").read_text().replace("\0", " ")
        except OSError:
            continue  # it has ended meanwhile
        if words in line:
            pids.append(int(child))
    return pids


class Program:
    """A process that runs while the object is entered. Its output is collected meanwhile."""

    def __init__(
        self,
        words: Sequence[str],
        cwd: Path | str,
        env: Mapping[str, str] | None = None,
        **how: Any,
    ) -> None:
        self.words = list(words)
        self._how: dict[str, Any] = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE}
        self._how |= {"stderr": subprocess.PIPE, "cwd": str(cwd), "env": env or environment()}
        self._how |= how
        self.started = 0.0
        self.out: list[str] = []
        self.err: list[str] = []
        self._readers: list[threading.Thread] = []
        self._end_by = signal.SIGTERM

    def __enter__(self) -> Self:
        self.started = time.monotonic()
        self.process: subprocess.Popen[bytes] = subprocess.Popen(self.words, **self._how)
        for stream, lines in ((self.process.stdout, self.out), (self.process.stderr, self.err)):
            if stream is not None:
                reader = threading.Thread(target=_collect, args=(stream, lines), daemon=True)
                reader.start()
                self._readers.append(reader)
        return self

    def __exit__(self, *error: object) -> None:
        process = self.process
        if process.poll() is None:
            process.send_signal(self._end_by)
            try:
                process.wait(END_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait(END_S)
        for reader in self._readers:
            reader.join(END_S)

    @property
    def pid(self) -> int:
        return self.process.pid

    @property
    def stderr(self) -> str:
        return "\n".join(self.err)

    @property
    def stdout(self) -> str:
        return "\n".join(self.out)

    def signal(self, number: signal.Signals) -> None:
        self.process.send_signal(number)

    def ended(self, within: float) -> int:
        """Return the exit code. Fails if the process does not end in time."""
        try:
            code = self.process.wait(within + PATIENCE_S)
        except subprocess.TimeoutExpired:
            raise AssertionError(f"{self.words} still runs after {within:g} s\n{self}") from None
        for reader in self._readers:
            reader.join(END_S)
        return code

    def says(self, text: str, within: float = START_S) -> str:
        """Return the first line on standard output that contains `text`."""

        def look() -> str | None:
            result = next((line for line in list(self.out) if text in line), None)
            if result is None and self.process.poll() is not None:
                for reader in self._readers:
                    reader.join(END_S)
                if not any(text in line for line in self.out):
                    raise AssertionError(f"ended with {self.process.returncode}\n{self}")
            return result

        return until(look, within, f"{text!r} from {self.words}\n{self}")

    def __str__(self) -> str:
        return f"--- stdout\n{self.stdout}\n--- stderr\n{self.stderr}"


P = TypeVar("P", bound=Program)


def _collect(stream: Any, lines: list[str]) -> None:
    with stream:
        for line in stream:
            lines.append(line.decode(errors="replace").rstrip("\n"))


def acsard(*words: str) -> list[str]:
    """Return the command line of `acsard` with these arguments."""
    return [sys.executable, "-m", "acsard", *words]


class Finished(NamedTuple):
    """The result of a program that was run to its end."""

    code: int
    out: str
    err: str
    seconds: float


def finish(
    words: Sequence[str],
    cwd: Path | str,
    within: float = 20.0,
    env: Mapping[str, str] | None = None,
) -> Finished:
    """Run a program to its end."""
    with Program(words, cwd, env) as program:
        code = program.ended(within)
        seconds = time.monotonic() - program.started
    return Finished(code, program.stdout, program.stderr, seconds)


Tables = Mapping[str, Mapping[str, object]]


TWO_WHEELS: Tables = {"mcu.wheels": {"left": "+l", "right": "+r"}}
"""Configuration of a robot with two driven wheels."""


def write_config(path: Path, tables: Tables) -> Path:
    """Write a TOML file. Its values are written as JSON, which is the same for these types."""
    lines = []
    for name, table in tables.items():
        lines += [f"[{name}]", *(f"{key} = {json.dumps(value)}" for key, value in table.items())]
    path.write_text("\n".join(lines) + "\n")
    return path


class Daemon(Program):
    """`acsard run` with its own configuration and bus address.

    Entering the object waits until the daemon is ready, unless `ready` is False.
    """

    def __init__(
        self,
        where: Path,
        port: Path | str = "sim",
        config: Tables | None = None,
        *,
        name: str = "daemon",
        endpoint: str = "",
        ready: bool = True,
        words: Sequence[str] = (),
        shell: str = "",
        before: Sequence[str] = (),
        **how: Any,
    ) -> None:
        self.endpoint = endpoint or free_endpoint()
        tables = {table: dict(values) for table, values in (config or {}).items()}
        tables.setdefault("mcu", {}).setdefault("port", str(port))
        tables.setdefault("bus", {}).setdefault("listen", [self.endpoint])
        self.states = where / f"{name}.states"
        """Directory of the latch file. The next daemon of this name starts with its latches."""
        tables.setdefault("control", {}).setdefault("state_directory", str(self.states))
        self.config = write_config(where / f"{name}.toml", tables)
        self._ready = ready
        listens = tables["bus"].get("mode") != "client"
        self._has_gateway = listens and "'tls/" in str(tables["bus"]["listen"])
        run = [*before, *acsard("run", "--config", str(self.config), *words)]
        if shell:
            run = ["sh", "-c", f'exec "$@" {shell}', "sh", *run]
        super().__init__(run, where, **how)
        # A shutdown takes 0.3 s. The tests of the shutdown send the signal themselves.
        self._end_by = signal.SIGKILL

    def __enter__(self) -> Daemon:
        super().__enter__()
        if self._ready:
            try:
                self.says("bus ")
                if self._has_gateway:
                    self.gateway_opens()
            except BaseException:
                self.__exit__()
                raise
        return self

    def gateway_opens(self, times: int = 1) -> None:
        """Wait until the TLS gateway has opened this number of times."""
        until(
            lambda: sum("gateway_open" in line for line in list(self.err)) >= times,
            START_S,
            f"the gateway opens\n{self}",
        )

    def events(self, name: str) -> list[dict[str, Any]]:
        """Return the log lines of one event so far."""
        entries = [json.loads(line) for line in list(self.err) if line.startswith("{")]
        return [event for event in entries if event["event"] == name]


# the kernel's figures for a process


def resident_kb(pid: int) -> int:
    """Return the resident memory of a process in kB."""
    status = Path(f"/proc/{pid}/status").read_text()
    return int(status.partition("VmRSS:")[2].split()[0])


def cpu_seconds(pid: int) -> float:
    """Return the processor time of all threads of a process so far, s."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


# the independent microcontroller

Speeds = tuple[float, float, float, float]

STANDING = (0.0, 0.0, 0.0, 0.0)
Reply = Callable[[Speeds], bytes]


def plain_reply(speeds: Speeds) -> bytes:
    """Return the reply that reports the requested speeds, as MCU.md section 1 has it."""
    tokens = [
        f"{motor}{'n' if speed < 0 else 'p'}{abs(speed):05.2f}"
        for motor, speed in zip("abcd", speeds, strict=True)
    ]
    return (",".join(tokens) + "\r\n").encode()


def silence(speeds: Speeds) -> bytes:
    """Return no reply, like a board that receives everything and answers nothing."""
    return b""


class ReceivedLine(NamedTuple):
    """A line as it arrived, and the time of arrival."""

    at: float
    line: bytes


class Session:
    """Everything that arrived over one pty."""

    def __init__(self) -> None:
        self.plugged = time.monotonic()
        self.raw: list[ReceivedLine] = []
        self.lines: list[ReceivedLine] = []

    @property
    def stream(self) -> bytes:
        return b"".join(piece.line for piece in list(self.raw))

    def raw_lines(self) -> list[bytes]:
        """Return the lines without their times."""
        return [entry.line for entry in list(self.lines)]


class Peer:
    """A simulated board at the other end of a pty, independent of acsard's simulator.

    It records every byte and answers each command line. While it is plugged in, `path` is a
    symbolic link to the pty, as udev creates it.
    """

    def __init__(self, path: Path, reply: Reply = plain_reply) -> None:
        self.path = path
        self.reply = reply
        self.sessions: list[Session] = []
        self._ends: tuple[int, int] | None = None
        self._thread: threading.Thread | None = None
        self._leave = threading.Event()
        self._listens = threading.Event()
        self._listens.set()
        self._idle = 0

    @property
    def session(self) -> Session:
        return self.sessions[-1]

    @property
    def lines(self) -> list[ReceivedLine]:
        return list(self.session.lines)

    def __enter__(self) -> Peer:
        self.plug()
        return self

    def __exit__(self, *error: object) -> None:
        if self._ends is not None:
            self.unplug()

    def plug(self) -> None:
        """Plug the board in: open a new pty and link it at `path`."""
        master, slave = pty.openpty()
        tty.setraw(slave)
        os.set_blocking(master, False)
        self._ends = master, slave
        self.sessions.append(Session())
        self._leave.clear()
        self._thread = threading.Thread(target=self._serve, args=(master, self.session))
        self._thread.start()
        self.path.symlink_to(os.ttyname(slave))

    def unplug(self) -> float:
        """Pull the cable, and return the time."""
        assert self._ends is not None
        assert self._thread is not None
        # Remove the link first: the kernel gives the number of a closed pty to the next program
        # that opens one.
        self.path.unlink()
        self._leave.set()
        self._thread.join()
        for end in self._ends:
            os.close(end)
        self._ends = None
        return time.monotonic()

    @contextmanager
    def deaf(self) -> Iterator[None]:
        """Read nothing while the body runs, so that the bytes stay in the kernel."""
        self._listens.clear()
        idle = self._idle
        until(lambda: self._idle > idle, 5.0, "it has stopped to listen")
        try:
            yield
        finally:
            self._listens.set()

    def send(self, data: bytes) -> None:
        """Send bytes without being asked."""
        assert self._ends is not None
        os.write(self._ends[0], data)

    def await_lines(self, count: int, within: float = 5.0) -> list[ReceivedLine]:
        """Wait for the next `count` lines from now on."""
        start = len(self.session.lines)
        until(lambda: len(self.lines) >= start + count, within, f"{count} lines on the wire")
        return self.lines[start : start + count]

    def last_line(self) -> bytes:
        """Wait until no more output of the ended daemon arrives, and return its last line."""
        idle = self._idle
        until(lambda: self._idle > idle, 5.0, "the line falls silent")
        return self.session.raw_lines()[-1]

    def _serve(self, master: int, session: Session) -> None:
        buffer, turning, target = b"", STANDING, STANDING
        while not self._leave.is_set():
            if not self._listens.is_set():
                self._idle += 1
                self._listens.wait(0.01)
                continue
            if not select.select([master], [], [], 0.05)[0]:
                self._idle += 1
                continue
            data = os.read(master, 4096)
            now = time.monotonic()
            session.raw.append(ReceivedLine(now, data))
            *lines, buffer = (buffer + data).split(b"\n")
            for line in lines:
                if line.rstrip(b"\r") != b"?":  # a question moves nothing
                    session.lines.append(ReceivedLine(now, line + b"\n"))
                speeds = _speeds(line)
                if speeds is not None:
                    # Replies that equal the command lines would look like an echo, so the wheels
                    # lag.
                    a, b, c, d = ((old + two) / 2 for old, two in zip(turning, target, strict=True))
                    answer, turning, target = self.reply((a, b, c, d)), target, speeds
                    if answer:
                        os.write(master, answer)


FAR = """\
import fcntl, grp, os, pty, sys, termios, time, tty
try:
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(50))
except OSError:
    pass  # not root: its times are as good as the machine is idle
path, lies = sys.argv[1:]
master, slave = pty.openpty()
name = os.ttyname(slave)
tty.setraw(slave)
if lies:
    os.chown(slave, 0, grp.getgrnam("dialout").gr_gid)
    os.chmod(slave, 0o660)
    os.close(slave)
os.symlink(name, path)
print("plugged", flush=True)
held, turning, told = b"", b"", b""
while True:
    try:
        data = os.read(master, 4096)
    except OSError:
        # Like a real port, forget the exclusive lock when no program has the port open any more.
        slave = os.open(name, os.O_RDWR | os.O_NOCTTY)
        fcntl.ioctl(slave, termios.TIOCNXCL)
        os.close(slave)
        time.sleep(0.001)
        continue
    now = time.monotonic()
    *lines, held = (held + data).split(b"\\n")
    for line in lines:
        if line.startswith(b"a"):
            # Replies that equal the lines would be an echo: wheel a turns a little otherwise.
            says = turning or line
            if says.strip(b"abcdpn0.,\\r"):
                says = says[:6] + (b"1" if says[6:7] == b"0" else b"0") + says[7:]
            if lies and os.path.exists(lies):
                says = b"ap99.00,bp99.00,cp99.00,dp99.00\\r"
            turning, told = told, line
            os.write(master, says + b"\\n")
        print(repr(now), line.decode(errors="replace").strip("? \\r") or "-", flush=True)
"""
"""The program of a `FarPeer`.

Its arguments are the path of its port, and "" or a file. With a file, the port has the group and
the mode of a real one. While the file exists, the board reports speeds that no wheel can have.
"""


class FarPeer(Program):
    """A simulated board in a separate process with a real-time priority.

    Its times are reliable, because neither the load of this test run nor Python's interpreter lock
    delays it. It answers each command with the speeds of the command before the previous one. To
    differ from an echo, the speed of wheel a is wrong by 0.01 to 0.09.
    """

    def __init__(self, where: Path, name: str = "far_mcu") -> None:
        self.path = where / name
        self._heard: list[ReceivedLine] = []
        super().__init__([sys.executable, "-c", FAR, str(self.path), ""], where)

    def __enter__(self) -> Self:
        super().__enter__()
        self.says("plugged")
        return self

    @property
    def lines(self) -> list[ReceivedLine]:
        """Return all lines so far, without their ends; "-" is an empty one or a question."""
        return list(self._all())

    def since(self, at: float) -> list[ReceivedLine]:
        """Return the lines that came after this time."""
        lines = self._all()
        return lines[bisect.bisect_right(lines, at, key=lambda h: h.at) :]

    def _all(self) -> list[ReceivedLine]:
        for text in self.out[1 + len(self._heard) :]:
            at, _, line = text.partition(" ")
            self._heard.append(ReceivedLine(float(at), line.encode()))
        return self._heard

    def awaits(self, line: bytes, within: float = 5.0, after: float = 0.0) -> ReceivedLine:
        """Wait for a line that begins with `line` and arrives after `after`, and return it."""
        return until(
            lambda: next((h for h in self.since(after) if h.line.startswith(line)), None),
            within,
            f"{line!r} on the wire",
        )


def _speeds(line: bytes) -> Speeds | None:
    """Return the motor speeds that a command line requests, or None if it is not a command."""
    try:
        tokens = line.decode().strip().rstrip(",").split(",")
        values = [float(token[2:]) * {"p": 1, "n": -1}[token[1]] for token in tokens]
        a, b, c, d = values if [token[0] for token in tokens] == list("abcd") else []
    except (ValueError, KeyError, IndexError):
        return None
    return a, b, c, d


def wheels(line: bytes) -> Speeds:
    """Return the four speeds of a line. Fails if it is not a command."""
    speeds = _speeds(line)
    assert speeds is not None, line
    return speeds


# the bus


def client_config(endpoint: str, mode: str = "client") -> zenoh.Config:
    """Return the Zenoh settings of a session that connects only to this address.

    A router listens at the address instead.
    """
    config = zenoh.Config()
    config.insert_json5("mode", json.dumps(mode))
    config.insert_json5("scouting/multicast/enabled", "false")
    role = "listen" if mode == "router" else "connect"
    config.insert_json5(f"{role}/endpoints", json.dumps([endpoint]))
    return config


def read(sample: zenoh.Sample) -> Any:
    """Decode a payload from JSON or msgpack, and return plain values."""
    data = sample.payload.to_bytes()
    form = msgspec.json if data.startswith(b"{") else msgspec.msgpack
    try:
        return form.decode(data)
    except msgspec.DecodeError:
        return data  # somebody else's: the daemon publishes no such message


class ReceivedMessage(NamedTuple):
    """A message, its encoding and its time of arrival."""

    at: float
    value: Any
    encoding: str


class Following:
    """Collects the messages that arrive on a key."""

    def __init__(self) -> None:
        self.seen: list[ReceivedMessage] = []
        self._news = threading.Condition()

    def add(self, sample: zenoh.Sample) -> None:
        """Store a sample. Zenoh calls this function."""
        entry = ReceivedMessage(time.monotonic(), read(sample), str(sample.encoding))
        with self._news:
            self.seen.append(entry)
            self._news.notify_all()

    def find(
        self, wanted: Callable[[Any], bool], within: float, what: str, after: float = 0.0
    ) -> ReceivedMessage:
        """Return the first message that is `wanted` and arrived after the time `after`."""
        deadline, looked = time.monotonic() + within + PATIENCE_S, 0
        with self._news:
            while True:
                for entry in self.seen[looked:]:
                    if entry.at >= after and wanted(entry.value):
                        return entry
                looked = len(self.seen)
                left = deadline - time.monotonic()
                if left <= 0 or not self._news.wait(left):
                    last = self.seen[-1].value if self.seen else None
                    raise AssertionError(f"not in {within + PATIENCE_S:g} s: {what}; last: {last}")


def broken(states: Following, since: float, to: float = float("inf")) -> bool:
    """Return whether the link was lost in this time, although no test interrupted it.

    On a busy machine the board, or the kernel's thread for its pty, may have to wait. The robot
    then stops correctly, and the test learns nothing from its behaviour.
    """
    return any(since <= entry.at <= to and entry.value["link"] != "up" for entry in states.seen)


class Answered(NamedTuple):
    """One reply to a query."""

    key: str
    ok: bool
    encoding: str
    payload: bytes


class Bus:
    """A plain Zenoh client of one robot."""

    def __init__(self, endpoint: str, robot_id: str = "acsar") -> None:
        self.session = zenoh.open(client_config(endpoint))
        self.root = f"acsard/{robot_id}"

    def __enter__(self) -> Bus:
        return self

    def __exit__(self, *error: object) -> None:
        self.session.close()

    def put(self, key: str, value: object, sender: str = "", indent: int = 0) -> None:
        """Put JSON without an encoding, as a minimal client does. `sender` is an optional id."""
        attachment = json.dumps({"sender": sender}) if sender else None
        payload = json.dumps(value, indent=indent or None)
        self.session.put(f"{self.root}/{key}", payload, attachment=attachment)

    def payload(self, key: str, payload: object) -> str | None:
        """Return the payload of a query as JSON.

        A `clear` or `activate` without a payload gets the numbers of the present causes.
        """
        if key in ("srv/clear", "srv/activate") and payload is None:
            states = self.ask("state")
            assert all(answer.ok for answer in states), f"the query of {self.root}/state: {states}"
            causes = json.loads(states[0].payload)["causes"] if states else []
            payload = {"numbers": [cause["number"] for cause in causes]} if states else None
        return None if payload is None else json.dumps(payload)

    def ask(self, key: str, payload: object = None) -> list[Answered]:
        """Return all replies to a query.

        A `clear` or `activate` names the causes in `state`, as acsard's tools do.
        """
        data = self.payload(key, payload)
        answers = []
        for reply in self.session.get(f"{self.root}/{key}", payload=data, timeout=5.0):
            if reply.ok is not None:
                sample, where = reply.ok, str(reply.ok.key_expr).removeprefix(self.root + "/")
                encoding, payload_bytes = str(sample.encoding), sample.payload.to_bytes()
                answers.append(Answered(where, True, encoding, payload_bytes))
            elif reply.err is not None:
                text = reply.err.payload.to_bytes()
                answers.append(Answered("", False, str(reply.err.encoding), text))
        return answers

    def get(self, key: str, payload: object = None) -> Any:
        """Return the one JSON reply to a query.

        Asks again if the daemon says that it is overloaded.
        """
        deadline = time.monotonic() + 5.0
        answers = self.ask(key, payload)
        busy = [BUSY_ENCODING]
        while [answer.encoding for answer in answers] == busy and time.monotonic() < deadline:
            time.sleep(0.02)
            answers = self.ask(key, payload)
        assert len(answers) == 1, f"{key}: {answers}"
        assert answers[0].ok, f"{key}: {answers[0]}"
        return json.loads(answers[0].payload)

    def state(self) -> Any:
        return self.get("state")

    def count(self, name: str) -> int:
        """Return a counter of `state`, or 0 before it first counts."""
        return int(self.state()["counters"].get(name, 0))

    @contextmanager
    def follow(self, key: str) -> Iterator[Following]:
        """Subscribe to a key while the body runs. The daemon knows the subscription by then."""
        following = Following()
        subscriber = self.session.declare_subscriber(f"{self.root}/{key}", following.add)
        # Messages on one link arrive in order. An answer received now follows the subscription.
        self.ask("info")
        try:
            yield following
        finally:
            subscriber.undeclare()

    def linked(self, within: float = 5.0) -> None:
        """Wait until the link to the board is up."""
        with self.follow("state") as states:
            states.find(lambda state: state["link"] == "up", within, "link up")

    def comes_to(self, *modes: str) -> Any:
        """Return the state, and check that it has one of these modes.

        If a busy machine has interrupted the link, this function first waits until the link is up
        again.
        """

        def look() -> Any:
            state = self.state()
            return state if state["mode"] in modes or state["link"] == "up" else None

        state = until(look, 5.0, "link up")
        assert state["mode"] in modes, state
        return state

    def stands(self, within: float = 5.0) -> Any:
        """Wait until no wheel turns. Return the state.

        The mode may still be `driving`, because a client repeats its zero.
        """

        def look() -> Any:
            state = self.state()
            return state if state["wheels"] and not any(state["wheels"]) else None

        return until(look, within, "that no wheel turns")

    def at_rest(self, within: float = 5.0) -> Any:
        """Wait until the robot is ready and its wheels do not turn. Return the state."""

        def look() -> Any:
            state = self.state()
            return state if state["mode"] == "ready" and set(state["wheels"]) == {0.0} else None

        return until(look, within, "at rest")

    @staticmethod
    def _waits_for(state: Any, source: str) -> str:
        return next((s["waits_for"] for s in state["sources"] if s["name"] == source), "")

    @contextmanager
    def commanding(
        self,
        linear: float,
        angular: float = 0.0,
        *,
        source: str = "app",
        certificate: str = "",
    ) -> Iterator[Commander]:
        """Send commands at 20 Hz while the body runs. A zero comes first."""
        key = "/".join(filter(None, ("cmd", source, certificate)))
        commander = Commander(self, key, linear, angular)
        before, said = self.count("commands"), 0.0

        def heard() -> bool:
            nonlocal said
            # A sender that is stamped on the way, for example by a router, must show its delays
            # first. A message that arrives within a millisecond of another one is dropped.
            state = self.state()
            counters, waits = state["counters"], self._waits_for(state, source)
            neutral = waits.startswith("send a zero first")
            if neutral or counters.get("commands_of_new_senders") or time.monotonic() > said + 0.5:
                self.put(commander.key, ZERO, commander.sender)
                said = time.monotonic()
            return not neutral and counters.get("commands", 0) > before

        until(heard, 5.0, "the zero was received")
        with commander.sending():
            yield commander


@contextmanager
def repeated(send: Callable[[], object]) -> Iterator[Callable[[], object]]:
    """Call `send` 20 times a second while the body runs, or until it calls the given function.

    When that function returns, the last call of `send` has ended.
    """
    silenced = threading.Event()

    def repeat() -> None:
        while not silenced.is_set():
            send()
            silenced.wait(0.05)

    def silence() -> None:
        silenced.set()
        thread.join()

    thread = threading.Thread(target=repeat)
    thread.start()
    try:
        yield silence
    finally:
        silence()


class Commander:
    """A client that keeps sending commands in every mode of the robot."""

    def __init__(self, bus: Bus, key: str, linear: float, angular: float) -> None:
        self.key, self.sender = key, f"commander/{secrets.token_hex(16)}"
        self.wish = twist(linear, angular)
        self._bus = bus

    @contextmanager
    def sending(self) -> Iterator[None]:
        """Send while the body runs, or until it calls `silence`."""
        with repeated(lambda: self._bus.put(self.key, self.wish, self.sender)) as self.silence:
            yield


class Periods(NamedTuple):
    """The numbers of control periods between two states, by their result."""

    elapsed: float
    """Elapsed periods by the stamps of the states, at 100 Hz."""
    sent: int
    superseded: int
    missed: int
    commands: int
    """Commands taken meanwhile. Their lines go at once, in place of a period's line or in addition.
    """
    latest: float
    """Lateness of the latest period since the start of the daemon, in periods."""

    @classmethod
    def between(cls, first: Any, last: Any) -> Periods:
        counters = ("lines_sent", "lines_superseded", "missed_periods", "commands")
        sent, superseded, missed, commands = (
            last["counters"].get(c, 0) - first["counters"].get(c, 0) for c in counters
        )
        elapsed = 100.0 * (seconds(last["stamp"]) - seconds(first["stamp"]))
        latest = last["latencies"]["period_lateness"]["since_start"]["max"] / 10_000
        return cls(elapsed, sent, superseded, missed, commands, latest)

    @property
    def accounted(self) -> int:
        return self.sent + self.superseded + self.missed

    def are_all_accounted_for(self) -> bool:
        """Return whether every period sent a line or was counted as superseded or missed.

        A few periods of tolerance are allowed, because a state may fall anywhere within a period.
        """
        return abs(self.accounted - self.elapsed) <= 2 + self.latest + self.commands


def waited_for_a_core(pid: int) -> float:
    """Return how long the first thread of a process was ready to run but had no core, s.

    In the daemon this thread is the control loop.
    """
    return int(Path(f"/proc/{pid}/schedstat").read_text().split()[1]) / 1e9


def waits_for_a_core(pid: int) -> dict[int, float]:
    """Return how long each thread of a process was ready to run but had no core, s."""
    waits = {}
    for task in Path(f"/proc/{pid}/task").iterdir():
        try:
            waits[int(task.name)] = int((task / "schedstat").read_text().split()[1]) / 1e9
        except OSError:
            pass  # the thread has ended meanwhile
    return waits


def kept_waiting(pid: int) -> float:
    """Return how long all threads of a process together were ready to run but had no core, s.

    The threads wait for each other, because they share the Python interpreter. So on a busy machine
    such a process loses more time than the bystander, which has one thread.
    """
    return sum(waits_for_a_core(pid).values())


def silences(times: Sequence[float], longest: float = 0.2) -> float:
    """Return the time that a robot may lose because its commander paused, in s.

    For each pause it includes the time of a ramp down and up again.
    """
    gaps = [after - before for before, after in itertools.pairwise(times)]
    return sum(gap + 0.3 for gap in gaps if gap > longest)


def seconds(stamp: Mapping[str, int]) -> float:
    """Return a stamp of a message as seconds since 1970."""
    return stamp["sec"] + stamp["nanosec"] / 1e9


@contextmanager
def alive_at(endpoint: str, daemon: Program) -> Iterator[Any]:
    """Provide a subscriber to the alive tokens at `endpoint`, while `daemon` is starting."""

    def connect() -> zenoh.Session | None:
        assert daemon.process.poll() is None, f"ended with {daemon.process.returncode}\n{daemon}"
        try:
            return zenoh.open(client_config(endpoint))
        except zenoh.ZError:
            return None

    with until(connect, START_S, f"a listener at {endpoint}") as session:
        yield session.liveliness().declare_subscriber(
            "acsard/acsar/alive", zenoh.handlers.FifoChannel(10), history=True
        )


@contextmanager
def running(
    where: Path, port: Path | str = "sim", config: Tables | None = None, **how: Any
) -> Iterator[tuple[Daemon, Bus]]:
    """Provide a daemon whose link is up, and a Zenoh client of it."""
    with Daemon(where, port, config, **how) as daemon, Bus(daemon.endpoint) as bus:
        bus.linked()
        yield daemon, bus

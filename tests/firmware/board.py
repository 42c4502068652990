"""Run the firmware's machine code in libsimavr, with a test program (`Host`) at its serial port.

This module uses no parser of acsard, so an error in acsard cannot hide one in the firmware. Every
wait has a deadline.
"""

from __future__ import annotations

import binascii
import json
import math
import os
import select
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from tests.system.harness import PATIENCE_S, until

ROOT = Path(__file__).resolve().parents[2]

FIRMWARE = ROOT / "deploy" / "firmware"

ARDUINO = Path("/usr/share/arduino/hardware/arduino/avr")
"""Debian's package arduino-core-avr."""

ANSWER_S = 10.0
"""A command to the runner takes a millisecond; this limit is for a busy machine."""

LATE_S = 0.1
"""A host that is this late has not kept its pace."""

MS = 1_000_000
"""Nanoseconds in a millisecond."""

Speeds = tuple[float, float, float, float]

STOP = b"ap00.00,bp00.00,cp00.00,dp00.00"


class UnavailableError(Exception):
    """This machine cannot run the firmware; the message says why."""


def missing() -> str:
    """Return the reason why this machine cannot build the real firmware, or "" if it can."""
    tools = [tool for tool in ("make", "gcc", "avr-gcc", "avr-size") if shutil.which(tool) is None]
    if tools:
        return f"no {', '.join(tools)} (Debian: make gcc gcc-avr avr-libc binutils-avr)"
    words = ["avr-gcc", "-mmcu=atmega2560", "-include", "avr/io.h", "-E", "-x", "c", "/dev/null"]
    if subprocess.run(words, capture_output=True, timeout=20).returncode:
        return "no avr/io.h (Debian: avr-libc)"
    if not ARDUINO.exists():
        return "no Arduino core (Debian: arduino-core-avr)"
    if not any(Path(place, "simavr/sim_avr.h").exists() for place in _INCLUDES):
        return "no simavr/sim_avr.h (Debian: libsimavr-dev libelf-dev)"
    return ""


_INCLUDES = ("/usr/include", "/usr/local/include")


def _run(words: Sequence[str | Path], cwd: Path) -> str:
    done = subprocess.run(words, cwd=cwd, capture_output=True, text=True, timeout=100)
    if done.returncode:
        raise AssertionError(f"{words}\n{done.stdout}{done.stderr}")
    return done.stdout


def build_firmware(where: Path, *defines: str) -> Path:
    """Build the firmware with the manual's command, print its size, and return the ELF file."""
    out = _run(["make", f"BUILD={where}", f"DEFINES={' '.join(defines)}"], FIRMWARE)
    print(*(line for line in out.splitlines() if "Full" in line), sep="\n")
    return where / "firmware.elf"


def build_sketch(where: Path, *changes: tuple[str, str], more: str = "") -> Path:
    """Build the Arduino sketch as the IDE does, after changes in its text, with more text below."""
    text = (FIRMWARE / "acsar" / "acsar.ino").read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    source, elf, core = where / "acsar.cpp", where / "acsar.elf", ARDUINO / "cores" / "arduino"
    source.write_text("#include <Arduino.h>\n" + text + more)
    flags = ["-std=gnu++11", "-Os", "-mmcu=atmega2560", "-DF_CPU=16000000L", "-DARDUINO=10808"]
    flags += ["-DARDUINO_ARCH_AVR", f"-I{core}", f"-I{ARDUINO / 'variants' / 'mega'}"]
    # The core warns, and expects a constant that the headers of Debian's older compiler lack.
    links = ["-DDECIMAL_DIG=17", "-w", "-fpermissive", "-fno-exceptions", "-fno-threadsafe-statics"]
    links += ["-ffunction-sections", "-fdata-sections", "-Wl,--gc-sections"]
    _run(["avr-g++", *flags, "-Wall", "-Wextra", "-fsyntax-only", source], where)
    parts = sorted([*core.glob("*.c"), *core.glob("*.cpp")])
    _run(["avr-gcc", *flags, *links, "-o", elf, source, *parts, "-lm"], where)
    return elf


def build_library(where: Path, *defines: str) -> Path:
    """Build the hardware-independent part of the firmware as a library for this machine."""
    _run(["make", f"BUILD={where}", f"DEFINES={' '.join(defines)}", "host"], FIRMWARE)
    return where / "libfirmware.so"


def build_runner(where: Path) -> Path:
    """Build the runner: the program that simulates the board with libsimavr."""
    source = Path(__file__).with_name("runner.c")
    flags = ["-std=gnu11", "-O2", "-Wall", "-Wextra", "-Werror"]
    flags += [f"-I{place}/simavr" for place in _INCLUDES if Path(place, "simavr").exists()]
    binary = where / "runner"
    _run(["gcc", *flags, "-o", binary, source, "-lsimavr", "-lelf", "-lm"], where)
    return binary


class Motor(NamedTuple):
    """The state of one simulated motor, independent of what the firmware reports."""

    duty: float
    """-1 to 1, as the bridge applies it."""
    speed: float
    """rad/s"""
    counts: int
    """Counts of its encoder since power on, 64 bits."""
    since_reset: int
    """Counts of its encoder since the firmware began to count."""
    flips: int
    """Number of times that the bridge changed direction."""
    flip_duty: float
    """The highest duty at which the bridge ever changed direction, 0 to 1."""


class Wire(NamedTuple):
    """One direction of the serial line."""

    bytes: int
    lines: int
    """Lines put on it whole, even if they were damaged there; empty ones are not counted."""
    lost: int
    """Bytes lost on it."""
    damaged: int
    """Bytes damaged on it."""
    last: str
    """The last whole line on it."""


class Status(NamedTuple):
    """The state of the simulated board, independent of what the firmware reports.

    `*_ns` are in the board's simulated time unless noted.
    """

    virtual_ns: int
    wall_ns: int
    """The monotonic clock of this machine, now."""
    base_ns: int
    """Add this to a virtual time to get the monotonic clock's."""
    skipped_ns: int
    """Virtual time for which this machine was too slow."""
    fetched: int
    """Bytes that the runner has read from the port since it started."""
    load: float
    """Share of its time in which the processor did not sleep."""
    resets: int
    running: bool
    """Whether some motor has voltage."""
    on_ns: int
    """When the motors last got voltage after having none."""
    off_ns: int
    """When the motors last lost all voltage."""
    heard_ns: int
    """When the board last received a byte."""
    answer_ns: int
    """Time from a received byte to the first byte of the board's next line: its time to answer."""
    wanted_ns: int
    """Time when the firmware last wanted a motor to turn, for any reason."""
    set_points: int
    """Number of changes of the speeds that the firmware wants of the motors."""
    wrong: int
    """Number of those changes that are in none of the lines which the host has just sent."""
    wrong_one: Sequence[int]
    """The last such speeds, hundredths of a rad/s."""
    open: bool
    contact_ns: int
    """Time when a contact was last opened or closed."""
    reported_ns: int
    """Time when the board had last sent that the emergency stop changed."""
    motors: tuple[Motor, ...]
    to_board: Wire
    from_board: Wire


class Board:
    """A simulated board, used as a context manager.

    Entering it starts the board and waits until it has booted. Leaving it ends the process.
    """

    def __init__(self, runner: Path, firmware: Path, *options: str) -> None:
        self._words = [str(runner), *options, str(firmware)]
        self._held = b""
        self.path = ""
        """The path of its port."""
        self.stepped = False
        """Whether the board's time passes only in `step`."""

    def __enter__(self) -> Board:
        self._errors = tempfile.TemporaryFile()
        self.process = subprocess.Popen(
            self._words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._errors
        )
        try:
            self.path = self._answer()["pty"]
            # A host that opens the port in the middle of the boot line gets the end of it.
            until(lambda: self.status().from_board.last, ANSWER_S, "it has booted")
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *error: object) -> None:
        process = self.process
        process.terminate()
        try:
            process.wait(5.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait(5.0)
        for stream in (process.stdin, process.stdout, self._errors):
            if stream is not None:
                stream.close()

    def command(self, words: str) -> dict[str, Any]:
        """Send a command to the simulation and return its answer. runner.c lists the commands."""
        assert self.process.stdin is not None
        self.process.stdin.write(words.encode() + b"\n")
        self.process.stdin.flush()
        answer = self._answer()
        assert answer.get("ok", True), f"the runner does not know {words!r}"
        return answer

    def plug(self) -> str:
        """Plug the board in again, with a new serial port. Return the path of the port."""
        self.path = self.command("plug")["pty"]
        return self.path

    @contextmanager
    def in_steps(self) -> Iterator[None]:
        """Let the board's simulated time pass only in `step` while the body runs.

        Board and host then never wait for each other, so the motors, the watchdog and the timing of
        the lines are the same on a busy machine as on an idle one.
        """
        self.command("pause")
        self.stepped = True
        try:
            yield
        finally:
            self.stepped = False
            self.command("resume")

    def step(self, ms: int) -> None:
        """Advance the board's simulated time by `ms`, as fast as this machine can compute it."""
        assert self.stepped, "this board's time is the wall clock's"
        self.command(f"bench {ms}")

    def status(self) -> Status:
        """Return the current state of the simulated board."""
        fields = self.command("status")
        fields["motors"] = tuple(Motor(**motor) for motor in fields["motors"])
        fields["to_board"] = Wire(**fields["to_board"])
        fields["from_board"] = Wire(**fields["from_board"])
        return Status(**fields)

    def _answer(self) -> dict[str, Any]:
        # libsimavr prints the names of loaded files on the same standard output. Skip those lines.
        stdout = self.process.stdout
        assert stdout is not None
        deadline = time.monotonic() + ANSWER_S
        while True:
            line, end, rest = self._held.partition(b"\n")
            if end:
                self._held = rest
                if line.startswith(b"{"):
                    answer: dict[str, Any] = json.loads(line)
                    return answer
                continue
            left = deadline - time.monotonic()
            if left <= 0 or not select.select([stdout], [], [], left)[0]:
                raise AssertionError("the runner does not answer")
            data = os.read(stdout.fileno(), 65536)
            if not data:
                self._errors.seek(0)
                raise AssertionError(f"the runner ended: {self._errors.read()!r}")
            self._held += data


def passes(board: Board, ms: float) -> Status:
    """Wait until `ms` of the board's simulated time have passed, and return the state."""
    end = board.status().virtual_ns + ms * MS
    if board.stepped:
        board.step(math.ceil(ms))
    return until(
        lambda: status if (status := board.status()).virtual_ns >= end else None,
        10.0 + ms / 100,
        f"{ms} ms pass",
    )


def speeds_line(speeds: Sequence[float]) -> bytes:
    """Return the plain line for these wheel speeds in rad/s, without CR LF."""
    return ",".join(
        f"{letter}{'n' if speed < 0 else 'p'}{abs(speed):05.2f}"
        for letter, speed in zip("abcd", speeds, strict=True)
    ).encode()


def checked(line: bytes, sequence: int, letters: str = "") -> bytes:
    """Return the line with the checked link's suffix: sequence number, letters and checksum."""
    line += b"#%02X" % sequence + letters.encode()
    return line + b"*%04X" % binascii.crc_hqx(line, 0)


class Identity(NamedTuple):
    """The fields of the board's identity line. The counters begin when the board boots."""

    counts: int
    watchdog_ms: int
    check: int
    sample: int
    lines: int
    refused: int
    trips: int
    runaways: int
    reset: str


def read_identity(line: bytes) -> Identity:
    """Decode an identity line. Fails if a field is missing or in the wrong place."""
    name, version, *words = line.decode().split(" ")
    assert (name, version) == ("!acsard-mcu", "1"), line
    fields = dict(word.split("=") for word in words)
    assert tuple(fields) == Identity._fields, line
    *numbers, reset = fields.values()
    counts, watchdog_ms, check, sample, lines, refused, trips, runaways = map(int, numbers)
    return Identity(counts, watchdog_ms, check, sample, lines, refused, trips, runaways, reset)


class Reply(NamedTuple):
    """A reply of the board."""

    at: float
    """Monotonic time when it was read here, s."""
    line: bytes
    speeds: Speeds
    """rad/s of motors a to d."""
    sequence: int | None
    milliseconds: int | None
    counts: tuple[int, ...]
    """Counts modulo 65536; empty without the sample fields."""


def read_reply(line: bytes, at: float = 0.0) -> Reply:
    """Decode a reply. Fails if its checksum is wrong or its format differs from the contract."""
    plain, mark, suffix = line.partition(b"#")
    assert len(plain) == 31, line
    speeds = [float(plain[i + 2 : i + 7]) for i in range(0, 32, 8)]
    signed = [s if plain[8 * i + 1 : 8 * i + 2] == b"p" else -s for i, s in enumerate(speeds)]
    a, b, c, d = signed
    assert speeds_line((a, b, c, d)) == plain, line
    if not mark:
        return Reply(at, line, (a, b, c, d), None, None, ())
    body, star, crc = suffix.rpartition(b"*")
    assert star, line
    assert crc == b"%04X" % binascii.crc_hqx(line[: -len(crc) - 1], 0), line
    sequence, at_sign, sample = body.partition(b"@")
    assert sequence == b"%02X" % int(sequence, 16), line
    if not at_sign:
        return Reply(at, line, (a, b, c, d), int(sequence, 16), None, ())
    assert len(sample) == 20, line
    words = [int(sample[i : i + 4], 16) for i in range(0, 20, 4)]
    assert sample == b"".join(b"%04X" % word for word in words), line
    return Reply(at, line, (a, b, c, d), int(sequence, 16), words[0], tuple(words[1:]))


class Host:
    """A program at the board's serial port, controlled by a test.

    Its waits are in real time. If the board is `stepped`, each wait advances the board's simulated
    time instead.
    """

    def __init__(self, path: str, board: Board | None = None) -> None:
        self._fd = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK | os.O_CLOEXEC)
        self._board = board
        self._held = b""
        self._sequence = 0
        self._stopped = False
        self.plain = False
        """Whether `drive` sends lines without the checked link's suffix."""
        self.sent_ns = 0
        """Monotonic time when the last line was written to the port."""

    def __enter__(self) -> Host:
        return self

    def __exit__(self, *error: object) -> None:
        os.close(self._fd)

    @property
    def _stepped(self) -> Board | None:
        return self._board if self._board is not None and self._board.stepped else None

    def send(self, line: bytes, end: bytes = b"\r\n") -> None:
        """Send one line."""
        self.write(line + end)

    def write(self, data: bytes) -> None:
        """Send bytes unchanged."""
        length, fetched = len(data), self._stepped.status().fetched if self._stepped else 0
        while data:
            select.select([], [self._fd], [], ANSWER_S)
            data = data[os.write(self._fd, data) :]
        if (board := self._stepped) is not None:
            # The kernel's thread that carries bytes through a pty may be late. The board's time
            # waits for it.
            until(lambda: board.status().fetched >= fetched + length, 3.0, "the line is fetched")
        self.sent_ns = time.monotonic_ns()

    def lines(self, wait: float = 0.0) -> list[tuple[float, bytes]]:
        """Return the received lines without CR LF. Waits at most `wait` s for the first one."""
        if self._stepped is not None:
            self._stepped.step(round(1000 * wait))
        while select.select([self._fd], [], [], wait)[0]:
            data = os.read(self._fd, 65536)
            if not data:
                break
            self._held += data
            wait = 0.0
        *ends, self._held = self._held.split(b"\n")
        now = time.monotonic()
        return [(now, line.removesuffix(b"\r")) for line in ends]

    def says(self, text: bytes, within: float = 3.0) -> bytes:
        """Return the first line that contains `text`. Fails if none comes within `within` s."""
        deadline = time.monotonic() + within + PATIENCE_S
        lines: list[bytes] = []
        while time.monotonic() < deadline:
            for _, line in self.lines(0.05):
                if text in line:
                    return line
                lines.append(line)
        raise AssertionError(f"not within {within:g} s: {text!r}; heard {lines[-5:]}")

    def ask(self, line: bytes, within: float = 3.0) -> Reply:
        """Send a line, and return the next received line, decoded as its reply."""
        self.lines()
        self.send(line)
        deadline = time.monotonic() + within + PATIENCE_S
        while time.monotonic() < deadline:
            for at, answer in self.lines(0.05):
                return read_reply(answer, at)
        raise AssertionError(f"no answer within {within:g} s to {line!r}")

    def identity(self) -> Identity:
        """Ask for the board's identity and return it.

        It asks again if the answer follows the rest of a reply to another host.
        """
        self.lines()
        while True:
            self.send(b"?")
            line = self.says(b"!acsard")
            if line.startswith(b"!"):
                return read_identity(line)

    def stop(self, within: float = 3.0) -> None:
        """Send stops until the board answers one. After a boot the board accepts nothing else."""
        deadline = time.monotonic() + within + PATIENCE_S
        self._stopped = False
        self.lines()
        while time.monotonic() < deadline:
            self.send(STOP)
            again = time.monotonic() + 0.2
            while not self._stopped and time.monotonic() < again:
                # The board's boot message may come before the answer.
                self._stopped = any(len(line) == len(STOP) for _, line in self.lines(0.05))
            if self._stopped:
                return
        raise AssertionError(f"no stop answered within {within:g} s")

    def drive(
        self, speeds: Speeds, seconds: float, letters: str = "S", period: float = 0.01
    ) -> list[Reply]:
        """Send lines with these speeds in rad/s at an even rate. Return all replies.

        The first call sends a stop first, because the board requires it. If this machine delays the
        lines so much that the board would stop its motors, the time starts again.
        """
        replies: list[Reply] = []
        if not self._stopped:
            self.stop()
        if (board := self._stepped) is not None:
            for _ in range(round(seconds / period)):
                self._send_speeds(speeds, letters)
                board.step(round(1000 * period))
                replies += [read_reply(line, at) for at, line in self.lines()]
            return replies
        began = time.monotonic()
        sent, again = 0, 0
        while sent < round(seconds / period):
            self._send_speeds(speeds, letters)
            sent += 1
            due = began + sent * period
            late = time.monotonic() - due
            if late > LATE_S and again < 5:
                began, sent, again = time.monotonic(), 0, again + 1
                continue
            while (left := due - time.monotonic()) > 0:
                replies += [read_reply(line, at) for at, line in self.lines(left)]
        return replies

    def _send_speeds(self, speeds: Speeds, letters: str) -> None:
        line = speeds_line(speeds)
        self.send(line if self.plain else checked(line, self._sequence, letters))
        self._sequence = (self._sequence + 1) % 256

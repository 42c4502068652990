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
import shlex
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cffi

from tests.system.harness import until

ROOT = Path(__file__).resolve().parents[2]

FIRMWARE = ROOT / "deploy" / "firmware"

ARDUINO = Path("/usr/share/arduino/hardware/arduino/avr")
"""Debian's package arduino-core-avr."""

PURE = ("bridge", "line", "pi", "speed", "status", "supervise", "watchdog")
"""Its parts that use no registers."""

ANSWER_S = 10.0
"""A command to the runner takes a millisecond; this limit is for a busy machine."""

MS = 1_000_000
"""Nanoseconds in a millisecond."""

Speeds = tuple[float, float, float, float]

STOP = b"ap00.00,bp00.00,cp00.00,dp00.00"

DRIVE: Speeds = (10.0, -5.0, 20.0, -30.0)
"""rad/s; each wheel turns otherwise."""


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


class Chip(NamedTuple):
    """A chip with a sketch: its name, the variant of the Arduino core, the runner's board."""

    name: str
    variant: str
    board: str


MEGA = Chip("atmega2560", "mega", "mega")
UNO = Chip("atmega328p", "standard", "uno")


def arduino_flags(chip: Chip) -> list[str | Path]:
    return [
        "-std=gnu++11", "-Os", f"-mmcu={chip.name}", "-DF_CPU=16000000L", "-DARDUINO=10808",
        "-DARDUINO_ARCH_AVR", f"-I{ARDUINO}/cores/arduino", f"-I{ARDUINO}/variants/{chip.variant}",
        "-ffunction-sections", "-fdata-sections", "-fno-exceptions", "-fno-threadsafe-statics",
    ]  # fmt: skip


def build_core(where: Path, chip: Chip) -> Path:
    """Build the Arduino core, which each sketch is linked with. Return its library."""
    core = ARDUINO / "cores" / "arduino"
    # It warns, and expects a constant that the headers of Debian's older compiler lack.
    flags = ["-DDECIMAL_DIG=17", "-w", "-fpermissive"]
    parts = sorted([*core.glob("*.c"), *core.glob("*.cpp")])
    _run(["avr-gcc", *arduino_flags(chip), *flags, "-c", *parts], where)
    _run(["avr-ar", "rcs", "core.a", *sorted(where.glob("*.o"))], where)
    return where / "core.a"


SKETCH = FIRMWARE / "acsar" / "acsar.ino"


def build_sketch(
    core: Path, where: Path, chip: Chip, *changes: tuple[str, str], more: str = ""
) -> Path:
    """Build the Arduino sketch as the IDE does, after changes in its text, with more text below."""
    text = SKETCH.read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    source, elf = where / "acsar.cpp", where / "acsar.elf"
    source.write_text("#include <Arduino.h>\n" + text + more)
    flags = ["-Wall", "-Wextra", "-Werror", "-Wl,--gc-sections"]
    _run(["avr-g++", *arduino_flags(chip), *flags, "-o", elf, source, core, "-lm"], where)
    sizes = _run(["avr-size", "--format=avr", f"--mcu={chip.name}", elf], where)
    print(chip.name, *(line for line in sizes.splitlines() if "Full" in line), sep="\n")
    return elf


class Library:
    """The hardware-independent part of the firmware, built for this machine."""

    def __init__(self, where: Path, *defines: str) -> None:
        _run(["make", f"BUILD={where}", f"DEFINES={shlex.join(defines)}", "host"], FIRMWARE)
        (where / "all.h").write_text("".join(f'#include "{name}.h"\n' for name in PURE))
        words = ["gcc", "-E", "-P", "-ffreestanding", f"-I{FIRMWARE}", *defines, "all.h"]
        lines = _run(words, where).splitlines()
        self.ffi = cffi.FFI()
        self.ffi.cdef("\n".join(line for line in lines if not line.startswith("typedef")))
        self.c: Any = self.ffi.dlopen(str(where / "libfirmware.so"))
        """Its C functions."""

    def new(self, name: str, *values: Any) -> Any:
        """Return a pointer to a new `struct`."""
        return self.ffi.new(f"struct {name} *", *values)

    def text(self, write: Callable[[Any], int]) -> bytes:
        """Return the text that a C function writes into a buffer."""
        out = self.ffi.new("char[]", 128)
        return bytes(self.ffi.buffer(out, write(out)))


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
    contact_ns: int
    """Time when a contact was last opened or closed."""
    reported_ns: int
    """Time when the board had last sent that the emergency stop changed."""
    motors: tuple[Motor, ...]
    to_board: Wire
    from_board: Wire

    @property
    def is_off(self) -> bool:
        return not self.running and all(motor.duty == 0.0 for motor in self.motors)


class Board:
    """A simulated board, used as a context manager.

    Entering it starts the board and waits until it has booted. Leaving it ends the process. Its
    time passes only in `passes` and `waits`, so motors, watchdog and lines are the same on a busy
    machine as on an idle one. A `live` board has the wall clock's time.
    """

    def __init__(self, runner: Path, firmware: Path, *options: str, live: bool = False) -> None:
        self._words = [str(runner), *options, str(firmware)]
        self._held = b""
        self.live = live
        self.motors = 2 if UNO.board in options else 4
        self.path = ""
        """The path of its port."""

    def __enter__(self) -> Board:
        self._errors = tempfile.TemporaryFile()
        self.process = subprocess.Popen(
            self._words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._errors
        )
        try:
            self.path = self._answer()["pty"]
            # A host that opens the port in the middle of the boot line gets the end of it.
            until(lambda: self.status().from_board.last, ANSWER_S, "it has booted")
            if not self.live:
                self.pause()
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

    def pause(self) -> None:
        """Let the time pass only in `passes` and `waits` from now on."""
        self.command("pause")
        self.live = False

    def status(self) -> Status:
        """Return the current state of the simulated board."""
        fields = self.command("status")
        fields["motors"] = tuple(Motor(**motor) for motor in fields["motors"])
        fields["to_board"] = Wire(**fields["to_board"])
        fields["from_board"] = Wire(**fields["from_board"])
        return Status(**fields)

    def passes(self, ms: float) -> Status:
        """Let `ms` of the board's time pass, and return the state."""
        if not self.live:
            self.command(f"bench {math.ceil(ms)}")
            return self.status()
        end = self.status().virtual_ns + ms * MS
        return until(
            lambda: status if (status := self.status()).virtual_ns >= end else None,
            10.0 + ms / 100,
            f"{ms} ms pass",
        )

    def waits(self, wanted: Callable[[Status], bool], what: str, ms: float = 3000.0) -> Status:
        """Wait for a state, at most for `ms` of the board's time, and return it."""
        status = self.status()
        end = status.virtual_ns + ms * MS
        while not wanted(status):
            assert status.virtual_ns < end, f"not within {ms} ms: {what}; {status}"
            status = self.passes(5)
        return status

    def is_still(self) -> Status:
        """Wait until no motor turns or has voltage. A wheel then turns much less than a count."""
        return self.waits(
            lambda status: status.is_off and all(abs(m.speed) < 1e-6 for m in status.motors),
            "standstill",
            10_000.0,
        )

    def stays_off(self, ms: float) -> Status:
        """Check that no motor gets any voltage for `ms`."""
        before = self.status()
        assert before.is_off
        after = self.passes(ms)
        assert after.is_off
        assert after.on_ns == before.on_ns, "not for a moment"
        return after

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


def speeds_line(speeds: Sequence[float]) -> bytes:
    """Return the plain line for these speeds of motors a, b ... in rad/s, without CR LF."""
    return ",".join(
        f"{letter}{'n' if speed < 0 else 'p'}{abs(speed):05.2f}"
        for letter, speed in zip("abcd", speeds, strict=False)
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

    line: bytes
    speeds: tuple[float, ...]
    """rad/s of motors a to d, or a and b."""
    sequence: int | None
    milliseconds: int | None
    counts: tuple[int, ...]
    """Counts modulo 65536; empty without the sample fields."""


def read_reply(line: bytes) -> Reply:
    """Decode a reply. Fails if its checksum is wrong or its format differs from the contract."""
    plain, mark, suffix = line.partition(b"#")
    assert len(plain) in (15, 31), line
    signed = tuple(
        float(word[2:]) if word[1:2] == b"p" else -float(word[2:]) for word in plain.split(b",")
    )
    assert speeds_line(signed) == plain, line
    if not mark:
        return Reply(line, signed, None, None, ())
    body, star, crc = suffix.rpartition(b"*")
    assert star, line
    assert crc == b"%04X" % binascii.crc_hqx(line[: -len(crc) - 1], 0), line
    sequence, at_sign, sample = body.partition(b"@")
    assert sequence == b"%02X" % int(sequence, 16), line
    if not at_sign:
        return Reply(line, signed, int(sequence, 16), None, ())
    assert len(sample) == 20, line
    words = [int(sample[i : i + 4], 16) for i in range(0, 20, 4)]
    assert sample == b"".join(b"%04X" % word for word in words), line
    return Reply(line, signed, int(sequence, 16), words[0], tuple(words[1:]))


class Host:
    """A program at the serial port of a paused board. The board's time passes while it waits."""

    def __init__(self, board: Board, plain: bool = False) -> None:
        self._fd = os.open(board.path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK | os.O_CLOEXEC)
        self.board = board
        self.plain = plain
        """Whether `drive` sends lines without the checked link's suffix."""
        self.others: list[bytes] = []
        """The lines with a `!` that came during `drive`."""
        self._held = b""
        self._sequence = 0
        self._stopped = False

    def __enter__(self) -> Host:
        return self

    def __exit__(self, *error: object) -> None:
        os.close(self._fd)

    def send(self, line: bytes, end: bytes = b"\r\n") -> None:
        """Send one line."""
        self.write(line + end)

    def write(self, data: bytes) -> None:
        """Send bytes unchanged."""
        end = self.board.status().fetched + len(data)
        while data:
            select.select([], [self._fd], [], ANSWER_S)
            data = data[os.write(self._fd, data) :]
        # The kernel's thread that carries bytes through a pty may be late.
        until(lambda: self.board.status().fetched >= end, 3.0, "the line is fetched")

    def lines(self, wait_ms: float = 0.0) -> list[bytes]:
        """Return the lines that came until `wait_ms` from now, without CR LF."""
        if wait_ms:
            self.board.passes(wait_ms)
        while select.select([self._fd], [], [], 0.0)[0]:
            data = os.read(self._fd, 65536)
            if not data:
                break
            self._held += data
        *ends, self._held = self._held.split(b"\n")
        return [line.removesuffix(b"\r") for line in ends]

    def says(self, text: bytes, within_ms: float = 3000.0) -> bytes:
        """Return the first line that contains `text`."""
        lines: list[bytes] = []
        for _ in range(round(within_ms / 10)):
            lines += self.lines(10)
            if match := next((line for line in lines if text in line), b""):
                return match
        raise AssertionError(f"not within {within_ms:g} ms: {text!r}; heard {lines[-5:]}")

    def ask(self, line: bytes) -> Reply:
        """Send a line, and return the next received line, decoded as its reply."""
        self.lines()
        self.send(line)
        return read_reply(self.says(b""))

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

    def line(self, speeds: Sequence[float]) -> bytes:
        """Return the plain line with those of these speeds for which the board has motors."""
        return speeds_line(speeds[: self.board.motors])

    @property
    def zeros(self) -> bytes:
        return self.line((0.0,) * 4)

    def turns(self) -> list[float]:
        """Return the true speeds of the motors that the board has, rad/s."""
        return [motor.speed for motor in self.board.status().motors[: self.board.motors]]

    def stop(self) -> None:
        """Send a stop and wait for its answer. After a boot the board accepts nothing else."""
        self.lines()
        self.send(self.zeros)
        self.says(b"ap")
        self._stopped = True

    def drive(
        self, speeds: Speeds, seconds: float, letters: str = "S", period: float = 0.01
    ) -> list[Reply]:
        """Send lines with these speeds in rad/s at an even rate. Return all replies.

        The first call sends a stop first, because the board requires it.
        """
        replies: list[Reply] = []
        if not self._stopped:
            self.stop()
        for _ in range(round(seconds / period)):
            line = self.line(speeds)
            self.send(line if self.plain else checked(line, self._sequence, letters))
            self._sequence = (self._sequence + 1) % 256
            came = self.lines(1000 * period)
            self.others += [line for line in came if line.startswith(b"!")]
            replies += [read_reply(line) for line in came if not line.startswith(b"!")]
        return replies

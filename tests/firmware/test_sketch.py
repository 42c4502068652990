"""The Arduino sketch on boards whose cores are not here: an ESP32, a Pico, and any other.

It is compiled for this machine with a stand-in for their cores, which shows that it parses, stops
and replies with their pins. It does not show that their own cores compile it. `test_contract` runs
the machine code of the Mega and the Uno.
"""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path
from typing import Any, NamedTuple

import cffi
import pytest

from tests.firmware.board import SKETCH, _run, speeds_line
from tests.pages import text_of

HERE = Path(__file__).with_name("arduino")

FUNCTIONS = """
void host_setup(); void host_send(const char *); void host_run(int); void host_level(int, int);
int host_pwm(int); int host_read(int); int host_feeds(); int host_take(char *, int);
"""


class Core(NamedTuple):
    """A core: what its compiler defines, and the pins of the wiring table, motor by motor."""

    define: str
    pwm: tuple[int, ...]
    forward: tuple[int, ...]
    reverse: tuple[int, ...]
    a: tuple[int, ...]
    b: tuple[int, ...]
    watchdog: bool = True
    motors: int = 2


CORES = {
    "ESP32": Core("-DESP32", (25, 33), (26, 32), (27, 13), (18, 22), (19, 23)),
    "Pico": Core("-DARDUINO_ARCH_RP2040", (2, 3), (6, 8), (7, 9), (14, 16), (15, 17)),
    "Pico, four motors": Core(
        "-DARDUINO_ARCH_RP2040", (2, 3, 4, 5), (6, 8, 10, 12), (7, 9, 11, 13), (14, 16, 18, 20),
        (15, 17, 19, 21), motors=4),
    "another": Core("-DARDUINO_ARCH_OTHER", (9, 11), (12, 7), (13, 8), (3, 2), (5, 4), False),
}  # fmt: skip


@pytest.mark.parametrize("core", CORES.values(), ids=CORES)
def test_the_compiler_says_whether_a_hang_leaves_the_motors_on(core: Core) -> None:
    words = ["g++", "-std=gnu++17", "-fsyntax-only", core.define, f"-I{HERE}", "-x", "c++", "-"]
    text = "#include <Arduino.h>\n" + SKETCH.read_text()
    done = subprocess.run(words, input=text, capture_output=True, text=True, check=True)
    assert ("No hardware watchdog is known" in done.stderr) is not core.watchdog


class Sketch:
    """The sketch, compiled for this machine, with its own time and pins."""

    def __init__(self, where: Path, core: Core) -> None:
        self.core, self._ffi, library = core, cffi.FFI(), where / "sketch.so"
        text = SKETCH.read_text()
        if core.motors == 4:
            text = text.replace(
                "const byte MOTORS = 2;              // or 4", "const byte MOTORS = 4;"
            )
        (where / "sketch.cpp").write_text("#include <Arduino.h>\n" + text)
        flags = ["-std=gnu++17", "-O2", "-fPIC", "-shared", "-Wall", "-Wextra", "-Werror"]
        flags += [] if core.watchdog else ["-Wno-error=cpp"]
        _run(["g++", *flags, core.define, f"-I{HERE}", "-o", library, "sketch.cpp"], where)
        self._ffi.cdef(FUNCTIONS)
        self.c: Any = self._ffi.dlopen(str(library))
        self.c.host_setup()

    def says(self, line: bytes, ms: int = 20) -> str:
        """Send a line, let some time pass, and return what the board sends."""
        self.c.host_send(line + b"\r\n")
        self.c.host_run(ms)
        text = self._ffi.new("char[]", 4096)
        self.c.host_take(text, 4096)
        return bytes(self._ffi.string(text)).decode()

    def line(self, *speeds: float) -> bytes:
        return speeds_line(speeds[: self.core.motors])

    def duties(self) -> list[int]:
        """Return the voltage of each motor as its bridge applies it, -255 to 255."""
        core, read = self.core, self.c.host_read
        ways = [read(f) - read(r) for f, r in zip(core.forward, core.reverse, strict=True)]
        return [way * self.c.host_pwm(pin) for way, pin in zip(ways, core.pwm, strict=True)]

    def turn(self, motor: int, steps: int) -> None:
        """Turn the encoder by quarters of its pulses; channel A leads forward."""
        a, b = self.core.a[motor], self.core.b[motor]
        way = 1 if steps > 0 else -1
        for _ in range(abs(steps)):
            place = [(0, 0), (1, 0), (1, 1), (0, 1)]
            here = place.index((self.c.host_read(a), self.c.host_read(b)))
            for pin, level in zip((a, b), place[(here + way) % 4], strict=True):
                self.c.host_level(pin, level)


@pytest.fixture(
    params=[
        pytest.param(core, marks=pytest.mark.slow if number else ())
        for number, core in enumerate(CORES)
    ]
)
def sketch(request: pytest.FixtureRequest, tmp_path: Path) -> Sketch:
    if shutil.which("g++") is None:
        pytest.skip("no g++")
    return Sketch(tmp_path, CORES[request.param])


def test_the_sketch_parses_stops_replies_and_counts_on_other_cores(sketch: Sketch) -> None:
    zeros, drive = sketch.line(0, 0, 0, 0), sketch.line(12.5, -8.75, 15.0, -10.25)
    assert sketch.says(b"").startswith("!acsard-mcu sketch watchdog_ms=300 counts=800\r\n")
    assert sketch.says(drive).startswith("!acsard"), "before zeros it only names itself"
    assert not any(sketch.duties())
    assert sketch.says(zeros).encode() == zeros + b"\r\n"
    assert sketch.says(drive).encode() == zeros + b"\r\n", "the wheels do not turn yet"
    ways = [duty // abs(duty) for duty in sketch.duties()]
    assert ways == [1, -1, 1, -1][: sketch.core.motors]
    for bad in (drive[:-1], drive + b" ", drive.replace(b".", b","), drive[:-8], b"\xff" * 200):
        assert sketch.says(bad, 30) == ""
    assert any(sketch.duties())
    sketch.says(b"", 200)
    assert not any(sketch.duties()), "300 ms after the last whole valid line"
    assert (sketch.c.host_feeds() > 0) == sketch.core.watchdog

    sketch.says(zeros)
    for _ in range(10):
        for motor in range(sketch.core.motors):
            sketch.turn(motor, 16 if motor % 2 else -32)
        said = sketch.says(zeros, 10)
    rates = [16, -8, 16, -8][: sketch.core.motors]  # edges of channel A in 10 ms, of 800 a turn
    expected = [-rate / 800 * 6.2832 / 0.01 for rate in rates]
    values = re.findall(r"[a-d]([pn])(\d\d\.\d\d)", said)
    assert [float(f"{'-' if n == 'n' else ''}{v}") for n, v in values] == pytest.approx(
        expected, abs=0.02
    )


def test_the_wiring_page_has_the_pins_of_each_core() -> None:
    rows = re.findall(r"^\|.*\|$", text_of("deploy/manual/pages/howto/wire.md"), re.M)
    cells = [row.strip("|").replace(" ", "").replace("GP", "").split("|") for row in rows]
    pins = [tuple(map(int, row[2:])) for row in cells if len(row) == 7 and row[2].isdigit()]
    cores = CORES["another"], CORES["ESP32"], CORES["Pico, four motors"]
    assert pins == [pin for core in cores for pin in zip(*core[1:6], strict=True)]

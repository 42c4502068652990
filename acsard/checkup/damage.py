"""Broken lines that say speeds, to motors that stand: none may move anything."""

from __future__ import annotations

from collections.abc import Sequence

from msgspec import Struct

from acsard.checkup.bench import SPEED, ZERO, Bench
from acsard.checkup.findings import LETTERS, Finding
from acsard.checkup.wheels import MOVES
from acsard.mcu.check import seal

REPEATS = 3
"""How often each broken line goes out: a motor needs a moment to show that it took it."""

SHOWS_S = 0.12
"""How long after it the encoders are watched."""


class Broken(Struct, frozen=True):
    """A line that is none, and whether all of its values are whole."""

    what: str
    line: bytes
    whole: bool = False
    """Only what is around the four values is wrong: firmware that takes them is lenient, not
    dangerous."""


def broken_lines(comma: bool, sealed: bool, motors: Sequence[int]) -> list[Broken]:
    """Every kind of damage, in the dialect the firmware takes; all but these motors at zero."""
    a, b, c, d = (
        f"{letter}p{SPEED if motor in motors else 0.0:05.2f}"
        for motor, letter in enumerate(LETTERS)
    )
    end = ",\r\n" if comma else "\r\n"

    def line(*tokens: str) -> bytes:
        return (",".join(tokens) + end).encode()

    found = [
        Broken("a value is missing", line(a, b, c)),
        Broken("a wrong letter", line(a, b, c, "x" + d[1:])),
        Broken("a letter twice", line(a, a, c, d)),
        Broken("a bad digit", line(a, "bp0x.00", c, d)),
        Broken("neither p nor n", line(a, b, "cq" + c[2:], d)),
        Broken("cut short", line(a, b, c, d)[:20] + b"\r\n"),
        Broken("cut inside the last number", line(a, b, c, d)[:30] + b"\r\n"),
        Broken("cut inside the last number", line(a, b, c, d)[:27] + b"\r\n"),
        Broken("over-long", line(*(a, b, c, d) * 5), whole=True),
        Broken("garbage before it", b"\xff~" + line(a, b, c, d), whole=True),
    ]
    if sealed:
        good = seal(line(a, b, c, d), 7)
        wrong = good[:-3] + (b"0" if good[-3:-2] != b"0" else b"1") + b"\r\n"
        found.append(Broken("a wrong check", wrong))
        found.append(Broken("a check cut short", good[:-4] + b"\r\n"))
    return found


def finding(bench: Bench, motors: Sequence[int]) -> Finding:
    """Send them all, to motors that turn as told; they stand before and after."""
    name = "damaged lines"
    if not motors:
        return Finding(name, "SKIPPED", "", "no motor turns as told, so none can show it")
    took: list[str] = []
    whole = True
    lines = broken_lines(bench.comma, bench.sealed, motors)
    for broken in lines:
        bench.rest()
        if _moves(bench, broken.line):
            took += [broken.what] * (broken.what not in took)
            whole = whole and broken.whole
    bench.rest()
    if not took:
        return Finding(name, "PASS", f"{len(lines)} lines, none moved")
    kinds = len({broken.what for broken in lines})
    figure = f"{len(took)} of {kinds} kinds moved"
    text = f"motors turned on lines that are none: {', '.join(took)}"
    if whole:
        mend = "the firmware should take a line whole or not at all"
        return Finding(name, "WARN", figure, text, mend)
    mend = "the firmware must take a line whole or not at all; deploy/firmware does"
    text += "; on a noisy cable that drives the robot"
    return Finding(name, "FAIL", figure, text, mend)


def _moves(bench: Bench, line: bytes) -> bool:
    """Whether anything turns because of it."""
    for _ in range(REPEATS):
        bench.wire.send(line)
        bench.listen(max(0.03, len(line) * 12 / bench.baud_rate))
    before = len(bench.replies)
    bench.drive(ZERO, SHOWS_S + 2 * bench.gap_s)
    shown = bench.replies[before:]
    return any(abs(speed) >= MOVES for reply in shown for speed in reply.motors)

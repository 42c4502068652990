"""Sends damaged speed commands while the motors stand. No such line may move a motor."""

from __future__ import annotations

from collections.abc import Sequence

from acsard.checkup import outcomes
from acsard.checkup.board import Board
from acsard.checkup.findings import Finding
from acsard.checkup.motion import GLANCE_S, SPEED, ZERO, moving
from acsard.core.link.checked_line import seal
from acsard.core.link.codec import LETTERS

WHOLE = {"over-long", "garbage before it"}
"""Kinds of damage that leave the speeds intact. A board that obeys such lines is not dangerous."""


def broken_lines(comma: bool, sealed: bool, motors: Sequence[int]) -> list[tuple[str, bytes]]:
    """Return a pair for each damaged line: the name of the kind of damage, and the line.

    The lines command `SPEED` for `motors` and zero for the other motors. If `comma` is true, the
    lines end with a comma. If `sealed` is true, the result includes lines with a damaged checksum.
    """
    a, b, c, d = (
        f"{letter}p{SPEED if motor in motors else 0.0:05.2f}"
        for motor, letter in enumerate(LETTERS)
    )
    end = ",\r\n" if comma else "\r\n"

    def line(*tokens: str) -> bytes:
        return (",".join(tokens) + end).encode()

    found = [
        ("a value is missing", line(a, b, c)),
        ("a wrong letter", line(a, b, c, "x" + d[1:])),
        ("a letter twice", line(a, a, c, d)),
        ("a bad digit", line(a, "bp0x.00", c, d)),
        ("neither p nor n", line(a, b, "cq" + c[2:], d)),
        ("cut short", line(a, b, c, d)[:20] + b"\r\n"),
        ("cut inside the last number", line(a, b, c, d)[:30] + b"\r\n"),
        ("cut inside the last number", line(a, b, c, d)[:27] + b"\r\n"),
        ("over-long", line(*(a, b, c, d) * 5)),
        ("garbage before it", b"\xff~" + line(a, b, c, d)),
    ]
    if sealed:
        good = seal(line(a, b, c, d), 7)
        wrong = good[:-3] + (b"0" if good[-3:-2] != b"0" else b"1") + b"\r\n"
        found += [("a wrong check", wrong), ("a check cut short", good[:-4] + b"\r\n")]
    return found


def finding(board: Board, motors: Sequence[int]) -> Finding:
    """Send damaged lines while `motors` stand, and return which kinds of damage moved a motor."""
    if not motors:
        return outcomes.find("damaged lines: untested")
    lines = broken_lines(board.comma, board.sealed, motors)
    board.drive(ZERO, GLANCE_S)  # a coarse encoder may report an earlier movement only now
    took = dict.fromkeys(what for what, line in lines if _moves(board, line))
    if not took:
        return outcomes.find("damaged lines: right", lines=len(lines))
    outcome, kinds = "lenient" if took.keys() <= WHOLE else "taken", {what for what, _ in lines}
    seen = {"took": len(took), "kinds": len(kinds), "which": ", ".join(took)}
    return outcomes.find(f"damaged lines: {outcome}", None, **seen)


def _moves(board: Board, line: bytes) -> bool:
    for _ in range(3):  # a motor needs a moment to show that it obeyed
        board.wire.send(line)
        board.listen(max(GLANCE_S / 6, len(line) * 12 / board.baud_rate))
    shown = board.drive(ZERO, GLANCE_S + 2 * board.gap_s)
    board.rest()
    return any(moving(reply.motors) for reply in shown)

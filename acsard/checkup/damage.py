"""Sends damaged lines with speeds while the motors stand still. No such line may move a motor."""

from __future__ import annotations

from collections.abc import Sequence

from acsard.checkup import outcomes
from acsard.checkup.board import Board
from acsard.checkup.findings import Finding
from acsard.checkup.motion import SHORT_MEASUREMENT_S, SPEED, ZERO, moving
from acsard.core.link.checked_line import seal
from acsard.core.link.codec import LETTERS

# They do not change the speeds, so it is not dangerous if the board obeys these lines.
HARMLESS_KINDS = {"over-long", "garbage before it"}


def broken_lines(comma: bool, sealed: bool, motors: Sequence[int]) -> list[tuple[str, bytes]]:
    """Return damaged lines that would turn `motors`, each with the name of its damage."""
    a, b, c, d = (
        f"{letter}p{SPEED if motor in motors else 0.0:05.2f}"
        for motor, letter in enumerate(LETTERS)
    )
    end = ",\r\n" if comma else "\r\n"

    def line(*tokens: str) -> bytes:
        return (",".join(tokens) + end).encode()

    lines = [
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
        lines += [("a wrong check", wrong), ("a check cut short", good[:-4] + b"\r\n")]
    return lines


def finding(board: Board, motors: Sequence[int]) -> Finding:
    """Send damaged lines, and return a finding that says whether one moved a motor.

    `motors` are known to follow commands, and must stand still. If there are none, nothing is sent.
    """
    if not motors:
        return outcomes.find("damaged lines: untested")
    lines = broken_lines(board.comma, board.sealed, motors)
    # A coarse encoder may report an earlier movement only now.
    board.drive(ZERO, SHORT_MEASUREMENT_S)
    took = dict.fromkeys(what for what, line in lines if _moves(board, line))
    if not took:
        return outcomes.find("damaged lines: right", lines=len(lines))
    outcome = "lenient" if took.keys() <= HARMLESS_KINDS else "taken"
    kinds = {what for what, _ in lines}
    return outcomes.find(
        f"damaged lines: {outcome}", took=len(took), kinds=len(kinds), which=", ".join(took)
    )


def _moves(board: Board, line: bytes) -> bool:
    # Send the line three times, because a motor needs some time until its encoder shows a movement.
    for _ in range(3):
        board.wire.send(line)
        board.listen(max(SHORT_MEASUREMENT_S / 6, len(line) * 12 / board.baud_rate))
    replies = board.drive(ZERO, SHORT_MEASUREMENT_S + 2 * board.gap_s)
    board.stop_motors()
    return any(moving(reply.motors) for reply in replies)

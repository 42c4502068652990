"""Sends damaged lines with speeds while the motors stand still. No such line may move a motor."""

from __future__ import annotations

from collections.abc import Sequence

from acsard.checkup import outcomes
from acsard.checkup.board import Board
from acsard.checkup.findings import Finding, motor_names
from acsard.checkup.motion import SHORT_MEASUREMENT_S, SPEED, moving
from acsard.checkup.motor_channels import run_up
from acsard.core.config.wire_time import TOKEN_BYTES
from acsard.core.link.checked_line import seal

# They do not change the speeds, so it is not dangerous if the board obeys these lines.
HARMLESS_KINDS = {"over-long", "garbage before it"}


def broken_lines(board: Board, motors: Sequence[int]) -> list[tuple[str, bytes]]:
    """Return damaged lines that would turn `motors`, each with the name of its damage."""
    letters, speeds = board.letters, board.only(motors)
    tokens = [f"{letter}p{v:05.2f}" for letter, v in zip(letters, speeds, strict=True)]
    first, second, third = tokens[0], tokens[1], tokens[-2]  # of two values, the third is the first
    wrong_letter = next(letter for letter in "xyzwv" if letter not in letters)
    end = ",\r\n" if board.comma else "\r\n"

    def line(*tokens: str) -> bytes:
        return (",".join(tokens) + end).encode()

    whole, size = line(*tokens), TOKEN_BYTES * len(tokens)
    lines = [
        ("a value is missing", line(*tokens[:-1])),
        ("a wrong letter", line(*tokens[:-1], wrong_letter + tokens[-1][1:])),
        ("a letter twice", line(first, first, *tokens[2:])),
        ("a bad digit", line(first, second[:2] + "0x.00", *tokens[2:])),
        ("neither p nor n", line(*tokens[:-2], third[0] + "q" + third[2:], tokens[-1])),
        ("cut short", whole[: size - 12] + b"\r\n"),
        ("cut inside the last number", whole[: size - 2] + b"\r\n"),
        ("cut inside the last number", whole[: size - 5] + b"\r\n"),
        ("over-long", line(*tokens * (20 // len(tokens)))),
        ("garbage before it", b"\xff~" + whole),
    ]
    if board.sealed:
        good = seal(whole, 7)
        wrong = good[:-3] + (b"0" if good[-3:-2] != b"0" else b"1") + b"\r\n"
        lines += [("a wrong check", wrong), ("a check cut short", good[:-4] + b"\r\n")]
    return lines


def finding(board: Board, motors: Sequence[int]) -> Finding:
    """Send damaged lines, and return a finding that says whether one moved a motor.

    `motors` are known to follow commands, and must stand still. If there are none, nothing is sent.
    """
    if not motors:
        return outcomes.find("damaged lines: untested")
    cut = f"{board.letters[motors[-1]]}n\r\n".encode()
    lines = [*broken_lines(board, motors), ("cut behind a sign", cut)]
    # A coarse encoder may report an earlier movement only now.
    board.drive(board.zero, SHORT_MEASUREMENT_S)
    took = dict.fromkeys(what for what, line in lines if _moves(board, line))
    speeds = run_up(board, board.only(motors))
    board.stop_motors()
    if names := motor_names(board.mcu, [m for m in motors if speeds[m] < SPEED / 3], ", "):
        return outcomes.find("damaged lines: inverted", names=names)
    if not took:
        return outcomes.find("damaged lines: right", lines=len(lines))
    kinds = {what for what, _ in lines}
    return outcomes.find(
        "damaged lines: lenient" if took.keys() <= HARMLESS_KINDS else "damaged lines: taken",
        took=len(took),
        kinds=len(kinds),
        which=", ".join(took),
    )


def _moves(board: Board, line: bytes) -> bool:
    # Send the line three times, because a motor needs some time until its encoder shows a movement.
    for _ in range(3):
        board.wire.send(line)
        board.listen(max(SHORT_MEASUREMENT_S / 6, len(line) * 12 / board.baud_rate))
    replies = board.drive(board.zero, SHORT_MEASUREMENT_S + 2 * board.gap_s)
    board.stop_motors()
    return any(moving(reply.motors) for reply in replies)

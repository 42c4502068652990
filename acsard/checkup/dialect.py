"""The microcontroller's dialect: baud rate, identification, form of lines and the checked link.

These steps send only zeros and questions. Later steps use the results.
"""

from __future__ import annotations

import re
from typing import get_args

from acsard.checkup import manual
from acsard.checkup.board import Board
from acsard.checkup.findings import Finding, StoppedError, motor_name
from acsard.checkup.limits import BOOT_S, GLANCE_S
from acsard.checkup.motion import ZERO, Reply
from acsard.config.settings import Baud
from acsard.mcu.check import seal
from acsard.mcu.session import IDENTITY

OTHER_S = 0.6
"""Time for which each other baud rate is tried, s."""

ENOUGH = 3
"""Number of good replies that prove a baud rate."""

ASKED = 3
"""Number of times that the identification is asked for. The question or its answer may be lost."""

TRIES = 5
"""Number of lines that are sent to see whether the board answers."""


def baud(board: Board) -> Finding:
    """Find the baud rate at which the board answers. Ends the check if there is none."""
    configured = board.mcu.baud_rate
    if board.baud_rate != configured:
        board.open(configured)  # the board restarted while another rate was being tried
    if _knock(board, BOOT_S):  # the wait is long because opening the port resets many boards
        return manual.find("baud rate: right", {"mcu.baud_rate": configured}, rate=configured)
    heard = board.heard
    for rate in (rate for rate in reversed(get_args(Baud)) if rate != configured):
        board.open(rate)
        if _knock(board, OTHER_S):
            seen = {"rate": rate, "configured": configured, "heard": heard.counted}
            return manual.find("baud rate: other", {"mcu.baud_rate": rate}, **seen)
    board.open(configured)
    told = manual.find(f"baud rate: {heard.looks}", heard=heard.counted, configured=configured)
    raise StoppedError(told)


def _knock(board: Board, seconds: float) -> bool:
    """Send zeros in both forms until enough good replies have arrived."""
    end_s = board.now_s + seconds
    while board.now_s < end_s:
        board.zeros()
        # Firmware that has accepted a checked line since it booted refuses plain ones.
        board.wire.send(seal(board.line(ZERO), 0))
        board.listen(max(GLANCE_S / 4, 5 * board.period_s))
        if len(board.replies) >= ENOUGH:
            board.sealed = all(b"#" in reply.line for reply in board.replies)
            return True
    return False


def identity(board: Board) -> Finding:
    """Ask for the board's identification.

    Ends the check if the answer is an echo of the question.
    """
    board.others.clear()
    for _ in range(ASKED):
        board.restarts.asked(board.now_s)
        board.wire.send(b"\r\n?\r\n")
        board.listen(1.5 * GLANCE_S)
        if any(line.startswith(IDENTITY) or line == b"?" for line in board.others):
            break
    for line in board.others:
        if line.startswith(IDENTITY):
            text = line.decode("ascii", "replace").removeprefix("!")
            words = text.split()
            board.identity = dict(word.split("=", 1) for word in words[2:] if "=" in word)
            return manual.find("identification: named", short=" ".join(words[:2]), text=text)
    if b"?" in board.others:
        raise StoppedError(manual.find("identification: echo"))
    return manual.find("identification: none")


def form(board: Board) -> Finding | None:
    """Check whether the board answers the configured form of line.

    Returns None if it does, or if that cannot be determined.
    """
    if board.own_clock or _answers(board, board.comma) or not _answers(board, not board.comma):
        return None
    if _answers(board, board.comma):
        return None  # the board had only been delayed
    board.comma = not board.comma
    return _comma_wrong(board, "refused")


def _answers(board: Board, comma: bool) -> list[Reply]:
    return [reply for _, reply in board.answers(TRIES, GLANCE_S / 6, comma)]


def comma(board: Board, dead: bool) -> Finding:
    """Judge whether the last motor needs the other form of the comma at the end of the line.

    `dead` says that no movement of the last motor was seen, or that it could not be judged.
    """
    if board.comma != board.mcu.trailing_comma:
        return _comma_wrong(board, "latched" if board.latched and board.comma else "disobeyed")
    if dead:
        return manual.find("trailing comma: dead")
    how = "sent" if board.comma else "not sent"
    return manual.find(f"trailing comma: {how}", {"mcu.trailing_comma": board.comma})


def _comma_wrong(board: Board, how: str) -> Finding:
    """Return the finding that the configured form is wrong.

    `board.comma` is already the right one.
    """
    return manual.find(
        f"trailing comma: {how}",
        {"mcu.trailing_comma": board.comma},
        figure="needed" if board.comma else "refused",
        form="with" if board.comma else "without",
        comma="true" if board.comma else "false",
        last=motor_name(board.mcu, 3),
    )


def replies(board: Board) -> Finding:
    """Judge the form of the replies. The host can read every form that is named here."""
    lines = [reply.line.partition(b"#")[0] for reply in board.replies]
    forms = {"spaces": rb", ", "unpadded": rb"[pn]\d\.", "trailing comma": rb", *\Z"}
    found = [name for name, sign in forms.items() if any(re.search(sign, line) for line in lines)]
    if not all(re.search(rb"\.\d\d,? *\Z", line) for line in lines):
        found.append("other decimals")
    if not found:
        return manual.find("reply form: right")
    return manual.find("reply form: other", forms=", ".join(found), line=lines[-1].decode())


def check(board: Board) -> Finding:
    """Find out whether the board knows the checked link and the sample fields.

    From here on the check uses those that it knows.
    """
    wanted = board.mcu.link_check
    board.sealed = board.sampled = True
    if not any(reply.reading for reply in _answers(board, board.comma)):
        board.sampled = False
        board.sealed = bool(_answers(board, board.comma))
    if not board.sealed and wanted == "require":
        return manual.find("checked link: required", {"mcu.link_check": "auto"})
    if not board.sealed:
        return manual.find("checked link: plain")
    outcome, use = ("off", "auto") if wanted == "off" else ("in use", wanted)
    figure = "checked, with samples" if board.sampled else "checked"
    return manual.find(f"checked link: {outcome}", {"mcu.link_check": use}, figure=figure)

"""Steps that find out how the board communicates; no motor turns.

They find the baud rate, the form of the lines, the checked link, and the rate and delay of the
replies. They store their results in the `Board`, for the later steps.
"""

from __future__ import annotations

import re
from statistics import fmean, median
from typing import get_args

from msgspec.structs import asdict, replace

from acsard.checkup import lateness, motion, outcomes
from acsard.checkup.board import Board
from acsard.checkup.findings import Finding, StoppedError, motor_name
from acsard.checkup.motion import BOOT_S, SHORT_MEASUREMENT_S, WATCHDOG_SILENCE_S, BoardReply
from acsard.core.codes import CODES
from acsard.core.config.settings import MAX_REPLY_PERIOD_S, Baud, WheelMap
from acsard.core.config.wire_time import COMFORTABLE_USE, highest_rate, line_bytes
from acsard.core.formatting import printable_bytes
from acsard.core.link.board_status import IDENTITY
from acsard.core.link.checked_line import seal
from acsard.core.link.link_diagnosis import MAX_SHOWN_BYTES, is_text
from acsard.core.link.link_state import GOOD_LINES
from acsard.core.values import TWO_WHEELS, WHEELS


def baud(board: Board) -> Finding:
    """Find the baud rate at which the board answers, and leave the port at this rate.

    The configured rate is tried first. Raises `StoppedError` if the board answers at no rate.
    """
    configured = board.mcu.baud_rate
    if board.baud_rate != configured:
        # The board restarted while another baud rate was tried.
        board.open(configured)
    # The wait is long, because opening the port resets many boards.
    if _knock(board, BOOT_S):
        return outcomes.find("baud rate: right", {"mcu.baud_rate": configured}, rate=configured)
    data = board.traffic
    if finding := _other_motors(board):
        return finding
    for rate in (rate for rate in reversed(get_args(Baud)) if rate != configured):
        board.open(rate)
        if _knock(board, 0.6):
            return outcomes.find(
                "baud rate: other",
                {"mcu.baud_rate": rate},
                rate=rate,
                configured=configured,
                heard=data.counted,
            )
        if finding := _other_motors(board):
            return finding
    board.open(configured)
    # The daemon says the same about bytes that are no good lines.
    why = data.reason(f"at {configured} baud {{}}; no good line at any other rate")
    figure = CODES[why.code].figure
    raise StoppedError(Finding("baud rate", "FAIL", figure, why.text, why.advice, {}, why.code))


def _other_motors(board: Board) -> Finding | None:
    # Firmware rejects lines with another number of values, and need not say so.
    mcu, four = board.mcu, len(board.letters) == len(WHEELS)
    wheels = WheelMap(right="+a", left="+b") if four else WheelMap()
    board.take_motors(replace(mcu, wheels=wheels))
    answered = False
    try:
        answered = _knock(board, 0.6)
    finally:  # the board may restart meanwhile
        if not answered:
            board.take_motors(mcu)
    if not answered:
        return None
    return outcomes.find(
        "baud rate: other motors",
        {"mcu.baud_rate": board.baud_rate}
        | {f"mcu.wheels.{name}": motor for name, motor in asdict(wheels).items()},
        rate=board.baud_rate,
        motors=len(wheels.names),
        line=board.example,
        configured=len(mcu.wheels.names),
        entries=" and ".join(f'{name} = "{getattr(wheels, name)}"' for name in TWO_WHEELS),
    )


def _knock(board: Board, seconds: float) -> bool:
    end_s = board.now_s + seconds
    while board.now_s < end_s:
        board.zeros()
        # Firmware with the checked link refuses plain lines once it has accepted a checked line.
        board.wire.send(seal(board.line(board.zero), 0))
        board.listen(max(SHORT_MEASUREMENT_S / 4, 5 * board.period_s))
        if len(board.replies) >= 3:
            board.sealed = all(b"#" in reply.line for reply in board.replies)
            return True
    return False


def identity(board: Board) -> Finding:
    """Ask for the board's identification, and store its `NAME=VALUE` fields in the `Board`.

    A board need not have one. Raises `StoppedError` if the port only echoes the request.
    """
    board.unrecognized_lines.clear()
    # Ask up to three times, because the question or its answer may be lost.
    for _ in range(3):
        board.restarts.record_request(board.now_s)
        board.wire.send(b"\r\n?\r\n")
        board.listen(1.5 * SHORT_MEASUREMENT_S)
        if any(line.startswith(IDENTITY) or line == b"?" for line in board.unrecognized_lines):
            break
    for line in board.unrecognized_lines:
        if line.startswith(IDENTITY):
            text = line.decode("ascii", "replace").removeprefix("!")
            words = text.split()
            board.identity = dict(word.split("=", 1) for word in words[2:] if "=" in word)
            return outcomes.find("identification: named", short=" ".join(words[:2]), text=text)
    if b"?" in board.unrecognized_lines:
        raise StoppedError(outcomes.find("identification: echo"))
    return outcomes.find("identification: none")


def form(board: Board) -> Finding | None:
    """Find out whether a wrong `mcu.trailing_comma` keeps the board from answering.

    If so, use the other ending from now on, and return a finding; else return None.
    """
    if _answers(board, board.comma) or not _answers(board, not board.comma):
        return None
    if _answers(board, board.comma) or board.listen(WATCHDOG_SILENCE_S):
        # The replies to the first lines were only late, or the board reports by its own clock.
        return None
    board.comma = not board.comma
    return _comma_wrong(board, "trailing comma: refused")


def _answers(board: Board, comma: bool) -> list[BoardReply]:
    return [reply for _, reply in board.answers(5, SHORT_MEASUREMENT_S / 6, comma)]


def comma(board: Board, kind: str) -> Finding:
    """Return the finding about `mcu.trailing_comma`, after the test of the last motor.

    Some firmware turns or stops the last motor only if the line ends with a comma. `kind` is that
    of this motor.
    """
    if board.comma != board.mcu.trailing_comma:
        latched = board.latched and board.comma
        return _comma_wrong(
            board, "trailing comma: latched" if latched else "trailing comma: disobeyed"
        )
    if kind == "late":
        return lateness.finding("trailing comma", board.lateness.since(0.0))
    if kind == "dead":
        return outcomes.find("trailing comma: dead", last=board.letters[-1])
    return outcomes.find(
        "trailing comma: sent" if board.comma else "trailing comma: not sent",
        {"mcu.trailing_comma": board.comma},
    )


def _comma_wrong(board: Board, outcome: outcomes.Outcome) -> Finding:
    return outcomes.find(
        outcome,
        {"mcu.trailing_comma": board.comma},
        figure="needed" if board.comma else "refused",
        form="with" if board.comma else "without",
        comma="true" if board.comma else "false",
        last=motor_name(board.mcu, len(board.letters) - 1),
    )


def replies(board: Board) -> Finding:
    """Compare the replies with the documented form; the daemon can read other forms too."""
    texts = [line for line in board.unrecognized_lines if is_text(line) and line[:1] != b"!"]
    if texts:
        return outcomes.find(
            "reply form: text"
            if board.longest_run >= GOOD_LINES
            else "reply form: only text between",
            text=printable_bytes(texts[-1], MAX_SHOWN_BYTES),
            texts=len(texts),
            lines=len(texts) + len(board.replies),
            least=GOOD_LINES,
        )
    lines = [reply.line.partition(b"#")[0] for reply in board.replies]
    forms = {"spaces": rb", ", "unpadded": rb"[pn]\d\.", "trailing comma": rb", *\Z"}
    names = [name for name, sign in forms.items() if any(re.search(sign, line) for line in lines)]
    if not all(re.search(rb"\.\d\d,? *\Z", line) for line in lines):
        names.append("other decimals")
    if not names:
        return outcomes.find("reply form: right")
    line = lines[-1].decode()
    return outcomes.find(
        "reply form: other", forms=", ".join(names), line=line, example=board.example
    )


def check(board: Board) -> Finding:
    """Find out whether the board supports the checked link, and whether it can send samples.

    A sample has the board's clock and encoder counts.
    """
    wanted = board.mcu.link_check
    board.sealed = board.sampled = True
    if not any(reply.reading for reply in _answers(board, board.comma)):
        board.sampled = False
        board.sealed = bool(_answers(board, board.comma))
    if not board.sealed and wanted == "on":
        return outcomes.find("checked link: missing", {"mcu.link_check": "off"})
    if not board.sealed:
        return outcomes.find("checked link: plain")
    return outcomes.find(
        "checked link: off" if wanted == "off" else "checked link: in use",
        {"mcu.link_check": "on"},
        figure="checked, with samples" if board.sampled else "checked",
    )


def rate(board: Board) -> Finding:
    """Measure how often the board replies, and whether it reports by its own clock."""
    board.paced = True
    board.listen(SHORT_MEASUREMENT_S / 4)
    unasked = board.listen(WATCHDOG_SILENCE_S)
    # Late replies to earlier lines arrive almost at the same time, unlike reports.
    board.own_clock = bool(unasked) and unasked[-1].at_s - unasked[0].at_s > SHORT_MEASUREMENT_S
    highest_hz = highest_rate(
        board.baud_rate, line_bytes(len(board.letters), board.comma), COMFORTABLE_USE
    )
    period_s, before = 1 / min(board.rate_hz, highest_hz), board.sent_lines
    answers = board.drive(board.zero, 0.5, period_s)
    if len(answers) < 10:
        answers += board.drive(board.zero, 1.0, period_s)
    if len(answers) < 2:
        return outcomes.find("reply rate: none")
    gaps = motion.gaps(answers)
    board.gap_s = gap_s = fmean(gaps)
    configured, answered = board.mcu.reply_period, len(answers) / (board.sent_lines - before)
    unset_s = max(0.1, 4 * period_s)  # the silence that the host allows by default
    quiet_s = max(unset_s, 3 * configured)
    slow, lossy = 3 * gap_s > 1.1 * quiet_s, not board.own_clock and answered < 0.8
    most_s = MAX_REPLY_PERIOD_S
    rare, period = slow and gap_s > most_s, min(float(f"{gap_s:.1g}"), most_s)
    keys: dict[str, object] = {"mcu.reply_period": period if slow else configured}
    outcome: outcomes.Outcome = "reply rate: right"
    if rare:
        outcome = "reply rate: rare"
    elif slow:
        outcome = "reply rate: slow"
    elif lossy:
        outcome = "reply rate: lossy"
    return outcomes.find(
        outcome,
        keys if 3 * gap_s > 1.1 * unset_s and not rare else {},
        rate=1 / gap_s,
        way="by its own clock" if board.own_clock else "as answers to lines",
        longest=max(gaps) * 1000,
        answered=answered,
        gap=gap_s * 1000,
        quiet=quiet_s * 1000,
        period=period,
        most=most_s,
    )


def trip(board: Board) -> Finding:
    """Measure the time from a line to its reply; skipped for a free-running board."""
    if not board.paced:
        return lateness.finding("round trip", board.lateness.since(0.0))
    if board.own_clock:
        return outcomes.find("round trip: own clock")
    trips = [trip_s for trip_s, _ in board.answers(10, SHORT_MEASUREMENT_S)]
    if not trips:
        return outcomes.find("round trip: none")
    middle_s, longest_s = median(trips), max(trips)
    # An MCU usually takes 1 to 5 ms; beyond 8 ms it delays the control loop.
    slow = middle_s > 0.008 + 2 * board.line_s
    return outcomes.find(
        "round trip: slow" if slow else "round trip: right",
        middle=middle_s * 1000,
        longest=longest_s * 1000,
    )

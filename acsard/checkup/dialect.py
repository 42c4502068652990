"""The microcontroller's language: baud rate, who it is, how and how often it answers, the check.

Sends zeros and questions only; what is found here is used by the steps after it.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import pairwise
from statistics import fmean, median
from typing import get_args

from acsard.checkup.bench import PERIOD_S, ZERO, Bench
from acsard.checkup.findings import Finding, StoppedError
from acsard.checkup.motion import Reply
from acsard.config.baud import COMFORTABLE_USE, highest_rate, line_bytes
from acsard.config.settings import Baud
from acsard.mcu.check import seal
from acsard.mcu.session import IDENTITY
from acsard.values import NS_PER_S

BOOT_S = 3.0
"""Opening the port resets many boards, and their bootloader waits about two seconds."""

OTHER_S = 0.6
"""How long each other baud rate is tried."""

ENOUGH = 3
"""Good replies that prove a baud rate."""

TRIES = 5
"""Lines that are sent to see whether they are answered."""

ANSWER_S = 0.25
"""An answer later than this is none."""

QUIET_S = 0.7
"""How long the line is left alone to see whether the MCU speaks by itself."""

ANSWERED = 0.8
"""Share of the lines; where less come back, some are lost or not answered."""

SLOW_S = 0.015
"""A round trip longer than the wire's time and this holds the control loop's news back."""

TRIPS = 20


def baud(bench: Bench) -> Finding:
    """At which rate it answers; ends the check when at none."""
    configured = bench.baud_rate
    if _knock(bench, BOOT_S):
        text = f"{configured} baud"
        return Finding("baud rate", "PASS", text, keys={"mcu.baud_rate": configured})
    heard = bench.heard_bytes
    for rate in (rate for rate in reversed(get_args(Baud)) if rate != configured):
        bench.open(rate)
        if _knock(bench, OTHER_S):
            return Finding(
                "baud rate",
                "FAIL",
                f"{rate}, not {configured} baud",
                f"{_amount(heard)} at the configured {configured} baud; good lines at {rate}",
                f"write mcu.baud_rate = {rate}; the check goes on with it",
                {"mcu.baud_rate": rate},
            )
    bench.open(configured)
    raise StoppedError(
        Finding(
            "baud rate",
            "FAIL",
            f"{_amount(heard)} at {configured} baud",
            "no good line at any baud rate",
            "is it the right port (`acsard ports`), is the board powered, does the firmware "
            "answer, are TX and RX crossed?",
        )
    )


def _amount(heard: int) -> str:
    return "only garbage" if heard else "nothing"


def _knock(bench: Bench, seconds: float) -> bool:
    """Zeros in both forms until it has answered often enough."""
    wire = bench.wire
    end_ns = wire.now_ns() + int(seconds * NS_PER_S)
    while wire.now_ns() < end_ns:
        bench.zeros()
        # For firmware that has taken a checked line since it booted, and refuses others since.
        bench.wire.send(seal(bench.line(ZERO), 0))
        bench.listen(max(0.05, 5 * bench.period_s))
        if len(bench.replies) >= ENOUGH:
            bench.sealed = all(b"#" in reply.line for reply in bench.replies)
            return True
    return False


def identity(bench: Bench) -> Finding:
    """Who it says it is; ends the check when it only says what we say."""
    bench.others.clear()
    bench.wire.send(b"\r\n?\r\n")
    for _ in range(6):
        bench.listen(ANSWER_S / 5)
        named = [line for line in bench.others if line.startswith(IDENTITY)]
        if named:
            text = named[0].decode("ascii", "replace").removeprefix("!")
            bench.identity = dict(w.split("=", 1) for w in text.split()[2:] if "=" in w)
            return Finding("identification", "PASS", " ".join(text.split()[:2]), text)
    if b"?" in bench.others:
        raise StoppedError(
            Finding(
                "identification",
                "FAIL",
                "an echo",
                "what comes back is what was sent: no microcontroller speaks here",
                "are TX and RX joined? is the firmware one that echoes its input?",
            )
        )
    return Finding("identification", "PASS", "none", "it does not name itself, and need not")


def comma(bench: Bench) -> Finding | None:
    """Whether it answers the configured form of line at all; None when it does, or cannot tell."""
    if bench.own_clock or _answers(bench, bench.comma):
        return None
    other = not bench.comma
    if not _answers(bench, other):
        return None
    bench.comma = other
    word = "true" if other else "false"
    return Finding(
        "trailing comma",
        "FAIL",
        "needed" if other else "refused",
        f"it answers lines {'with' if other else 'without'} a comma at their end only",
        f"write mcu.trailing_comma = {word}; the check goes on with it",
        {"mcu.trailing_comma": other},
    )


def _answers(bench: Bench, trailing: bool) -> bool:
    bench.listen(0.05)
    got: list[Reply] = []
    for _ in range(TRIES):
        bench.send(ZERO, trailing)
        got += bench.listen(max(0.03, bench.period_s))
    return bool(got)


def forms(bench: Bench) -> Finding:
    """How its replies are written; every form here is one the host reads."""
    replies = bench.drive(ZERO, 0.1) or bench.drive(ZERO, 0.4) or bench.replies
    lines = [reply.line.partition(b"#")[0] for reply in replies]
    found = []
    if any(b", " in line for line in lines):
        found.append("spaces")
    if any(re.search(rb"[pn]\d\.", line) for line in lines):
        found.append("unpadded")
    if any(line.rstrip().endswith(b",") for line in lines):
        found.append("trailing comma")
    if any(not re.search(rb"[pn]\d+\.\d\d,? *\Z", line) for line in lines):
        found.append("other decimals")
    if not found:
        return Finding("reply form", "PASS", "as documented")
    return Finding(
        "reply form",
        "WARN",
        ", ".join(found),
        f"replies look like {lines[-1].decode()!r}: read all the same",
        "nothing to do; `ap00.00,bp00.00,cp00.00,dp00.00` is shorter on the wire, and certain",
    )


def pace(bench: Bench) -> Iterator[Finding]:
    """How often it answers while lines go out, of itself, and how soon."""
    bench.listen(0.05)
    bench.own_clock = len(bench.listen(QUIET_S)) >= 2
    period_s = max(1 / bench.rate_hz, 1 / _highest_hz(bench))
    before = bench.sent_lines
    replies = bench.drive(ZERO, 0.5, period_s=period_s)
    if len(replies) < 10:
        replies += bench.drive(ZERO, 1.0, period_s=period_s)
    gaps = [(b.at_ns - a.at_ns) / NS_PER_S for a, b in pairwise(replies)]
    bench.gap_s = fmean(gaps or [0.0])
    answered = len(replies) / max(1, bench.sent_lines - before)
    yield _rate(bench, period_s, max(gaps or [0.0]), answered)
    yield _trip(bench)


def _highest_hz(bench: Bench) -> int:
    """Lines per second that the wire carries."""
    return highest_rate(bench.baud_rate, line_bytes(bench.comma), COMFORTABLE_USE)


def _line_s(bench: Bench) -> float:
    """What the wire needs for a line."""
    return bench.period_s if bench.period_s > PERIOD_S else 0.0


def _rate(bench: Bench, period_s: float, longest_s: float, answered: float) -> Finding:
    gap_s = bench.gap_s
    way = "by its own clock" if bench.own_clock else "when spoken to"
    if not gap_s:
        text, mend = "lines go unanswered", "the firmware must answer every line, or by its clock"
        return Finding("reply rate", "FAIL", "too few replies", text, mend)
    figure = f"{1 / gap_s:.0f} Hz, {way}"
    quiet_s = max(0.1, 4 * period_s, 3 * bench.mcu.reply_period)
    period = float(f"{gap_s:.1g}")
    if 3 * gap_s > 1.1 * quiet_s:
        return Finding(
            "reply rate",
            "FAIL",
            figure,
            f"one reply in {gap_s * 1000:.0f} ms: the host takes {quiet_s * 1000:.0f} ms of "
            "silence for a lost link",
            f"write mcu.reply_period = {period:g}, or have every line answered",
            {"mcu.reply_period": period},
        )
    keys: dict[str, object] = {}
    if bench.mcu.reply_period and 3 * gap_s > 0.11:
        keys = {"mcu.reply_period": bench.mcu.reply_period}
    if not bench.own_clock and answered < ANSWERED:
        text = f"only {answered:.0%} of the lines were answered"
        return Finding("reply rate", "WARN", figure, text, "odometry is as fine as this", keys)
    return Finding("reply rate", "PASS", figure, f"longest gap {longest_s * 1000:.0f} ms", "", keys)


def _trip(bench: Bench) -> Finding:
    if bench.own_clock:
        text = "it answers by its own clock: a reply says nothing of the line before it"
        return Finding("round trip", "SKIPPED", "", text)
    trips: list[float] = []
    for _ in range(TRIPS):
        # No reply to an earlier line may be taken for this one's.
        bench.listen(0.0 if trips and bench.gap_s <= 2 * bench.period_s else 2 * ANSWER_S / 3)
        bench.send(ZERO)
        sent_ns, deadline_ns = bench.sent_ns, bench.sent_ns + int(ANSWER_S * NS_PER_S)
        got: list[Reply] = []
        while not got and bench.wire.now_ns() < deadline_ns:
            got = bench.listen(0.002)
        trips += [(reply.at_ns - sent_ns) / NS_PER_S for reply in got[:1]]
    if not trips:
        return Finding("round trip", "SKIPPED", "", "no line by itself was answered")
    middle, longest = median(trips), max(trips)
    figure = f"p50 {middle * 1000:.1f} ms, max {longest * 1000:.1f} ms"
    if middle > SLOW_S + 2 * _line_s(bench):
        mend = "an FTDI chip holds bytes back for 16 ms unless its latency_timer is 1 (`doctor`)"
        return Finding("round trip", "WARN", figure, "news of the wheels come late", mend)
    return Finding("round trip", "PASS", figure)


def check(bench: Bench) -> Finding:
    """Whether it knows the checked link and the sample fields; from here on they are used."""
    wanted = bench.mcu.link_check
    bench.sealed = True
    for bench.sampled in (True, False):
        if _sealed_answers(bench):
            break
    else:
        bench.sealed = False
        text = "the firmware answers plain: a damaged line can say a wrong speed"
        if wanted == "require":
            mend = 'write mcu.link_check = "auto", or give the board firmware that knows the check'
            return Finding("checked link", "FAIL", "none", text, mend, {"mcu.link_check": "auto"})
        return Finding("checked link", "SKIPPED", "plain", text)
    figure = "checked, with samples" if bench.sampled else "checked"
    keys: dict[str, object] = {"mcu.link_check": "auto" if wanted == "off" else wanted}
    text = "" if wanted != "off" else "supported, and not in use: the lines below switch it on"
    return Finding("checked link", "PASS", figure, text, "", keys)


def _sealed_answers(bench: Bench) -> bool:
    """Whether lines with a suffix are answered with one, and with the sample if asked for it."""
    before = len(bench.replies)
    for _ in range(TRIES):
        bench.send(ZERO)
        bench.listen(max(0.03, 1.5 * bench.period_s))
    got = bench.replies[before:]
    if bench.sampled:
        return any(reply.reading is not None for reply in got)
    return bool(got)

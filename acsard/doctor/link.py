"""Examines the link to the microcontroller by comparing two states of the daemon."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from acsard.config.settings import Config
from acsard.doctor.finding import Finding
from acsard.doctor.running import Running
from acsard.formatting import many
from acsard.mcu.whose_silence import BUSY, is_ours

LOST = 0.02
"""Largest fraction of lines that may be lost. A sound link loses none."""

DAY_S = 86400.0

ENOUGH = 40
"""Number of lines sent between both states from which on the fraction of losses is meaningful."""


def link(running: Running) -> Iterator[Finding]:
    """Yield findings about the link, by the counters and reports of the daemon."""
    config, state = running.config, running.state
    mend = check(running)
    if state.link != "up":
        if state.link == "down":
            mend = "see the port above" if running.here else "`acsard doctor` there: its port"
        if config.mcu.simulated or is_ours(state.reason):
            mend = BUSY
        text = f"{state.link}: {state.reason}" if state.mode == "waiting" else state.link
        yield Finding("link", "failure", text, mend)
        return
    passed = {
        key: count - running.before.counters.get(key, 0) for key, count in state.counters.items()
    }
    # A fault that occurs at most once a day on average is history. One that is more frequent is a
    # warning.
    often = state.counters.get("lines_sent", 0) / config.rate_hz / DAY_S
    # The built-in simulator is late whenever the daemon is, and it is never unplugged.
    if late := state.counters.get(f"link_lost{'' if config.mcu.simulated else '_late'}", 0):
        text = (
            f"lost {many(late, 'time')} since the daemon's start because this computer did not run"
        )
        yield Finding("link", "warning" if late > often else "ok", text, BUSY)
    problems = [*lost(passed, config), *(refused(passed) or refused(state.counters))]
    for text in problems:
        yield Finding("link", "warning", text, mend)
    went = [] if config.mcu.simulated else gone(state.counters)
    for times, text in went:
        yield Finding("link", "warning" if times > often else "ok", text, mend)
    if not problems and not late and not went:
        yield Finding("link", "ok", "up, and no line is lost")
    if state.doubt:
        yield Finding("wheels", "warning", state.doubt, mend)


def lost(passed: Mapping[str, int], config: Config) -> Iterator[str]:
    """Yield a warning if too few of the lines sent between the two states were answered."""
    sent, came = passed.get("lines_sent", 0), passed.get("lines", 0)
    if config.mcu.reply_period or sent < ENOUGH or came >= (1 - LOST) * sent - 1:
        return
    yield (
        f"of {sent} lines that were sent in a second {came} were answered: the others are lost on "
        "the way there or back, or it reports by its own clock"
    )


def refused(counters: Mapping[str, int]) -> list[str]:
    """Return a warning about refused lines if there are too many of them."""
    kinds = {
        name.removeprefix("line_"): count
        for name, count in counters.items()
        if name.startswith("line_") and count
    }
    if sum(kinds.values()) <= LOST * max(1, counters.get("lines", 0)):
        return []
    told = ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in kinds.items())
    return [f"lines of the microcontroller that did not count: {told}"]


def gone(counters: Mapping[str, int]) -> list[tuple[int, str]]:
    """Return the number of lost links that this computer did not cause, with a description."""
    times = counters.get("link_lost", 0) - counters.get("link_lost_late", 0)
    text = (
        f"it was lost {many(times, 'time')} since the daemon's start: the board starts anew, is "
        "silent at times or was unplugged; the log says when (link_stale, link_down)"
    )
    return [(times, text)] if times > 0 else []


def check(running: Running) -> str:
    """Return the command that examines the board more closely, and its preconditions."""
    port = running.config.mcu.port
    return (
        f"`acsard mcu check --port {port}` finds out why, wheels lifted; stop the daemon first: "
        f"systemctl stop acsard, or kill {running.info.pid}"
    )

"""Messages about the link and the check in force, for `state.reason`, the log and the web page."""

from __future__ import annotations

from acsard.core.link.host_stalls import Lateness
from acsard.core.link.link_state import Link
from acsard.core.link.negotiation import MENDS, Negotiation
from acsard.core.link.silence_diagnosis import SilenceDiagnosis
from acsard.core.values import Event

BLOCKED = (
    "the serial port sends nothing, because its driver accepts no bytes: unplug the "
    "adapter and plug it in again"
)
"""The reason while the driver takes no bytes."""


def damaged(link: Link, check: Negotiation) -> bool:
    """Return whether the check is being asked for because replies came damaged."""
    return link.damaged and check.asking


def words(
    link: Link,
    check: Negotiation,
    hearing: SilenceDiagnosis,
    lateness: Lateness,
    longest_reply: float,
) -> str:
    """Return a sentence about the link of an open port.

    `longest_reply` is the largest value of mcu.reply_period, s.
    """
    if link.state in ("booting", "stale"):
        heard = hearing.heard
        if check.trouble:
            return MENDS[check.trouble]
        if heard is not None and not heard.good:
            return heard.words
        if damaged(link, check):
            return (
                "the microcontroller's replies arrive damaged; the daemon asks it for the "
                "check again"
            )
        if link.sparse_s:
            return _sparse(link.sparse_s, longest_reply)
        if heard is not None:
            return heard.words
    return lateness.words(link.state)


def _sparse(sparse_s: float, longest_reply: float) -> str:
    apart = f"{sparse_s:.2f}"
    told = f"the microcontroller's lines come {apart} s apart"
    if float(apart) > longest_reply:
        return (
            f"{told}, which is too seldom for any setting; firmware that reports by its own "
            f"clock must send a line at least every {longest_reply:g} s"
        )
    return f"{told}; if it reports by its own clock, set mcu.reply_period = {apart}"


def check_event(check: Negotiation, wants_samples: bool) -> Event:
    """Return the event for a newly agreed check, as a warning if it is less than was asked for."""
    fallen = check.state == "plain" or (wants_samples and check.state == "checked")
    text = f"the serial lines are {check.in_force}"
    if check.state == "plain":
        text += ": the microcontroller answers without the check"
    elif fallen:
        text += ": the microcontroller sends no counts"
    return Event("link_check", text, "warning" if fallen else "info")

"""What `acsard drive` shows of the robot, as lines of text for any width; pure.

It needs no library: a terminal gets them as a screen (`terminal.py`), all else one line at a time.
"""

from __future__ import annotations

from collections.abc import Sequence
from textwrap import wrap
from typing import Literal

from msgspec import Struct

from acsard.messages.schema import RobotState
from acsard.messages.short import place, speeds
from acsard.messages.text import printable

NARROWEST = 40

SILENT_S = 1.0
"""Without a state for so long there is no news."""

HELP = (
    " u  i  o    arrows drive, too",
    " j  k  l    space or k stops",
    " m  ,  .    Ctrl-C leaves",
    " q/z  both speeds +/- 10 %",
    " w/x  linear only    e/c  angular only",
)

Look = Literal["head", "mode", "news", "trouble", "help"]


class Teleop(Struct, frozen=True):
    """All that is shown."""

    robot_id: str
    endpoint: str
    source: str
    linear: float
    """What a key asks for, m/s."""
    angular: float
    """rad/s"""
    state: RobotState | None
    age: float
    """Since `state` came, or since we began to wait for one, s."""
    objection: str = ""
    """Why what the keys ask for does not drive."""


def lines(seen: Teleop, width: int, height: int | None = None) -> list[tuple[Look, str]]:
    """The screen, each line at most `width` long: the first with "mode" begins with the mode."""
    width = max(20, width)
    head = printable(f"{seen.robot_id} as {seen.source}  {seen.endpoint}")
    shown: list[tuple[Look, str]] = [
        ("head", head if len(head) <= width else head[: width - 1] + "…")
    ]
    if seen.age > SILENT_S or seen.state is None:
        shown += _wrapped("trouble", silence(seen), width)
    if seen.state is not None:
        state = seen.state
        shown += _wrapped("mode", f" {printable(state.mode).upper()}  {reason(state)}", width)
        if seen.objection:
            words = f"your keys do not drive: {printable(seen.objection)}"
            shown += _wrapped("trouble", words, width)
        shown += [("news", line) for line in flow(measured(state), width)]
    shown += [("news", line) for line in flow([f"keys ask {asked(seen)}"], width)]
    below: list[tuple[Look, str]] = [("help", line[:width]) for line in HELP]
    if height is None or len(shown) + len(below) < height:
        return [*shown, ("help", ""), *below]
    return [*shown[: max(1, height - len(below))], *below][:height]


def news(seen: Teleop, width: int) -> list[str]:
    """All of it but the help in few lines, broken between words and between figures."""
    told = [f"keys ask {asked(seen)}"]
    if seen.state is None or seen.age > SILENT_S:
        return _words([silence(seen), *told], width)
    if seen.objection:
        told.insert(0, f"your keys do not drive: {printable(seen.objection)}")
    why = f"{printable(seen.state.mode)}: {reason(seen.state)}"
    return _words([why, *told], width, measured(seen.state))


def parting(seen: Teleop, width: int) -> list[str]:
    """The same at the end: whether the robot that is left stands, and where."""
    if seen.state is None or seen.age > SILENT_S:
        return _words([f"left: {silence(seen)}"], width)
    what = "still moves" if moves(seen.state) else "stands"
    if seen.state.linear is None:
        what = "reports no speed"
    why = f"{printable(seen.state.mode)}: {reason(seen.state)}"
    return _words([f"left: the robot {what}", why], width, measured(seen.state))


def moves(state: RobotState) -> bool:
    """Return whether any measured speed differs from zero; a robot without feedback has none."""
    return any((state.linear, state.angular, *state.wheels))


def silence(seen: Teleop) -> str:
    """Nothing comes, and since when."""
    if seen.state is None and seen.age <= SILENT_S:
        return "waiting for the first state"
    return f"no word from the daemon for {seen.age:.0f} s: is it running?"


def reason(state: RobotState) -> str:
    """Why it moves or does not, without the mode in it."""
    return printable(state.reason.removeprefix(f"{state.mode}: "))


def asked(seen: Teleop) -> str:
    """What a key asks for."""
    return f"{seen.linear:.2f} m/s, {seen.angular:.2f} rad/s"


def measured(state: RobotState) -> list[str]:
    """Pose and twist, each with its unit."""
    return [*place(state.x, state.y, state.yaw), *speeds(state.linear, state.angular)]


def flow(parts: Sequence[str], width: int) -> list[str]:
    """As many in a line as fit."""
    found: list[str] = []
    for part in parts:
        if found and len(found[-1]) + 2 + len(part) <= width:
            found[-1] += f"  {part}"
        else:
            found.append(part[:width])
    return found


def _words(told: Sequence[str], width: int, figures: Sequence[str] = ()) -> list[str]:
    """Sentences and figures below each other, what goes on set in."""
    width = max(20, width)
    lines = wrap("; ".join(told), width, subsequent_indent="  ", break_on_hyphens=False)
    return [*lines, *(f"  {line}" for line in flow(figures, width - 2))]


def _wrapped(look: Look, text: str, width: int) -> list[tuple[Look, str]]:
    kept = wrap(text, width, subsequent_indent="  ", drop_whitespace=True, initial_indent="")
    return [(look, one) for one in kept]

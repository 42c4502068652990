"""The lines of text in which `acsard drive` shows the robot, for any width. This module is pure."""

from __future__ import annotations

from collections.abc import Sequence
from textwrap import wrap

from msgspec import Struct
from rich.text import Text

from acsard.core.formatting import printable
from acsard.core.messages.schema import RobotState
from acsard.core.messages.short_texts import place, speeds
from acsard.core.motion.modes import Mode
from acsard.top.text import MODES, flow

HELP = (
    " u  i  o    arrows drive, too",
    " j  k  l    space or k stops",
    " m  ,  .    Ctrl-C quits",
    " q/z  both speeds +/- 10 %",
    " w/x  linear only    e/c  angular only",
)


class Teleop(Struct, frozen=True):
    """Everything that `acsard drive` shows."""

    robot_id: str
    endpoint: str
    source: str
    linear: float
    """Forward speed that a key sets, m/s."""
    angular: float
    """Turn rate that a key sets, rad/s."""
    state: RobotState | None
    age: float
    """Seconds since `state` arrived, or since the wait for the first state began."""
    objection: str = ""
    """Reason why the robot does not follow the keys, or "" if it follows them."""
    silent: bool = False
    """True if the robot is silent, so the shown data is old."""


def lines(seen: Teleop, width: int, height: int | None = None) -> list[Text]:
    """Return the lines of the screen, at most `height` of at most `width` characters each.

    If `height` is None, the number of lines has no limit.
    """
    width = max(20, width)
    head = printable(f"{seen.robot_id} as {seen.source}  {seen.endpoint}")
    shown = [Text(head, "bold")]
    if seen.silent or seen.state is None:
        shown += _wrapped(silence(seen), width, "bold red")
    if seen.state is not None:
        state = seen.state
        mode = f" {printable(state.mode).upper()} "
        told = _wrapped(f"{mode} {reason(state)}", width, "bold")
        for first in told[:1]:
            first.stylize(MODES.get(state.mode, "reverse"), 0, len(mode))
        shown += told
        if seen.objection:
            shown += _wrapped(refused(seen.objection), width, "bold red")
        shown += flow(measured(state), width)
    shown.append(Text(f"keys ask for {asked(seen)}"))
    below = [Text(line, "dim") for line in HELP]
    if height is not None and len(shown) + len(below) >= height:
        shown = [*shown[: max(1, height - len(below))], *below][:height]
    else:
        shown += [Text(), *below]
    for line in shown:
        line.truncate(width, overflow="ellipsis")
    return shown


def news(seen: Teleop, width: int) -> list[str]:
    """Return the content of the screen, without the help, as lines for printed reports."""
    told = [f"keys ask for {asked(seen)}"]
    if seen.state is None or seen.silent:
        return _words([silence(seen), *told], width)
    if seen.objection:
        told.insert(0, refused(seen.objection))
    why = f"{printable(seen.state.mode)}: {reason(seen.state)}"
    return _words([why, *told], width, measured(seen.state))


def parting(seen: Teleop, width: int) -> list[str]:
    """Return the lines to print when `acsard drive` ends.

    They state whether the robot moves, its mode with the reason, and its pose and speeds.
    """
    if seen.state is None or seen.silent:
        return _words([f"drive ended: {silence(seen)}"], width)
    what = "still moves" if moves(seen.state) else "stands"
    if seen.state.linear is None:
        what = "reports no speed"
    why = f"{printable(seen.state.mode)}: {reason(seen.state)}"
    return _words([f"drive ended: the robot {what}", why], width, measured(seen.state))


def released(seen: Teleop) -> bool:
    """Return whether the robot stands and no longer follows the source of this drive.

    Return False if no state has arrived.
    """
    if seen.state is None or moves(seen.state):
        return False
    return seen.state.mode != Mode.DRIVING or seen.state.source != seen.source


def moves(state: RobotState) -> bool:
    """Return whether any measured speed differs from zero; False if no speed is known."""
    return any((state.linear, state.angular, *state.wheels))


def silence(seen: Teleop) -> str:
    """Return a sentence which says that no state has arrived yet, or none for some time."""
    if seen.state is None and not seen.silent:
        return "waiting for the first state message of the daemon"
    return f"nothing received from the daemon for {seen.age:.0f} s: does it run?"


def reason(state: RobotState) -> str:
    """Return the reason of the mode, without the name of the mode."""
    return printable(state.reason.removeprefix(f"{state.mode}: "))


def refused(objection: str) -> str:
    """Return a sentence which says why the robot does not follow the keys.

    `objection` is the reason. If the robot requires a zero command, the sentence also says how to
    send it with the keys.
    """
    mend = " (press space, then press the key again)" if "must send a zero" in objection else ""
    return f"your keys do not drive the robot: {printable(objection)}{mend}"


def asked(seen: Teleop) -> str:
    return f"{seen.linear:.2f} m/s, {seen.angular:.2f} rad/s"


def measured(state: RobotState) -> list[Text]:
    """Return pose and twist, each with its unit."""
    told = [*place(state.x, state.y, state.yaw), *speeds(state.linear, state.angular)]
    return [Text(one) for one in told]


def _words(told: Sequence[str], width: int, figures: Sequence[Text] = ()) -> list[str]:
    """Return lines with the sentences `told`, and below them lines with `figures`.

    No line has more than `width` characters. Wrapped lines are indented.
    """
    width = max(20, width)
    lines = wrap("; ".join(told), width, subsequent_indent="  ", break_on_hyphens=False)
    return [*lines, *(f"  {line}" for line in flow(figures, width - 2))]


def _wrapped(text: str, width: int, style: str) -> list[Text]:
    return [Text(line, style) for line in wrap(text, width, subsequent_indent="  ")]

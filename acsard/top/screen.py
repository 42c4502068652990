"""Builds one screen of `acsard top` from a robot's state, as lines of colored text.

This module is pure. It cuts all lines to the width of the terminal, so no message can break the
layout. If the terminal has too few lines, the screen first leaves out the empty lines, and then
some command sources.
"""

from __future__ import annotations

import math

from msgspec.structs import replace
from rich.console import Group
from rich.text import Text

from acsard.core.formatting import lasting, rough
from acsard.core.messages.schema import RobotState
from acsard.core.messages.state_warnings import WARNING, brief, warnings
from acsard.top import narrow_screen
from acsard.top import wide_screen as beside
from acsard.top.text import MODE_STYLES, ScreenData, clean, ends
from acsard.top.wide_screen import MAX_COLUMNS

MAX_SOURCES = 32


def screen(data: ScreenData, width: int, height: int | None = None) -> Group:
    """Return the screen of `acsard top`, in lines of `width` cells (20 to `MAX_COLUMNS`)."""
    width = max(20, min(MAX_COLUMNS, width))
    head = [_header(data, width), *(_no_news(data, width) if data.silent else _mode(data, width))]
    if data.state is not None:
        head += _warnings(data.state, width)
    sections: list[list[Text]] = []
    if data.state is not None:
        state = data.state
        parts = narrow_screen if width < narrow_screen.MIN_WIDE_COLUMNS else beside
        sections = [
            parts.motion(state if state.link == "up" else _unmeasured(state), width),
            parts.link(data, state, width),
            parts.timing(state, width),
        ]
        used = len(head) + sum(map(len, sections)) + 1
        room = MAX_SOURCES if height is None else max(1, min(MAX_SOURCES, height - used))
        sections.insert(1, parts.sources(state, room, width))
    used = len(head) + sum(map(len, sections))
    airy = height is None or height - used >= len(sections) - 1
    body = [line for part in sections for line in ([Text(), *part] if airy else part)]
    body = body[1:] if airy else body  # no empty line between the head and the first section
    if data.silent:
        for line in body:
            line.stylize("dim")
    lines = [*head, *body][:height]
    for line in lines:
        line.no_wrap = True
        line.truncate(width, overflow="ellipsis")
    return Group(*lines)


def _unmeasured(state: RobotState) -> RobotState:
    return replace(state, linear=math.nan, angular=math.nan, wheels=[])


def _header(data: ScreenData, width: int) -> Text:
    left = Text.assemble((clean(data.robot_id), "bold"), "  ", clean(data.endpoint))
    if data.info is not None:
        left.append(f"  acsard {clean(data.info.version)}", "dim")
    right = Text(f"seen {rough(data.age)} ago" if data.state is not None else "", "dim")
    if data.hint:
        right.append(f"   {data.hint}")
    return ends(left, right, width)


def _mode(data: ScreenData, width: int) -> list[Text]:
    # On a wide screen, always return two lines. Otherwise, the lines below would move when the
    # reason becomes long.
    state = data.state
    if state is None:
        return [Text("waiting for the first state message of the daemon", "yellow")]
    badge = Text(f" {clean(state.mode).upper()[:12]} ", MODE_STYLES.get(state.mode, "reverse"))
    words = clean(state.why)
    first, second = _split(words, width - badge.cell_len - 2)
    if width < narrow_screen.MIN_WIDE_COLUMNS:
        return [badge, *narrow_screen.folded(words, width, 2)]
    gap = " " * (badge.cell_len + 2)
    return [Text.assemble(badge, "  ", (first, "bold")), Text.assemble(gap, (second, "bold"))]


def _warnings(state: RobotState, width: int) -> list[Text]:
    problems = warnings(state)
    words = clean(f"{WARNING}: {problems[0]}" if len(problems) == 1 else brief(problems))
    wide = width >= narrow_screen.MIN_WIDE_COLUMNS
    lines = [Text(words)] if wide and words else narrow_screen.folded(words, width, 2)
    for line in lines:
        line.stylize("yellow")
    return lines


def _split(words: str, room: int) -> tuple[str, str]:
    if len(words) <= room:
        return words, ""
    at = words.rfind(" ", 0, room + 1)
    return (words[:at], words[at + 1 :]) if at > 0 else (words[:room], words[room:])


def _no_news(data: ScreenData, width: int) -> list[Text]:
    since = lasting(int(min(data.age, 1e9)))
    words = f"NOTHING RECEIVED FOR {since}: is the daemon running?"
    if data.undecodable:
        words = f"NOTHING READABLE FOR {since}: is the daemon a different version?"
    banner = Text(words.center(width), "bold white on red")
    blank = Text(" " * width, "on red")
    return [blank, banner, blank.copy()]

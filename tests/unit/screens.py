"""A usual screen of `acsard top`, as text and as sent to a terminal."""

from __future__ import annotations

import io
from types import SimpleNamespace
from typing import Any

from msgspec.structs import replace
from rich.console import Console, RenderableType

from acsard.core.messages.encodings import encode
from acsard.core.messages.schema import (
    Info,
    Latency,
    Message,
    RobotState,
    SourceState,
    Spread,
    Time,
)
from acsard.daemon.latencies import NAMES
from acsard.top.screen import ScreenData, screen

MEASURED = Latency(Spread(9000, 56.2, 112.2, 8000.0), Spread(6000, 63.1, 891.0, 9700.0))
UNMEASURED = Latency(Spread(0, 0.0, 0.0, 0.0), Spread(0, 0.0, 0.0, 0.0))

STATE = RobotState(
    stamp=Time(1000, 0),
    mode="driving",
    code="commanded",
    reason="commanded by app",
    x=1.25,
    y=-0.5,
    yaw=1.0,
    linear=0.5,
    angular=-0.6,
    wheels=[8.0, 12.0, 12.5, -7.5],
    link="up",
    source="app",
    sources=[
        SourceState("teleop", 100, None, "a command", "command"),
        SourceState("app", 50, 0.02, "", "nothing"),
        SourceState("nav", 10, 3.0, "app has priority: wait until it is silent", "higher"),
    ],
    refused="",
    counters={"lines": 1300, "lines_sent": 1301, "commands": 220, "missed_periods": 3},
    latencies=dict.fromkeys(NAMES, MEASURED),
    version="0.2.0",
)
BEFORE = replace(
    STATE,
    stamp=Time(999, 0),
    counters={"lines": 1200, "lines_sent": 1201, "commands": 200, "missed_periods": 3},
)
INFO = Info("acsar", "0.2.0", 7, "/dev/acsar", False, 100.0, [], [])
SEEN = ScreenData(
    "acsar", "tcp/127.0.0.1:7448", STATE, BEFORE, 0.05, INFO, 0, "q quits", passed=1.05
)


def drawn(shown: RenderableType, width: int = 80, *, colour: bool = False) -> str:
    """Return the text that a terminal of this width receives."""
    console = Console(
        width=width, file=io.StringIO(), force_terminal=colour, _environ={},
        color_system="256" if colour else None,
    )  # fmt: skip
    with console.capture() as captured:
        console.print(shown)
    return captured.get()


def lines_of(data: ScreenData, width: int = 80) -> list[str]:
    """Return the lines of the screen as a person reads them."""
    return drawn(screen(data, width), width).rstrip("\n").split("\n")


def of(**changes: object) -> ScreenData:
    """Return the usual screen with another state."""
    return replace(SEEN, state=replace(STATE, **changes))


def sample_of(message: Message, key: str = "acsard/acsar/state") -> Any:
    """Return a sample of the bus with this message."""
    return raw_sample(encode(message, "json"), key)


def raw_sample(payload: bytes, key: str = "acsard/acsar/state") -> Any:
    """Return a sample of the bus with this JSON."""
    content = SimpleNamespace(to_bytes=lambda: payload)
    return SimpleNamespace(key_expr=key, encoding="application/json", payload=content)

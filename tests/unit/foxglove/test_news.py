"""What is new in a state is a line of the log."""

from __future__ import annotations

from msgspec.structs import replace

from acsard.foxglove.news import News
from acsard.messages.schema import RobotState, Time

READY = RobotState(
    stamp=Time(7), mode="ready", reason="no commands", x=0, y=0, yaw=0, linear=0, angular=0,
    wheels=[], link="up", source="", sources=[], refused="", counters={},
)  # fmt: skip


def told(*states: RobotState) -> list[tuple[int, str, str]]:
    """The lines of the last of these."""
    news = News()
    lines = [news.of(state) for state in states][-1]
    assert all(line.stamp == states[-1].stamp for line in lines)
    return [(line.level, line.name, line.msg) for line in lines]


def test_the_first_state_tells_how_it_is() -> None:
    assert told(READY) == [(20, "mode", "ready: no commands")]


def test_the_same_again_is_no_news() -> None:
    assert told(READY, replace(READY, x=1.0, stamp=Time(8))) == []


def test_a_mode_is_told_with_its_reason_and_weight() -> None:
    stopped = replace(READY, mode="stopped", reason="stopped: by request")
    fault = replace(READY, mode="fault", reason="wheel a stuck")
    assert told(READY, stopped) == [(30, "mode", "stopped: by request")]
    assert told(READY, fault) == [(40, "mode", "fault: wheel a stuck")]


def test_a_refused_command_is_told_once_and_not_taken_back() -> None:
    refused = replace(READY, refused="cmd/app: NaN")
    assert told(READY, refused) == [(30, "refused", "cmd/app: NaN")]
    assert told(READY, refused, refused) == []
    assert told(refused, READY) == []


def test_a_doubt_begins_and_ends() -> None:
    doubt = replace(READY, doubt="the left side slips")
    assert told(READY, doubt) == [(30, "doubt", "the left side slips")]
    assert told(READY, doubt, READY) == [(20, "doubt", "over: the left side slips")]


def test_what_is_not_recorded_is_told() -> None:
    full = replace(READY, recording="the disk is full")
    assert told(READY, full) == [(30, "recording", "the disk is full")]

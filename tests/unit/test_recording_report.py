"""A report shows what the messages of a recording say, in one HTML file that loads nothing.

No text of a client becomes markup or code in it.
"""

from __future__ import annotations

import base64
import hashlib
import json
import math
import re
import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from functools import lru_cache
from html.parser import HTMLParser
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from msgspec import Struct
from msgspec.structs import replace

from acsard.core.config.settings import Config, McuConfig, WheelMap
from acsard.core.messages.schema import Odometry, RobotState, Time
from acsard.core.ros.channels import BY_KEY, CMD_VEL_IN, LOG_CHANNEL
from acsard.core.ros.shapes import LEVELS, Log, command_message
from acsard.core.values import NS_PER_S, Twist
from acsard.recording.file import Recording
from acsard.recording.html_report import COLOURS, MAX_EVENTS, MAX_ROWS, Drawing, Rows, page
from acsard.recording.published import Published, published
from tests.scenarios.taped import Tape, two_drivers
from tests.scenarios.world import World

EVIL = '</script><script>alert(1)</script><img src=x onerror="alert(2)">\'"&lt;\u202e\x00<!--'


@lru_cache
def drive_of_two(wheels: WheelMap = WheelMap()) -> tuple[Published, ...]:  # noqa: B008
    """Return the messages of a drive with two sources."""
    tape, config = Tape(), Config(mcu=McuConfig(wheels=wheels))
    two_drivers(World(config, recorder=tape))
    with tempfile.TemporaryDirectory() as place:
        return tuple(published(Recording([tape.save(Path(place) / "a.rec.zst", config)])))


def report(messages: Iterable[Published], title: str, notes: Sequence[str]) -> str:
    return page(Drawing(messages), title, notes)


def states() -> list[Published]:
    return [item for item in drive_of_two() if isinstance(item.message, RobotState)]


def event(text: str, name: str = "stop", at_ns: int = 0, level: str = "info") -> Published:
    line = Log(Time.from_ns(at_ns), LEVELS[level], name, text)
    return Published(LOG_CHANNEL, "", at_ns, line)


@lru_cache
def evil() -> str:
    """Return the report of a drive in which every text of unknown origin is hostile."""
    last = states()[-1]
    state = last.message
    hostile = replace(
        state,
        mode=EVIL,
        code=EVIL,
        reason=EVIL,
        link=EVIL,
        sources=[replace(state.sources[0], name=EVIL, waits_for=EVIL, wait="neutral", age=0.1)],
    )
    at_ns = last.wall_ns + NS_PER_S // 10
    command = command_message(Twist(), Time.from_ns(at_ns), "base_link")
    more = (
        Published(BY_KEY["state"], "", at_ns, hostile),
        Published(BY_KEY["state"], "", at_ns + 1, hostile),
        Published(CMD_VEL_IN, EVIL, at_ns + 1, command),
        event(EVIL, EVIL, at_ns + 2, "warning"),
    )
    return report([*drive_of_two(), *more], EVIL, [EVIL])


class PageElements(HTMLParser):
    """The elements of a page that a browser would see."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.scripts: list[tuple[dict[str, str | None], str]] = []
        self.words: list[str] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag == "script":
            self.scripts.append((dict(attrs), ""))

    def handle_data(self, data: str) -> None:
        if self.lasttag == "script" and data.strip():
            attrs, before = self.scripts[-1]
            self.scripts[-1] = attrs, before + data
        elif data.strip():
            self.words.append(data)


def pictures(text: str) -> dict[str, dict[str, Any]]:
    """Return the pictures of a report by name."""
    (data,) = re.findall(r'<script type="application/json" id="pictures">(.*?)</script>', text)
    return {figure["name"]: figure for figure in json.loads(data)}


def traces(text: str, name: str) -> list[dict[str, Any]]:
    """Return the curves, bars or marks with a name, in all pictures."""
    return [t for figure in pictures(text).values() for t in figure["data"] if t["name"] == name]


def test_text_of_a_client_never_becomes_markup_or_code() -> None:
    read = PageElements(evil())
    assert not {"img", "iframe", "object", "a", "link"} & {tag for tag, _ in read.tags}
    assert all(not name.startswith("on") for _, attrs in read.tags for name in attrs)
    assert [bool(text) for _, text in read.scripts] == [True, True, True]
    assert "<script>alert" not in evil()
    assert evil().count("</script") == 3
    assert "\u202e" not in evil()
    assert "\x00" not in evil()
    # A person can still read the hostile text: title, heading, note, and the event.
    assert sum("<script>alert(1)</script>" in words for words in read.words) >= 4


def test_texts_in_the_pictures_contain_no_markup_of_plotly() -> None:
    (data,) = [text for attrs, text in PageElements(evil()).scripts if attrs.get("id")]
    assert "<" not in data

    def texts(value: object) -> Iterator[str]:
        if isinstance(value, str):
            yield value
        elif isinstance(value, list | dict):
            for inner in value.values() if isinstance(value, dict) else value:
                yield from texts(inner)

    found = list(texts(json.loads(data)))
    assert len([text for text in found if "alert(1)" in text]) >= 5
    assert {tag for text in found for tag in re.findall(r"<[^>]*>", text)} <= {
        "<b>", "</b>", "<br>"
    }  # fmt: skip


def test_the_page_loads_nothing_and_runs_only_its_own_scripts() -> None:
    read = PageElements(evil())
    assert all(not {"src", "href"} & set(attrs) for _, attrs in read.tags)
    (policy,) = [attrs["content"] for _, attrs in read.tags if attrs.get("http-equiv")]
    assert policy is not None
    assert policy.startswith("default-src 'none'; ")
    programs = [body for attrs, body in read.scripts if "type" not in attrs]
    assert len(programs) == 2
    for program in programs:
        digest = base64.b64encode(hashlib.sha256(program.encode()).digest()).decode()
        assert f"'sha256-{digest}'" in policy


def test_the_summary_has_the_way_the_speed_and_the_stop() -> None:
    text = report(drive_of_two(), "acsar", ["60 steps are missing"])
    first, note = re.findall(r"<p[^>]*>(.*?)</p>", text)[:2]
    found = re.match(
        r"The robot drove ([\d.]+) m in .*, at most ([\d.]+) m/s. Events: stop \(1\)", first
    )
    assert found is not None, first
    assert float(found[1]) == pytest.approx(1.4, abs=0.15)
    assert float(found[2]) == pytest.approx(0.5, abs=0.02)
    assert note == "60 steps are missing"


def test_a_pose_that_is_set_is_no_way() -> None:
    messages = [
        each._replace(message=moved(each.message, 50.0)) if n > 0.5 * len(drive_of_two()) else each
        for n, each in enumerate(drive_of_two())
    ]
    found = re.search(r"The robot drove ([\d.]+) m", report(messages, "acsar", []))
    assert found is not None
    assert float(found[1]) == pytest.approx(1.4, abs=0.15)


def moved(message: Struct, by: float) -> Struct:
    if not isinstance(message, Odometry):
        return message
    place = message.pose.pose.position
    pose = replace(message.pose.pose, position=replace(place, x=place.x + by))
    return replace(message, pose=replace(message.pose, pose=pose))


def test_every_event_has_a_row_with_the_client_that_caused_it() -> None:
    logs = [item.message for item in drive_of_two() if isinstance(item.message, Log)]
    text = report(drive_of_two(), "acsar", [])
    words = PageElements(text).words
    assert f"{len(logs)} events" in words
    assert [word for word in words if word in {log.msg for log in logs}] == [
        log.msg for log in logs
    ]
    assert any("(by unnamed (native))" in word for word in words)
    marks = [mark for level in LEVELS for mark in traces(text, level) if "yaxis" in mark]
    assert sum(len(mark["x"]) for mark in marks) == len(logs)
    told = marks[0]["yaxis"].replace("y", "yaxis")
    axis = pictures(text)["time"]["layout"][told]
    assert (axis["categoryarray"], axis["range"]) == ([*LEVELS], [len(LEVELS) - 0.5, -0.5])


def test_the_path_has_the_places_of_warnings_and_errors_and_of_nothing_else() -> None:
    at_ns = drive_of_two()[-1].wall_ns
    more = [event("a", "link", at_ns, "warning"), event("b", "fault", at_ns, "error")]
    text = report([*drive_of_two(), event("c", at_ns=at_ns), *more], "acsar", [])
    (path,) = traces(text, "path")
    for level in ("warning", "error"):
        marks = [m for m in pictures(text)["path"]["data"] if m["name"] == level]
        told = [item.message for item in drive_of_two() if isinstance(item.message, Log)]
        count = sum(log.level == LEVELS[level] for log in told) + 1
        assert [len(mark["x"]) for mark in marks] == [count]
        assert marks[0]["x"][-1] == pytest.approx(path["x"][-1], abs=1e-4)


def test_the_name_of_an_event_is_in_words() -> None:
    text = report([event("it rolls", "wheel_fault")], "acsar", [])
    (mark,) = [mark for mark in traces(text, "info") if mark["x"]]
    assert "wheel fault" in mark["hovertext"][0]
    assert "wheel fault" in PageElements(text).words


def test_of_too_many_events_the_newest_are_shown_and_those_of_several_days_have_a_date() -> None:
    events = [event(f"event {n}", at_ns=n) for n in range(MAX_EVENTS + 5)]
    words = PageElements(report(events, "acsar", [])).words
    assert f"{MAX_EVENTS} events, without the 5 earlier ones" in words
    assert f"event {MAX_EVENTS + 4}" in words
    assert "event 4" not in words
    noon_ns = 1_800_014_400 * NS_PER_S
    for apart_s, dated in ((60, False), (86_400, True)):
        events = [event("a", at_ns=noon_ns), event("b", at_ns=noon_ns + apart_s * NS_PER_S)]
        text = report(events, "acsar", [])
        assert bool(re.search(r"<td>\d{4}-\d\d-\d\d \d\d:", text)) is dated


@pytest.mark.parametrize(
    ("wheels", "names"),
    [
        (WheelMap(), ("front right", "front left", "rear left", "rear right")),
        (WheelMap(left="+l", right="+r"), ("right", "left")),
    ],
)
def test_the_curves_are_the_messages(wheels: WheelMap, names: tuple[str, ...]) -> None:
    drive = drive_of_two(wheels)
    text = report(drive, "acsar", [])
    sent = [item for item in drive if item.channel.native == "cmd_vel_out"]
    forward, turning = traces(text, "limited")
    assert forward["y"] == [round(item.message.twist.linear.x, 5) for item in sent]
    assert turning["y"] == [round(item.message.twist.angular.z, 5) for item in sent]
    path = traces(text, "path")[0]
    place = [item for item in drive if item.channel.native == "odom"][-1].message
    assert path["x"][-1] == pytest.approx(place.pose.pose.position.x, abs=1e-5)
    for name, row in (("start", 0), ("end", -1)):
        (mark,) = traces(text, name)
        assert (mark["x"], mark["y"]) == ([path["x"][row]], [path["y"][row]])
    axis = traces(text, names[0])[0]["yaxis"]
    curves = [t for t in pictures(text)["time"]["data"] if t.get("yaxis") == axis]
    assert tuple(curve["name"] for curve in curves) == names
    assert all(len(curve["y"]) > 300 for curve in curves)
    received = traces(text, "lines received")[0]["y"][1:]
    assert received == pytest.approx([100.0] * len(received), abs=2)
    assert len(received) >= 3


def test_rates_are_not_negative_after_a_restart_of_the_daemon() -> None:
    first, *_ = states()
    messages = []
    for second, (sent, missed) in enumerate([(100, 5), (200, 5), (50, 6), (150, 6)]):
        counters = {"lines_sent": sent, "missed_periods": missed}
        state = replace(first.message, counters=counters)
        at_ns = first.wall_ns + second * NS_PER_S
        messages.append(Published(first.channel, first.source, at_ns, state))
    (rates,) = traces(report(messages, "acsar", []), "lines sent")
    assert rates["y"] == [100.0, 100.0]


def test_a_robot_that_got_other_wheels_has_the_curves_of_the_last_ones() -> None:
    messages = drive_of_two() + drive_of_two(WheelMap(left="+l", right="+r"))
    text = report(messages, "acsar", [])
    right, left = traces(text, "right")[0], traces(text, "left")[0]
    assert len(right["y"]) == len(left["y"]) > 600
    assert not traces(text, "front right")


def test_the_bands_say_who_drives_and_why_another_waits() -> None:
    text = report(drive_of_two(), "acsar", [])
    (drives,), (waits,) = traces(text, "drives"), traces(text, "waits")
    assert drives["y"] == ["teleop", "nav"]
    assert drives["base"][1] < drives["base"][0]
    driven = [item for item in drive_of_two() if item.channel.native == "cmd_vel_out"]
    seconds = (driven[-1].wall_ns - driven[0].wall_ns) / NS_PER_S
    assert 0.2 * seconds < sum(drives["x"]) / 1000 <= seconds
    texts = dict(zip(waits["y"], waits["hovertext"], strict=True))
    assert "teleop has priority" in texts["nav"].replace("<br>", " ")
    bars = [trace for trace in pictures(text)["time"]["data"] if trace["type"] == "bar"]
    assert all(bar["name"] for bar in bars)
    shown = [bar for bar in bars if "mode" in bar["y"]]
    assert {bar["name"] for bar in shown} >= {"driving", "stopped"}
    spans = sorted(
        (base, base + x)
        for bar in shown
        for y, base, x in zip(bar["y"], bar["base"], bar["x"], strict=True) if y == "mode"
    )  # fmt: skip
    for (_, end), (begin, _) in pairwise(spans):
        assert begin == pytest.approx(end, abs=1.0)


def test_a_phone_has_room_for_the_words_and_a_round_shows_its_start() -> None:
    text = report(drive_of_two(), "acsar", [])
    for kind in ("driving", "stopped", "drives", "waits"):
        for bar in traces(text, kind):
            assert (bar["text"], bar["showlegend"]) == (kind, False)
    path = pictures(text)["path"]["layout"]
    assert path["legend"]["y"] == 1  # above the picture: its axis is below
    ring, end = traces(text, "start")[0]["marker"], traces(text, "end")[0]["marker"]
    assert ring["size"] > end["size"]
    assert ring["symbol"].endswith("-open")
    orange = COLOURS["warning"]
    assert orange not in (ring["color"], end["color"], COLOURS["waiting"], COLOURS["booting"])


def test_a_command_far_out_of_range_does_not_flatten_the_other_curves() -> None:
    last = drive_of_two()[-1]
    far = Published(CMD_VEL_IN, "nav", last.wall_ns, command_message(Twist(1e300), Time(), "b"))
    text = report([*drive_of_two(), far], "acsar", [])
    assert traces(text, "commanded by nav")[0]["y"][-1] == 1e300
    low, high = pictures(text)["time"]["layout"]["yaxis"]["range"]
    assert -1 < low < high < 1
    drawn = traces(text, "measured")[0]["y"] + traces(text, "limited")[0]["y"]
    room = (max(drawn) - min(drawn)) / 2
    assert (low, high) == pytest.approx((min(drawn) - room, max(drawn) + room), abs=1e-4)


@pytest.mark.parametrize("count", [1, MAX_ROWS, MAX_ROWS + 1, 100_000])
def test_a_long_curve_is_thinned_evenly_and_ends_with_its_last_row(count: int) -> None:
    rows = Rows()
    for n in range(count):
        rows.add(n / 100, float(n))
    kept = list(rows.rows())
    assert min(count, MAX_ROWS // 2) <= len(kept) <= MAX_ROWS + 1
    assert kept[0] == (0.0, 0.0)
    assert kept[-1] == ((count - 1) / 100, count - 1)
    steps = {round(b[1] - a[1]) for a, b in pairwise(kept[:-1])}
    assert len(steps) <= 1


def test_a_curve_has_a_gap_where_messages_are_missing() -> None:
    rows = Rows()
    assert list(rows.rows()) == []
    for t in (0.0, 0.5, 2.0, 2.5):
        rows.add(t, t)
    shown = [(t, math.isnan(value)) for t, value in rows.rows()]
    gap = (0.5, True)
    assert shown == [(0.0, False), (0.5, False), gap, (2.0, False), (2.5, False)]


def test_the_summary_names_the_worst_events_first_and_none_if_there_is_none() -> None:
    told = [event("a", "link", level="warning"), event("b"), event("c", "fault", level="error")]
    for events, end in ((told, "s. Events: fault (1), link (1), stop (1)."), ([], "s. ")):
        text = report([*states()[:1], *events], "acsar", [])
        assert re.findall(r"<p>(.*?)</p>", text)[0].endswith(end)


@pytest.mark.parametrize(("zone", "hours"), [("UTC", 0), ("<+05>-5", 5), ("<-03>3", -3)])
def test_times_are_those_of_this_computer_s_clock(
    zone: str, hours: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TZ", zone)
    time.tzset()
    try:
        at = traces(report([event("a", at_ns=1000 * NS_PER_S)], "acsar", []), "info")[-1]["x"]
    finally:
        monkeypatch.undo()
        time.tzset()
    assert at == [1000 * (1000 + 3600 * hours)]

"""The pure functions of the page's scripts: whose commands leave when, and what the page says."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

from acsard.client.ride import GRACE_S, SEND_PERIOD_S
from acsard.web.answers import PAGE_DIRECTORY
from tests.each import each

pytestmark = pytest.mark.skipif(shutil.which("node") is None, reason="needs node")

IMPORTS = """
import { Commander, driving, still, twist, ZERO } from "./commander.js";
import { read } from "./settings.js";
import { folded } from "./views.js";
import * as words from "./words.js";
"""

STATES = """
const ready = { mode: "ready", link: "up", source: "", sender: "", reason: "", causes: [],
    emergency_stop: "released", sources: [{ name: "teleop", priority: 50, wait: "neutral",
    waits_for: "a zero" }, { name: "safety", priority: 60 }, { name: "nav", priority: 10 }] };
const driven = (source, sender) => ({ ...ready, mode: "driving", source, sender });
const ours = driven("teleop", "me");
const stopped = { ...ready, mode: "stopped" };
const event = { name: "refused", level: "warning", by: "" };
const events = (...texts) => texts.map((text) => ({ ...event, text }));
"""


@pytest.fixture(scope="module")
def scripts(tmp_path_factory: pytest.TempPathFactory) -> Path:
    where = tmp_path_factory.mktemp("scripts") / "page"
    shutil.copytree(PAGE_DIRECTORY, where)
    (where / "package.json").write_text('{"type": "module"}')
    return where


def run(scripts: Path, code: str) -> Any:
    """Return the JSON value that the promise `result` of a script of the page resolves to."""
    (scripts / "test.js").write_text(
        f"{code}\nconsole.log(JSON.stringify(await result));process.exit();\n"
    )
    done = subprocess.run(
        ["node", "test.js"], cwd=scripts, capture_output=True, text=True, timeout=60.0, check=False
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.fixture(scope="module")
def values(scripts: Path) -> dict[str, Any]:
    asked = ", ".join(f"{json.dumps(code)}: {code} ?? null" for code, _ in FACTS)
    found = run(scripts, f"{IMPORTS}{STATES}const result = {{ {asked} }};")
    assert isinstance(found, dict)
    return found


OTHER = "'here/fedcba9876543210'"
PRESSED = (
    "{ kind: 'stop', stamp: { sec: 1, nanosec: 0 }, by: 'here@page/0123456789abcdef (native)', "
    "text: 'stopped by here@page/0123456789abcdef (native)' }"
)

FACTS: list[tuple[str, Any]] = [
    # Numbers and times.
    ("words.signed(-0.04, 1)", "0.0"),
    ("words.signed(-1.25, 2)", "−1.25"),
    ("words.figure(null, 2)", "–"),
    ("read('0,5', 0.2)", 0.5),
    ("read(' −1.5 ', 0.2)", -1.5),
    ("read('fast', 0.2)", "fast"),
    ("read('', 0.2)", ""),
    ("read('info', 'debug')", "info"),
    ("[0.4, 119, 121, 7201].map(words.ago)", ["now", "119 s ago", "2 min ago", "2 h ago"]),
    ("[90, 600].map(words.lasted)", ["90 s", "10 min"]),
    ("[999, 1500].map(words.age)", ["999 ms", "1.5 s"]),
    ("words.spot(-1, 2, Math.PI / 2)", "x −1.00 m · y 2.00 m · 90°"),
    ("words.yaw({ z: Math.sin(0.5), w: Math.cos(0.5) }).toFixed(6)", "1.000000"),
    # Senders.
    ("words.person('here/0123456789abcdef', 'here/0123456789abcdef')", "you"),
    (f"words.person('here/0123456789abcdef', {OTHER})", "another page on the robot itself"),
    (f"words.person('phone/0123456789abcdef [robot]', {OTHER})", "phone [robot]"),
    (f"words.person('phone@page/0123456789abcdef [robot]', {OTHER})", "the page of phone [robot]"),
    ("words.person('phone/0123456789abcdef', 'phone/fedcba9876543210')", "another page of phone"),
    ("words.person('0123456789abcdef')", "a program without a name"),
    ("words.person('session 0123456789abcdef')", "a program without a name"),
    ("words.person('unnamed')", "a program without a name"),
    ("words.person('session 0123456789abcdef [laptop]')", "laptop"),
    ("words.person('0b5d (rmw)')", "0b5d (rmw)"),
    ("words.person('tv@page/0123456789abcdef', 'phone/fedcba9876543210')", "the page of tv"),
    (f"words.reason({{ mode: 'stopped', causes: [{PRESSED}] }}, {OTHER}).split(' · ')[0]",
     "stopped by your page"),
    # Why a push would not move the robot.
    ("still(null, 'teleop', 'me')", "Nothing is received from the robot."),
    ("still(ready, 'teleop', 'me')", ""),
    ("still(ours, 'teleop', 'me')", ""),
    ("still(driven('nav', 'joy'), 'teleop', 'me')", ""),
    ("still(driven('safety', 'joy'), 'teleop', 'me')",
     "joy (safety) drives and has priority: you can drive when it stops."),
    ("still(driven('teleop', 'joy'), 'teleop', 'me')", "joy drives: you can drive when they stop."),
    ("still(ready, 'joy', 'me')",
     "This robot takes no commands from a page: joy is not one of its sources."),
    ("still({ ...ready, link: 'down' }, 'teleop', 'me')", "No board: nothing can drive."),
    ("still(stopped, 'teleop', 'me')", "Stopped. Press Release STOP first."),
    ("still({ ...stopped, link: 'down' }, 'teleop', 'me')",
     "Stopped. Press Release STOP first. The board is missing, too."),
    ("still({ ...stopped, emergency_stop: 'pressed' }, 'teleop', 'me')",
     "Emergency stop pressed: release it at the robot first."),
    ("driving(driven('nav', ''), 'teleop', 'me')", "nav"),
    # A push of the stick: an unknown turn of a robot that may only turn is slow.
    ("twist(0.05, 0.05, 0.2, { linear: 1, angular: 4 })", [0, 0]),
    ("twist(0, 2, 0.2, { linear: 1, angular: 4 })", [0.2, 0]),
    ("twist(1, 0, 0.2, { linear: 1, angular: 4 })[1]", -0.8),
    ("twist(1, 0, 0.2, { linear: 0, angular: 4 })[1]", -0.4),
    # Events.
    ("folded(events('a', 'a', 'b', 'a')).map(({ text, equal }) => [text, equal])",
     [["a", 2], ["b", 1], ["a", 1]]),
]  # fmt: skip


@each(("code", "value"), FACTS)
def test_the_scripts_say_and_decide(values: dict[str, Any], code: str, value: Any) -> None:
    assert values[code] == (pytest.approx(value) if isinstance(value, float) else value)


LOOK = """
const result = [], commander = new Commander();
const look = (now, state) => {
    const { send, ended } = commander.look(now, state, now, "teleop", "me");
    result.push([send ? send.linear_x : null, ended ?? null]);
};
"""


def test_a_commander_opens_with_zeros_drives_at_20_hz_and_ends_with_one_zero(scripts: Path) -> None:
    code = """commander.press(0); commander.wish(0.2, 0);
        for (const now of [0, 10, 20, 40]) look(now, ready);
        for (let now = 50; now < 260; now += 10) look(now, ours);
        result.push([commander.release()?.linear_x, null], [commander.release(), null]);
        look(270, ours);"""
    pairs = run(scripts, IMPORTS + STATES + LOOK + code)
    assert pairs[:4] == [[0, None], [None, None], [0, None], [0, None]]
    sent = [pair[0] for pair in pairs[4:25]]
    assert set(sent) == {0.2, None}
    assert sent.count(0.2) == 4
    assert pairs[25:] == [[0, None], [None, None], [None, None]]


@each(
    ("code", "why"),
    [
        ("commander.press(0); look(0, ready); look(1100, ready)", "This page was suspended"),
        ("commander.press(0); look(0, stopped)", "Stopped. Press Release STOP first."),
        ("commander.press(0); for (let now = 0; now <= 2100; now += 100) look(now, null)",
         "Nothing is received"),
        ("commander.press(0); for (let now = 0; now <= 2100; now += 100) look(now, ready)",
         "a zero"),
        ("commander.press(-1); look(0, ours);"
         "for (let now = 100; now <= 600; now += 100) look(now, driven('teleop', 'other'))",
         "other drives"),
    ],
)  # fmt: skip
def test_a_commander_that_is_not_obeyed_sends_a_zero_and_says_why(
    scripts: Path, code: str, why: str
) -> None:
    pairs = run(scripts, IMPORTS + STATES + LOOK + code)
    assert pairs[-1][0] == 0
    assert why in pairs[-1][1]
    assert all(pair[1] is None for pair in pairs[:-1])


def test_a_commander_begins_with_zeros_again_after_a_hiccup(scripts: Path) -> None:
    code = """commander.press(0); commander.wish(0.2, 0); look(1, ready); look(100, ours);
        look(400, { ...ours, sender: "" });"""
    pairs = run(scripts, IMPORTS + STATES + LOOK + code)
    assert [pair[0] for pair in pairs] == [0, 0.2, 0]


# The STOP of `stop.js`, each time in a browser of its own whose clocks the story may set.

STOP = """
import { readFileSync } from "node:fs";
import { createContext, runInContext } from "node:vm";
const real = performance.now.bind(performance);
const browser = () => {
    const documentElement = { classList: { add() {}, remove() {} } };
    const document = { getElementById: () => null, documentElement };
    const window = {};
    return createContext({ window, document, console, setTimeout, clearTimeout,
        performance: { now: real }, addEventListener() {}, fetch() {}, AbortController });
};
const told = (story) => runInContext(`${readFileSync("stop.js")}
(async () => {
    const out = [], now = Date.now;
    let ok = false, lost = true;
    const send = async () => (out.push("sent"), { ok, lost, text: "no answer" });
    const stopping = new Stopping(send, (words) => out.push(words));
    const pressed = stopping.press();
    await new Promise((done) => setTimeout(done, 100)); // it was sent once
    ${story}
    await pressed;
    return out;
})()`, browser());
"""

GIVEN_UP = "STOP was not confirmed"
CONFIRMED = "STOP: the robot has confirmed it"

SLOW = """let answer;
    stopping.send = () => new Promise((done) => { answer = done; });
    while (!answer) await new Promise((done) => setTimeout(done, 10));
    stopping.over();"""
"""Gives up the STOP while the second attempt waits for its answer."""

STORIES: dict[str, tuple[str, list[str]]] = {
    "answered": ("ok = true", ["sent", CONFIRMED]),
    "cleared": ("stopping.over()", [GIVEN_UP]),
    "cleared before the page is complete":
        ("stopping.over(); stopping.complete(); stopping.lacks()", [GIVEN_UP]),
    "asleep": ("Date.now = () => now() + 31000", [GIVEN_UP]),
    "a clock set back":
        ("const then = performance.now(); Date.now = () => now() - 3600000;"
         "performance.now = () => then + 31000", [GIVEN_UP]),
    "pressed again": ("ok = true; stopping.press()", ["sent", CONFIRMED]),
    "refused, then answered":
        ("lost = false; await new Promise((done) => setTimeout(done, 300)); ok = true",
         ["sent", "STOP is not confirmed.", "sent", CONFIRMED]),
    "answered after the release was pressed":
        (f"{SLOW} answer({{ok: true}})", [GIVEN_UP, CONFIRMED]),
    "not answered after the release was pressed": (f"{SLOW} answer({{ok: false}})", [GIVEN_UP]),
    "released twice, and the first release is confirmed":
        ("const given = stopping.over(); stopping.over(); stopping.released(given)",
         [GIVEN_UP, GIVEN_UP, ""]),
    "pressed again before the release is confirmed":
        ("const given = stopping.over(); ok = true; const again = stopping.press();"
         "stopping.released(given); await again", [GIVEN_UP, "sent", CONFIRMED]),
}  # fmt: skip


def test_a_stop_is_repeated_until_it_arrives_and_never_sent_long_after_the_press(
    scripts: Path,
) -> None:
    stories = json.dumps([story for story, _ in STORIES.values()])
    traces = run(scripts, f"{STOP}const result = Promise.all({stories}.map(told));")
    for (name, (_, then)), entries in zip(STORIES.items(), traces, strict=True):
        expected = ["sent", "STOP is not confirmed.", *then]
        assert len(entries) == len(expected), (name, entries)
        for entry, begun in zip(entries, expected, strict=True):
            assert entry == begun if begun in ("", "sent") else entry.startswith(begun), name


@each(("name", "limit_s"), [("PERIOD", SEND_PERIOD_S), ("GRACE", GRACE_S)])
def test_the_page_has_the_time_limits_of_a_ride(name: str, limit_s: float) -> None:
    script = (PAGE_DIRECTORY / "commander.js").read_text(encoding="utf-8")
    found = re.search(rf"^const {name} = (\d+);", script, re.MULTILINE)
    assert found is not None
    assert int(found[1]) == 1000 * limit_s

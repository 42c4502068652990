"""What the page says in each state (`page_states.txt`), and how it looks on each screen.

To write that file anew, run `pytest -m slow --approve tests/system/test_page_looks.py`, and then
read `git diff`.
"""

from __future__ import annotations

import itertools
import re
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from tests.system.browser import Page
from tests.system.chromium import CHROMIUM, DESKTOP, PHONE, SIDEWAYS, Browser
from tests.system.harness import Bus, Daemon, Peer, until
from tests.system.phone_page import Phone
from tests.tools import pictures
from tests.tools.pictures import VIEWS

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="needs chromium-headless-shell"),
]

APPROVED = Path(__file__).with_name("page_states.txt")

SAYS = """(() => {
    const red = one => getComputedStyle(one).color === 'rgb(179, 22, 11)' ? ' (red)' : '';
    const stops = one => getComputedStyle(one).backgroundColor === 'rgb(196, 18, 10)';
    const grey = one => one.disabled || (one.id === 'stop' && !stops(one)) ? ' (grey)' : '';
    const says = ['role', 'age', 'battery', 'mode', 'reason', 'doubt', 'speed', 'turn', 'who',
        'hint', 'stop', 'clear', 'alarm', 'complaint'].map(name => document.getElementById(name))
        .filter(one => one.checkVisibility() && one.innerText.trim() !== '')
        .map(one => `${one.id}${red(one)}${grey(one)}: ${one.innerText.trim()}`);
    const barred = document.getElementById('stick').ariaDisabled === 'true';
    return [`title: ${document.title}`, ...says, `stick: ${barred ? 'grey' : 'ready'}`];
})()"""
"""The title, the visible texts that depend on the state, which are red or grey, and the stick."""


def says(browser: Browser) -> str:
    """Return the visible texts, without times, figures and paths."""
    text = re.sub(r"/tmp/\w+/", "", "\n".join(browser.js(SAYS)))
    return re.sub(r"[+−-]?\d+(?:[.:-]\d+)*(?:\s[AP]M)?", "0", text)


def test_each_state_of_the_page_has_its_words(
    request: pytest.FixtureRequest, approved: Callable[[Path, str], None]
) -> None:
    states = APPROVED.read_text(encoding="utf-8").removeprefix("--- ").split("\n--- ")
    known = {name: text.rstrip() for name, _, text in (state.partition("\n") for state in states)}
    found: dict[str, str] = {}

    def look(browser: Browser, state: str) -> None:
        if request.config.getoption("approve"):
            time.sleep(1.0)
        else:
            with suppress(AssertionError):  # the comparison below shows what differs
                until(lambda: says(browser) == known.get(state), 3.0)
        found[state] = says(browser)

    pictures.states(look)
    if not request.config.getoption("approve"):
        assert {state: text for state, text in found.items() if text != known.get(state)} == {}
    approved(APPROVED, "".join(f"--- {state}\n{text}\n" for state, text in found.items()))


OFF_THE_MAP = """[...document.querySelectorAll('.tools button')]
    .filter(one => one.checkVisibility())
    .map(one => [one.id, one.getBoundingClientRect()])
    .filter(([, box]) => box.bottom > document.getElementById('map').getBoundingClientRect().bottom)
    .map(([name]) => name)"""
"""The buttons of the map that cover something below it."""


@pytest.mark.nightly
def test_every_state_is_fit_for_a_screen_reader_and_the_map_keeps_its_buttons() -> None:
    def look(browser: Browser, state: str) -> None:
        for size, dark in itertools.product((PHONE, SIDEWAYS, DESKTOP), (False, True)):
            browser.size(*size, touch=size != DESKTOP, dark=dark)
            # The two styles differ in their colours alone, so the second one needs that rule alone.
            obstacles = browser.obstacles("color-contrast" if dark else "")
            assert obstacles == [], (state, size, dark)
            assert browser.js(OFF_THE_MAP) == [], (state, size, dark)

    pictures.states(look)


BOXES = """['stick', 'stop', 'limit', 'hint', 'speed', 'mode', 'map'].map(name => {
    const box = document.getElementById(name).getBoundingClientRect();
    return [name, box.left, box.top, box.right, box.bottom];
})"""

HIDDEN = "(one => one.scrollHeight - one.clientHeight)(document.querySelector('main'))"
"""How much is behind an edge that would need scrolling, px."""

DIALS = """[...document.querySelectorAll('.dials > *')]
    .map(one => [one.offsetHeight, one.scrollWidth - one.clientWidth])"""

PIECE_PX = {"map": 50, "stick": 90}
"""The least width and height of the path and of the stick, px."""


@pytest.mark.nightly
@pytest.mark.parametrize("size", [PHONE, (320, 568), (375, 667), SIDEWAYS, (667, 375), DESKTOP])
def test_each_view_fits_on_the_screen_for_fingers_eyes_and_screen_readers(
    phone: Phone, size: tuple[int, int]
) -> None:
    browser, bus = phone.browser, phone.bus
    browser.size(*size, touch=size != DESKTOP)
    boxes = {name: tuple(box) for name, *box in browser.js(BOXES)}
    for name, (left, top, right, bottom) in boxes.items():
        assert min(left, top, size[0] - right, size[1] - bottom) >= 0, name
    for first, other in itertools.combinations(boxes, 2):
        a, b = boxes[first], boxes[other]
        apart = a[2] <= b[0] or b[2] <= a[0] or a[3] <= b[1] or b[3] <= a[1]
        assert apart, (first, a, other, b)
    for name, least in PIECE_PX.items():
        left, top, right, bottom = boxes[name]
        assert min(right - left, bottom - top) >= least, name
    assert browser.js(HIDDEN) <= 0
    # A second line would be 20 px more.
    assert all(high < 60 and wide <= 0 for high, wide in browser.js(DIALS)), browser.js(DIALS)
    # More words above and below the stick, and the button that releases a stop.
    for verb, hint in (("deactivate", "Switched off"), ("stop", "Stopped")):
        bus.get(f"srv/{verb}")
        phone.shows("hint", hint)
        assert browser.js(HIDDEN) <= 0
    for view, dark in itertools.product(VIEWS, (False, True)):
        browser.size(*size, touch=size != DESKTOP, dark=dark)
        pictures.show(browser, view)
        assert browser.js("document.documentElement.scrollWidth") <= size[0], view
        assert browser.obstacles() == [], (view, dark)
        if size != DESKTOP:
            assert browser.too_small() == [], view
            assert browser.too_tiny() == [], view


# The map and the plots


@pytest.fixture
def mapped(tmp_path: Path, peer: Peer, browser: Browser) -> Iterator[Phone]:
    """The page of a robot whose cable a test may pull."""
    with (
        Daemon(tmp_path, peer.path) as daemon,
        Bus(daemon.endpoint) as bus,
        Page(daemon, tmp_path) as server,
    ):
        bus.linked()
        browser.size(*PHONE)
        browser.open(server.here)
        page = Phone(daemon, bus, server, browser)
        page.shows("mode", "READY")
        page.shows("where", "x 0.00 m · y 0.00 m · 0°")
        yield page
        browser.open("about:blank")


PARTS = """['map', 'erase', 'where'].map(
    name => document.getElementById(name).getBoundingClientRect()).map(
    box => [box.left, box.top, box.right, box.bottom].map(Math.round))"""

DRAWN = """(() => {
    const map = document.getElementById('map'), {left, top} = map.getBoundingClientRect();
    const data = map.getContext('2d').getImageData(0, 0, map.width, map.height).data;
    const style = getComputedStyle(document.documentElement).getPropertyValue('COLOUR').trim();
    const wanted = [1, 3, 5].map(at => parseInt(style.slice(at, at + 2), 16)), found = [];
    const share = map.clientHeight / map.height;
    for (let n = 0; n < data.length; n += 4)
        if (wanted.every((one, at) => data[n + at] === one))
            found.push([left + (n / 4 % map.width) * share,
                        top + Math.floor(n / 4 / map.width) * share]);
    const [xs, ys] = [0, 1].map(at => found.map(one => one[at]));
    return [xs, ys].flatMap(all => [Math.min(...all), Math.max(...all)]);
})()"""
"""The left, right, upper and lower end of the shapes in this colour on the map, px."""


def test_the_map_shows_the_robot_its_direction_a_scale_and_a_lost_place(
    mapped: Phone, peer: Peer
) -> None:
    browser = mapped.browser

    def drawn(colour: str) -> list[float]:
        """Return the ends of the shapes in this colour when the map does not change any more."""
        looks: list[list[float]] = []

        def stands() -> bool:
            looks.append(browser.js(DRAWN.replace("COLOUR", colour)))
            time.sleep(0.1)
            return len(looks) > 2 and looks[-1] == looks[-2] == looks[-3]

        until(stands, 5.0, "the map stands")
        return looks[-1]

    (left, _, right, _), (_, _, _, tools), (_, words, _, bottom) = browser.js(PARTS)
    middle = (left + right) / 2
    begun = west, east, north, south = drawn("--accent")
    assert west == pytest.approx(middle - 13, abs=4.0)
    assert east == pytest.approx(middle + 83, abs=8.0)  # the end of the dashed ray
    assert (north + south) / 2 == pytest.approx((tools + words) / 2, abs=5.0)
    west, east, north, south = drawn("--ink")
    assert left < west < east < left + 70  # a bar of 45 px says 0.5 m
    assert words - 30 < north < south < bottom
    browser.tap("nearer")
    assert drawn("--accent")[0] < begun[0]
    browser.tap("farther")
    x, y = browser.middle("map")
    browser.touch("Start", (x, y))
    browser.touch("Move", (x + 50, y + 30))
    browser.touch("End")
    assert drawn("--accent")[0] > begun[0] + 30
    browser.js("document.getElementById('recentre').click()")
    assert drawn("--accent") == begun
    browser.js("document.getElementById('turns').click()")
    assert drawn("--accent")[2] < begun[2] - 30  # the ray leads up
    browser.js("document.getElementById('turns').click()")
    peer.unplug()
    mapped.shows("mode", "NO BOARD")
    slope = "getComputedStyle(document.getElementById('where')).fontStyle"
    assert browser.js(slope) == "italic"
    assert drawn("--accent") != begun  # the robot is grey
    peer.plug()
    mapped.shows("mode", "READY")
    until(lambda: browser.js(slope) == "normal", 5.0, "the place is known")
    assert drawn("--accent") == begun

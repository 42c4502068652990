"""Every view fits on every screen, for fingers, eyes and screen readers."""

from __future__ import annotations

import itertools
import re

import pytest

from tests.system.chromium import (
    CHROMIUM,
    DESKTOP,
    PHONE,
    SIDEWAYS,
    Browser,
)
from tests.system.harness import until
from tests.system.phone_page import Phone, alone
from tests.tools import pictures
from tests.tools.pictures import VIEWS

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="needs chromium-headless-shell"),
]


@pytest.fixture
def page(phone: Phone) -> Phone:
    return phone


SMALL, SMALL_SIDEWAYS = (375, 667), (667, 375)


SCREENS = [PHONE, SMALL, SIDEWAYS, SMALL_SIDEWAYS, DESKTOP]


BOXES = """['stick', 'stop', 'limit', 'hint', 'speed', 'mode', 'map'].map(name => {
    const box = document.getElementById(name).getBoundingClientRect();
    return [name, box.left, box.top, box.right, box.bottom];
})"""


PIECE_PX = 90
"""The least width and height of the path and of the stick, px."""


@pytest.mark.nightly
@pytest.mark.parametrize("size", SCREENS)
def test_stick_stop_speed_mode_and_path_fit_on_the_screen_beside_each_other(
    page: Phone, size: tuple[int, int]
) -> None:
    page.browser.size(*size, touch=size != DESKTOP)
    boxes = {name: tuple(box) for name, *box in page.browser.js(BOXES)}
    for name, (left, top, right, bottom) in boxes.items():
        assert left >= 0, name
        assert top >= 0, name
        assert right <= size[0], name
        assert bottom <= size[1], name
    for first, other in itertools.combinations(boxes, 2):
        a, b = boxes[first], boxes[other]
        apart = a[2] <= b[0] or b[2] <= a[0] or a[3] <= b[1] or b[3] <= a[1]
        assert apart, (first, a, other, b)
    for name in ("map", "stick"):
        left, top, right, bottom = boxes[name]
        assert min(right - left, bottom - top) >= PIECE_PX, name
    # Nothing is hidden behind an edge that would need scrolling.
    more = "(one => one.scrollHeight - one.clientHeight)(document.querySelector('main'))"
    assert page.browser.js(more) <= 0
    page.bus.get("srv/deactivate")  # more words above and below the stick
    page.shows("hint", "Switched off")
    assert page.browser.js(more) <= 0
    page.bus.get("srv/stop")
    page.shows("hint", "Stopped")
    assert page.browser.js(more) <= 0
    for view in VIEWS:
        page.browser.js(f"document.getElementById('tab-{view}').click()")
        assert page.browser.js("document.documentElement.scrollWidth") <= size[0], view


@pytest.mark.nightly
def test_every_control_is_large_enough_for_a_finger_and_every_text_to_read(page: Phone) -> None:
    page.bus.get("srv/stop")
    page.shows("mode", "STOPPED")  # together with Release
    for size, view in itertools.product((PHONE, SIDEWAYS, SMALL_SIDEWAYS), VIEWS):
        page.browser.size(*size)
        pictures.show(page.browser, view)
        assert page.browser.too_small() == [], (size, view)
        assert page.browser.too_tiny() == [], (size, view)


@pytest.mark.nightly
def test_no_view_has_obstacles_for_a_screen_reader(page: Phone) -> None:
    looked = itertools.product((PHONE, SIDEWAYS, DESKTOP), (False, True), (False, True), VIEWS)
    for size, dark, stopped, view in looked:
        page.browser.size(*size, touch=size != DESKTOP, dark=dark)
        page.bus.get("srv/stop" if stopped else "srv/clear")
        page.shows("mode", "STOPPED" if stopped else "READY")
        page.browser.js(f"document.getElementById('tab-{view}').click()")
        assert page.browser.obstacles() == [], (size, dark, stopped, view)


OFF_THE_MAP = """[...document.querySelectorAll('.tools button')]
    .filter(one => one.checkVisibility())
    .map(one => [one.id, one.getBoundingClientRect()])
    .filter(([, box]) => box.bottom > document.getElementById('map').getBoundingClientRect().bottom)
    .map(([name]) => name)"""
"""The buttons of the map that cover something below it."""


@pytest.mark.nightly
def test_every_state_is_fit_for_a_screen_reader_and_the_map_keeps_its_buttons() -> None:
    states: list[str] = []

    def look(browser: Browser, state: str) -> None:
        for size, dark in itertools.product((PHONE, SIDEWAYS, DESKTOP), (False, True)):
            browser.size(*size, touch=size != DESKTOP, dark=dark)
            # The two styles differ in their colours alone, so the second one needs that rule alone.
            obstacles = browser.obstacles("color-contrast" if dark else "")
            assert obstacles == [], (state, size, dark)
            assert browser.js(OFF_THE_MAP) == [], (state, size, dark)
        states.append(state)

    pictures.states(look)
    assert len(states) == len(set(states)) > 20


SEEN = """(() => {
    const canvas = document.getElementById('plot-wheels'), paper = canvas.getContext('2d');
    const {width, height} = canvas, style = getComputedStyle(document.documentElement);
    const {data} = paper.getImageData(0, 0, width, height), found = new Set();
    for (let n = 0; n < data.length; n += 4)
        if (data[n + 3] === 255) found.add([data[n], data[n + 1], data[n + 2]].join());
    const wanted = [0, 1, 2, 3].map(n => {
        paper.fillStyle = style.getPropertyValue(`--w${n}`).trim();
        const [, r, g, b] = /#(..)(..)(..)/.exec(paper.fillStyle);
        return [r, g, b].map(one => parseInt(one, 16)).join();
    });
    return new Set(wanted.filter(one => found.has(one))).size;
})()"""


@alone
@pytest.mark.nightly
def test_curves_that_overlap_are_distinguishable_and_show_their_values(page: Phone) -> None:
    browser = page.browser
    browser.size(*DESKTOP, touch=False)
    browser.tap("tab-status")
    rows = "[...document.querySelectorAll('#plot-wheels + .legend > span')]"
    legend = f"{rows}.map(one => one.textContent)"
    values = r"^(front right|front left|rear left|rear right) .?\d+\.\d\d$"
    until(lambda: all(re.match(values, label) for label in browser.js(legend)), 10.0, "values")
    assert len(browser.js(legend)) == 4
    # At rest all four are zero: each has its colour somewhere on the line.
    until(lambda: browser.js(SEEN) == 4, 20.0, "four colours")

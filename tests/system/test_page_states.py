"""What the page says in each of its states, in `page_states.txt`.

To write this file anew, run `pytest -m slow --approve tests/system/test_page_states.py`, and then
read `git diff`.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest

from tests.system.chromium import CHROMIUM, Browser
from tests.system.harness import until
from tests.tools import pictures

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
    approved(APPROVED, "".join(f"--- {state}\n{text}\n" for state, text in found.items()))

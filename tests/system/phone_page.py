"""The page of a robot in a phone's browser, for tests that drive it or look at it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import pytest

from tests.system import harness
from tests.system.browser import Page
from tests.system.chromium import Browser
from tests.system.harness import Bus, Daemon, Tables, until

HELD = "document.getElementById('stick').matches('.held')"

alone = pytest.mark.usefixtures("own_robot")
"""Gives a test a new robot, because the test changes a setting, counts, or looks at a history."""


class Phone:
    """A daemon, its page in a phone's browser, and another client on the bus."""

    def __init__(self, daemon: Daemon, bus: Bus, server: Page, browser: Browser) -> None:
        self.daemon, self.bus, self.server, self.browser = daemon, bus, server, browser

    def shows(self, name: str, words: str) -> None:
        """Wait until the element with this id contains the words."""
        said = ""

        def look() -> bool:
            nonlocal said
            said = self.browser.text(name)
            return words in said

        try:
            until(look, 5.0, f"{name} says {words!r}")
        except AssertionError as error:
            raise AssertionError(f"{error}; it says {said!r}") from None

    def hold(self) -> None:
        """Drive forwards with a finger on the stick."""
        self.browser.hold(lambda: (self.bus.state()["linear"] or 0.0) > 0.15)


class Robot(NamedTuple):
    """A daemon with its link up, a client on its bus, and its page."""

    daemon: Daemon
    bus: Bus
    server: Page


@contextmanager
def running(where: Path, config: Tables | None = None) -> Iterator[Robot]:
    """Run a robot and its page."""
    with harness.running(where, config=config) as (daemon, bus), Page(daemon, where) as server:
        yield Robot(daemon, bus, server)

"""The screens of `python -m tests.screens` fit a person's terminal of 40, 80 and 160 columns."""

from __future__ import annotations

import subprocess
import sys

import pytest
from rich.cells import cell_len

from tests.pages import ROOT
from tests.screens import WAITING, WIDTHS

LINE_BY_LINE = "echo state --short"
"""This verb scrolls below the last line at any width, because a terminal breaks long lines."""


def printed() -> dict[tuple[str, int], list[str]]:
    """Return the printed lines by verb and width."""
    words = [sys.executable, "-m", "tests.screens"]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stderr == ""
    screens: dict[tuple[str, int], list[str]] = {}
    for line in done.stdout.splitlines():
        if line.startswith("--- acsard "):
            verb, _, width = line.removeprefix("--- acsard ").partition(", ")
            lines = screens[verb, int(width.split()[0])] = []
        else:
            lines.append(line)
    return screens


@pytest.mark.slow
@pytest.mark.nightly
def test_each_screen_fits_its_width_and_shows_the_whole_reason() -> None:
    screens = printed()
    verbs = {verb for verb, _ in screens}
    assert verbs == {"drive", "top", "fleet", LINE_BY_LINE}
    assert set(screens) == {(verb, width) for verb in verbs for width in WIDTHS}
    for (verb, width), lines in screens.items():
        assert lines, verb
        wide = [line for line in lines if cell_len(line) > width and verb != LINE_BY_LINE]
        assert not wide, f"{verb} at {width} columns"
    for verb, width in ((verb, width) for verb in ("drive", "top") for width in WIDTHS):
        text = " ".join(" ".join(screens[verb, width]).split())
        assert WAITING.reason.partition(": ")[2] in text, f"{verb} at {width} columns"

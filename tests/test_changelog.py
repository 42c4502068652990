"""The changelog's sections are short, and it and the pages are of this version."""

from __future__ import annotations

import re
from pathlib import Path

from acsard import __version__
from tests.pages import PAGES, text_of

CHANGELOG = Path(__file__).parent.parent / "CHANGELOG.md"

SECTIONS = re.split(r"^## ", CHANGELOG.read_text(encoding="utf-8"), flags=re.M)[1:]


def test_the_newest_section_is_of_this_version() -> None:
    """A release has its date there, so it cannot be built before somebody has written it."""
    number, _, development = __version__.partition(".dev")
    when = r"not released yet" if development else r"20\d\d-\d\d-\d\d"
    assert re.match(rf"{re.escape(number)} \({when}\)\n", SECTIONS[0])


def test_each_section_says_on_two_screens_what_an_upgrade_asks() -> None:
    for section in SECTIONS:
        assert section.count("\n### What an upgrade asks of you\n") == 1
        assert section.count("\n") < 90


def test_the_pages_name_the_files_of_this_version() -> None:
    named = re.compile(r"\bacsard[ _-](\d+\.\d+\.\d+)")
    found = {page: named.findall(text_of(page)) for page in PAGES if "/figures" not in page}
    assert sum(map(bool, found.values())) >= 4
    assert set().union(*found.values()) == {__version__.partition(".dev")[0]}

"""The built manual in a real browser, from the page's server and from no other one."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from acsard.web.manual import manual_files
from deploy.manual.build import build
from tests.system.chromium import CHROMIUM, DESKTOP, browsing
from tests.system.harness import until
from tests.unit.test_page_whole import Whole

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="needs chromium-headless-shell"),
]

SEARCH = "[...document.querySelectorAll('*')].find(one => one.shadowRoot)?.shadowRoot"
TYPES = f"{SEARCH}?.activeElement?.tagName === 'INPUT'"
FOUND = f"[...{SEARCH}.querySelectorAll('a')].map(one => one.href)"
"""The links of what the search has found."""

LOADED = "performance.getEntriesByType('resource').map(one => one.name)"


async def test_the_page_leads_to_the_manual_whose_links_and_search_work(tmp_path: Path) -> None:
    archive = tmp_path / "manual.zip"
    await asyncio.to_thread(build, archive)
    whole = Whole(tmp_path)
    whole.page._manual = manual_files(archive)

    def look(page: str) -> None:
        with browsing() as browser:
            browser.size(*DESKTOP, touch=False)
            browser.open(page)
            link = browser.js("document.getElementById('manual').href")
            assert link == f"{page}docs/"
            browser.said.clear()
            browser.open(link)
            browser.js("document.querySelector('article a[href$=\".html\"]').click()")
            browser.arrives(".html")
            browser.js("document.querySelector('.md-search__button').click()")
            until(lambda: browser.js(TYPES), 10.0, "it takes text")
            browser.ask("Input.insertText", text="wheel_radius")
            until(lambda: any("settings.html" in at for at in browser.js(FOUND)), 10.0, "it finds")
            loaded = browser.js(LOADED)
            assert loaded
            assert [name for name in loaded if not name.startswith(link)] == []
            assert browser.said == []

    async with whole.served() as (url, _):
        await asyncio.to_thread(look, f"{url}/")

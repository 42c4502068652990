"""The page's server sends plain file names only, and compresses files if this helps."""

from __future__ import annotations

import base64
import gzip
import hashlib
import re
from pathlib import Path

import pytest
from aiohttp.test_utils import make_mocked_request

from acsard.web.answers import (
    INLINED,
    PAGE_DIRECTORY,
    file_answer,
    page_files,
)


@pytest.fixture
def page(tmp_path: Path) -> Path:
    page = tmp_path / "page"
    page.mkdir()
    (page / "index.html").write_text("<p>robot</p>" * 200)
    (page / "stop.js").write_text("stop()")
    (page / "style.css").write_text("p { margin: 0 }")
    (page / "small.js").write_text("1")
    (page / "notes.txt").write_text("not served")
    (page / ".secret.js").write_text("1")
    (tmp_path / "above.js").write_text("1")
    (page / "link.js").symlink_to(tmp_path / "above.js")
    (page / "inner").mkdir()
    (page / "inner" / "deep.js").write_text("1")
    return page


def test_a_file_is_sent_compressed_and_with_its_type(page: Path) -> None:
    file = page_files(page).get("index.html")
    assert file is not None
    assert file.kind == "text/html; charset=utf-8"
    assert gzip.decompress(file.packed) == b"<p>robot</p>" * 200


@pytest.mark.parametrize(
    "name",
    [
        "../above.js", "/etc/passwd", "inner/deep.js", "inner", "link.js", ".secret.js",
        "notes.txt", "missing.js", "", ".", "..", "a\0.js", "x" * 5000 + ".js",
    ],
)  # fmt: skip
def test_any_other_path_is_not_found(page: Path, name: str) -> None:
    assert page_files(page).get(name) is None


def test_the_page_has_stop_and_its_style_in_itself_and_allows_them_by_their_hashes() -> None:
    page = page_files().get("index.html")
    assert page is not None
    body = gzip.decompress(page.packed)
    sources = {
        "script-src": re.findall(rb"<script>(.*?)</script>", body, re.DOTALL),
        "style-src": re.findall(rb"<style>(.*?)</style>", body, re.DOTALL),
    }
    assert sources["script-src"] == [(PAGE_DIRECTORY / "stop.js").read_bytes()]
    assert sources["style-src"] == [(PAGE_DIRECTORY / "style.css").read_bytes()]
    assert not any(loads in body for loads, _ in INLINED["index.html"].values())
    policy = dict(directive.split(maxsplit=1) for directive in page.policy.split("; ") if directive)
    for name, (source,) in sources.items():
        digest = base64.b64encode(hashlib.sha256(source).digest()).decode()
        assert policy.pop(name) == f"'self' 'sha256-{digest}'"
    assert not policy


def test_a_page_that_the_browser_has_already_keeps_its_policy() -> None:
    """The headers of a 304 answer replace those in the browser's cache.

    The answer must therefore contain the content security policy again.
    """
    page = page_files().get("index.html")
    assert page is not None
    first = file_answer(make_mocked_request("GET", "/"), page)
    again = file_answer(make_mocked_request("GET", "/", {"If-None-Match": page.tag}), page)
    assert (first.status, again.status) == (200, 304)
    policies = [response.headers["Content-Security-Policy"] for response in (first, again)]
    assert policies[0] == policies[1]
    assert policies[0].endswith(page.policy)

"""The page's server sends the files of the manual's zip file, and nothing else, at `/docs`."""

from __future__ import annotations

import asyncio
import random
import re
import tomllib
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from zipfile import ZIP_DEFLATED, ZipFile

import aiohttp
import pytest
from yarl import URL

from acsard.web.manual import manual_files
from tests.pages import ROOT
from tests.unit.test_page_whole import Whole

HOME = b"<h1>acsard</h1><script>go()</script>"
LARGE = bytes(random.Random(1).choices(b"0123456789abcdef", k=300_000))

FILES = {
    "index.html": HOME,
    "howto/wire.html": b"<script>go()</script><script>on()</script>",
    "assets/search.json": LARGE,
    "assets/empty.css": b"",
    "LICENSE": b"not served",
}
KINDS = {"html": "text/html", "json": "application/json", "css": "text/css"}


@pytest.fixture
def archive(tmp_path: Path) -> Path:
    path = tmp_path / "manual.zip"
    with ZipFile(path, "w", ZIP_DEFLATED) as made:
        for name, body in FILES.items():
            made.writestr(name, body)
    return path


@asynccontextmanager
async def served(where: Path, archive: Path) -> AsyncIterator[tuple[URL, aiohttp.ClientSession]]:
    whole = Whole(where)
    whole.page._manual = manual_files(archive)
    async with whole.served() as opened:
        yield opened


@pytest.mark.parametrize("encoding", ["gzip", "identity"])
async def test_each_file_arrives_as_it_was_built(
    tmp_path: Path, archive: Path, encoding: str
) -> None:
    headers = {"Accept-Encoding": encoding}
    async with served(tmp_path, archive) as (url, session):
        for name in ("index.html", "howto/wire.html", "assets/search.json", "assets/empty.css"):
            async with session.get(url / "docs" / name, headers=headers) as answer:
                assert (answer.status, await answer.read()) == (200, FILES[name])
                assert answer.headers.get("Content-Encoding", "identity") == encoding
                assert answer.content_type == KINDS[name.rpartition(".")[2]]
                tag = answer.headers["ETag"]
                length = answer.headers["Content-Length"]
            known = headers | {"If-None-Match": tag}
            async with session.get(url / "docs" / name, headers=known) as answer:
                assert (answer.status, await answer.read()) == (304, b"")
            async with session.head(url / "docs" / name, headers=headers) as answer:
                assert (answer.status, answer.headers.get("Content-Length", "0")) == (200, length)
        for typed, leads_to in [("docs", "docs/"), ("docs/howto/wire", "docs/howto/wire.html")]:
            async with session.get(url / typed) as answer:
                assert (answer.status, answer.url) == (200, url / leads_to)


async def test_a_page_of_the_manual_may_run_its_own_inline_scripts_and_no_other(
    tmp_path: Path, archive: Path
) -> None:
    async with served(tmp_path, archive) as (url, session), session.get(url / "docs/") as answer:
        policy = answer.headers["Content-Security-Policy"]
    (scripts,) = [part for part in policy.split("; ") if part.startswith("script-src")]
    assert scripts.split()[1] == "'self'"
    assert scripts.count("'sha256-") == 2
    assert "unsafe" not in scripts
    assert "frame-ancestors 'none'" in policy


@pytest.mark.parametrize(
    "path",
    [
        "LICENSE", "howto", "howto/", "missing.html", "../above.html", "%2e%2e/above.html",
        "..%2fabove.html", "%2e%2e%2f%2e%2e%2fapp.py", "/etc/passwd", "index.html%00", "x" * 5000,
    ],
)  # fmt: skip
async def test_any_other_path_is_not_found(tmp_path: Path, archive: Path, path: str) -> None:
    (tmp_path / "above.html").write_text("not asked for")
    async with served(tmp_path, archive) as (url, _):
        asked = f"GET /docs/{path} HTTP/1.1\r\nHost: {url.host}\r\nConnection: close\r\n\r\n"
        reader, writer = await asyncio.open_connection(url.host, url.port)
        writer.write(asked.encode())
        answer = await reader.read()
        writer.close()
    assert answer.startswith(b"HTTP/1.1 404"), answer
    assert b"not asked for" not in answer


async def test_without_a_manual_a_page_says_how_to_get_it(tmp_path: Path) -> None:
    damaged = tmp_path / "damaged.zip"
    damaged.write_bytes(b"PK")
    for archive in (tmp_path / "none.zip", damaged):
        async with (
            served(tmp_path, archive) as (url, session),
            session.get(url / "docs/howto/wire.html") as answer,
        ):
            assert (answer.status, answer.content_type) == (404, "text/html")
            text = await answer.text()
    (needed,) = re.findall(r"pip install '\.\[(\w+)\]'", text)
    (script,) = re.findall(r"python (\S+\.py)", text)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert project["optional-dependencies"][needed][0].startswith("zensical")
    assert (ROOT / script).exists()

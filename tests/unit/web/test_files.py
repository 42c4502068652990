"""Tests of the page's files.

They are served by plain names only, compressed where it helps, and reloaded on change.
"""

from __future__ import annotations

import gzip
import os
from pathlib import Path

import pytest

from acsard.web.files import Files


@pytest.fixture
def page(tmp_path: Path) -> Path:
    page = tmp_path / "page"
    page.mkdir()
    (page / "index.html").write_text("<p>robot</p>" * 200)
    (page / "small.js").write_text("1")
    (page / "notes.txt").write_text("not served")
    (page / ".secret.js").write_text("1")
    (tmp_path / "above.js").write_text("1")
    (page / "link.js").symlink_to(tmp_path / "above.js")
    (page / "inner").mkdir()
    (page / "inner" / "deep.js").write_text("1")
    return page


def test_a_file_goes_out_with_its_type_and_packed(page: Path) -> None:
    file = Files(page).get("index.html")
    assert file is not None
    assert file.kind == "text/html; charset=utf-8"
    assert file.packed is not None
    assert gzip.decompress(file.packed) == file.body
    assert len(file.packed) < len(file.body)


def test_a_small_one_is_not_packed(page: Path) -> None:
    file = Files(page).get("small.js")
    assert file is not None
    assert file.packed is None


@pytest.mark.parametrize(
    "name",
    [
        "../above.js", "/etc/passwd", "inner/deep.js", "inner", "link.js", ".secret.js",
        "notes.txt", "missing.js", "", ".", "..", "a\0.js", "x" * 5000 + ".js",
    ],
)  # fmt: skip
def test_anything_else_is_not_there(page: Path, name: str) -> None:
    assert Files(page).get(name) is None


def test_a_changed_file_is_another(page: Path) -> None:
    files = Files(page)
    before = files.get("small.js")
    (page / "small.js").write_text("2")
    os.utime(page / "small.js", ns=(1, 1))
    after = files.get("small.js")
    assert before is not None
    assert after is not None
    assert (after.body, after.tag != before.tag) == (b"2", True)


def test_without_a_directory_there_is_nothing(tmp_path: Path) -> None:
    assert Files(tmp_path / "none").get("index.html") is None

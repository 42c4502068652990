"""What the page does and says, by its own scripts in Node: `page_stories.js` has the stories."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from acsard.web.answers import PAGE_DIRECTORY

HERE = Path(__file__).parent

pytestmark = pytest.mark.skipif(shutil.which("node") is None, reason="needs node")


def test_each_story_of_the_page_happens(tmp_path: Path) -> None:
    """`node page_stories.js WORDS`, in a copy of the page's files, plays some of them."""
    shutil.copytree(PAGE_DIRECTORY, tmp_path, dirs_exist_ok=True)
    (tmp_path / "package.json").write_text('{"type": "module"}')
    for name in ("page_browser.js", "page_stories.js"):
        shutil.copy(HERE / name, tmp_path)
    # No function runs long enough in the thread of one story for the compiler to pay.
    done = subprocess.run(
        ["node", "--no-opt", "page_stories.js"], cwd=tmp_path, capture_output=True, text=True,
        timeout=300.0, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    *failed, last = done.stdout.splitlines()
    assert failed == []
    assert int(last.split()[0]) > 50


def test_every_module_of_the_page_is_preloaded() -> None:
    """The browser can load all modules at once, because index.html lists them."""
    page = (PAGE_DIRECTORY / "index.html").read_text(encoding="utf-8")
    modules = {path.name for path in PAGE_DIRECTORY.glob("*.js")} - {"stop.js", "main.js"}
    for name in modules:
        assert f'<link rel="modulepreload" href="page/{name}"' in page

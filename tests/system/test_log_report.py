"""A report in a browser: it draws under its page's own policy; a stranger's words stay words."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest
from plotly.offline import get_plotlyjs

from acsard.report.page import page
from tests.unit.report.driven import followed
from tests.unit.report.test_page import EVIL, clock, evil_steps, origin

BROWSER = shutil.which("chromium")

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(BROWSER is None, reason="needs chromium"),
]

QUIETLY = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
)  # fmt: skip


def test_it_is_drawn_and_no_strangers_program_runs(tmp_path: Path) -> None:
    assert BROWSER is not None
    path = tmp_path / "evil.html"
    evil = "<script>document.title = 'taken'</script>"
    text = page(followed(evil_steps()), origin(robot=evil + EVIL), get_plotlyjs(), clock)
    # Were the escaping forgotten somewhere, the policy would still stop it.
    path.write_text(text.replace("<h1>", f"<h1>{evil}"), encoding="utf-8")
    done = subprocess.run(
        [
            BROWSER,
            *QUIETLY,
            f"--user-data-dir={tmp_path / 'browser'}",
            "--virtual-time-budget=20000",
            "--dump-dom",
            path.as_uri(),
        ],
        capture_output=True,
        text=True,
        check=True,
        timeout=100,
    )
    drawn = done.stdout
    assert len(re.findall(r'<div class="picture js-plotly-plot"', drawn)) == 7
    assert len(re.findall(r'<g class="trace bars"', drawn)) >= 3
    title, *_ = re.findall(r"<title>(.*?)</title>", drawn)  # the others are in the pictures
    assert title.startswith("&lt;script&gt;document.title")

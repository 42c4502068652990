"""A report works in a browser with the content policy of its page.

Text from other clients is shown as text and never runs as code.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.system.chromium import CHROMIUM, PHONE, SIDEWAYS, browsing
from tests.system.harness import until
from tests.unit.test_recording_report import drive_of_two, evil, report

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="needs chromium-headless-shell"),
]

CUT = """[...document.querySelectorAll('.js-plotly-plot text')]
    .filter(one => one.textContent.trim())
    .map(one => [one.textContent, one.getBoundingClientRect(),
        one.closest('.js-plotly-plot').getBoundingClientRect()])
    .filter(([, text, box]) => text.width > 0 && (text.left < box.left - 0.5
        || text.right > box.right + 0.5 || text.bottom > box.bottom + 0.5))
    .map(([name]) => name)"""

DRAWN = "document.querySelectorAll('.js-plotly-plot:has(.main-svg)').length"


@pytest.mark.nightly
def test_a_report_is_drawn_and_an_injected_script_does_not_run(tmp_path: Path) -> None:
    path = tmp_path / "evil.html"
    script = "<script>document.title = 'taken'</script>"
    # If the escaping were missing somewhere, the policy would still block the script.
    path.write_text(evil().replace("<h1>", f"<h1>{script}"), encoding="utf-8")
    with browsing() as browser:
        browser.open(path.as_uri())
        until(lambda: browser.js(DRAWN) == 2, 30.0, "all pictures")
        assert browser.js("document.querySelectorAll('g.trace.bars').length") >= 3
        assert browser.js("document.title").startswith("</script>")


@pytest.mark.nightly
def test_no_label_of_a_picture_is_cut_on_a_phone_also_after_it_is_turned(tmp_path: Path) -> None:
    path = tmp_path / "new.html"
    path.write_text(report(drive_of_two(), "acsar", []), encoding="utf-8")
    with browsing() as browser:
        browser.size(*PHONE)
        browser.open(path.as_uri())
        until(lambda: browser.js(DRAWN) == 2, 30.0, "all pictures")
        for size in (PHONE, SIDEWAYS, PHONE):
            browser.size(*size)
            drawn = f"document.querySelector('#time .main-svg').clientWidth > {0.8 * size[0]}"
            fits = f"{drawn} && document.documentElement.scrollWidth <= {size[0]}"
            until(lambda fits=fits: browser.js(fits), 10.0, f"pictures for {size}")  # type: ignore[misc]
            browser.js("new Promise(done => setTimeout(() => requestAnimationFrame(done), 500))")
            assert browser.js("innerWidth") == size[0]
            assert browser.js("document.querySelectorAll('.xtick text').length") >= 2
            assert browser.js(CUT) == [], size


def test_plotly_knows_every_attribute_of_the_pictures(tmp_path: Path) -> None:
    path = tmp_path / "new.html"
    path.write_text(report(drive_of_two(), "acsar", []), encoding="utf-8")
    with browsing() as browser:
        browser.open(path.as_uri())
        until(lambda: browser.js(DRAWN) == 2, 30.0, "all pictures")
        unknown = browser.js(
            "JSON.parse(document.getElementById('pictures').textContent)"
            ".flatMap(one => Plotly.validate(one.data, one.layout) || [])"
            ".map(error => error.msg)"
        )
        assert unknown == []

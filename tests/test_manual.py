"""The manual: each page is in its contents, it builds strictly, and Home leads to the answers."""

from __future__ import annotations

import html
import re
import runpy
from contextlib import redirect_stdout
from io import StringIO
from typing import get_args
from zipfile import ZipFile

import pytest

from acsard.core.codes import CODES
from acsard.core.messages.schema import RobotState
from acsard.core.values import EventName
from acsard.recording.export import OUTPUT_COLUMNS
from acsard.web import manual
from tests.each import each
from tests.pages import MANUAL, ROOT, prose, text_of

HERE = ROOT / "deploy/manual"
HOME = "index.md"

# Questions of users, the page that answers each, and words of the answer.
QUESTIONS = {
    "Why does the robot not move?": ("tutorial/why.md", "acsard echo state -n 1 --short"),
    "What does the code `battery_empty` mean?": ("reference/codes.md", "`battery_empty`"),
    "Why does the code `not_newer` keep my program from driving?": (
        "reference/codes.md",
        "`not_newer`",
    ),
    "Which wire goes to pin 5?": ("howto/wire.md", "| 5 (PE3) |"),
    "What does my own firmware send?": ("reference/line.md", "ap12.50"),
    "How do I stop the robot, and release the stop?": ("howto/stop.md", "acsard call clear"),
    "What must my program send before it drives?": ("explanation/commands.md", "zero"),
    "How do I drive from Go?": ("howto/languages.md", "go run"),
    "What is the default of `wheel_radius`?": ("reference/settings.md", "`wheel_radius`"),
    "How do I install it without internet?": ("howto/install.md", "dpkg --install"),
    "How do I undo an upgrade?": ("howto/upgrade.md", "service rollback"),
    "What happened at 14:05?": ("howto/what-happened.md", "show --from 14:05"),
    "How do I let a phone drive?": ("howto/phone.md", "invite operator"),
    "Why can `ros2 topic pub` not drive?": ("howto/ros-drive.md", "never sends a zero"),
    "How do I stop all robots?": ("howto/fleet-all.md", "acsard call stop --id"),
    "How do I let a laptop in?": ("howto/access.md", "tls init"),
    "Which role may clear a stop?": ("reference/keys.md", "| operator | all of viewer"),
    "Why does the odometry drift?": ("howto/trouble.md", "Calibrate"),
    "Why may I not open ttyUSB0?": ("howto/trouble.md", "usermod -aG dialout"),
    "How do I change a setting for good?": ("howto/service.md", "--keep"),
}


def pages() -> list[str]:
    """Return the names of the pages as the contents and links have them."""
    return [page.removeprefix("deploy/manual/pages/") for page in MANUAL]


def links(page: str) -> set[str]:
    """Return the pages of the manual to which a page links."""
    here = HERE / "pages" / page
    targets = re.findall(
        r"\]\(([^)\s#:]+\.md)(?:#[^)\s]*)?\)", prose(f"deploy/manual/pages/{page}")
    )
    found = {(here.parent / target).resolve() for target in targets}
    top = (HERE / "pages").resolve()
    return {str(path.relative_to(top)) for path in found if path.is_relative_to(top)}


def test_the_contents_have_each_page_once() -> None:
    contents = re.findall(
        r"^ +- (?:\w[^:]*: )?(\S+\.md)$", text_of("deploy/manual/mkdocs.yml"), re.M
    )
    assert sorted(contents) == sorted(pages())


@each("question", QUESTIONS)
def test_home_answers_a_question_within_two_clicks(question: str) -> None:
    page, answer = QUESTIONS[question]
    first = links(HOME)
    assert page in first.union(*map(links, first))
    assert answer in text_of(f"deploy/manual/pages/{page}")


def test_each_name_on_the_page_of_troubles_is_one_of_the_product() -> None:
    """A code, an event, a counter, a field of `state`, a setting or an option."""
    text = text_of("deploy/manual/pages/howto/trouble.md")
    named = set(re.findall(r"`([a-z]+(?:_[a-z]+)+)`", text))
    assert len(named) > 10
    known = set(CODES) | {*get_args(EventName)} | set(RobotState.__struct_fields__)
    counters = text_of("deploy/manual/pages/reference/counters.md")
    assert not {name for name in named - known if f"`{name}`" not in counters}


def test_the_page_of_the_counters_has_each_name_that_the_product_counts() -> None:
    page = text_of("deploy/manual/pages/reference/counters.md")
    product = "".join(path.read_text() for path in (ROOT / "acsard").rglob("*.py"))
    names = set(re.findall(r'(?:counters\[|state\.count\()"(\w+)"', product))
    groups = tuple(re.findall(r"`(\w+_)<reason>`", page))
    assert len(names) > 15
    assert not {n for n in names if not n.startswith(groups) and f"`{n}`" not in page}


def test_no_text_on_the_page_of_the_codes_ends_in_the_middle() -> None:
    """A text whose advice stands in the next column ends in ; or : in the tables."""
    cells = re.findall(
        r"^\| `\w+` \| \w+ \| (.*?) \|", text_of("deploy/manual/pages/reference/codes.md"), re.M
    )
    assert len(cells) > 250
    assert not [cell for cell in cells if cell.endswith((";", ":"))]


def test_the_page_of_the_csv_form_names_each_column_that_an_export_writes() -> None:
    page = text_of("deploy/manual/pages/reference/csv.md")
    assert not [name for name in OUTPUT_COLUMNS if f"`{name}`" not in page]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Build the manual strictly, and return the text of its pages and of the sketch by name."""
    out = tmp_path_factory.mktemp("built") / "manual.zip"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(manual, "MANUAL", out)
        with redirect_stdout(StringIO()) as printed:
            runpy.run_path(str(HERE / "build.py"), run_name="__main__")
    assert printed.getvalue().startswith(f"wrote {out}; restart the page")
    with ZipFile(out) as files:
        names = [name for name in files.namelist() if name.endswith((".html", ".ino", ".txt"))]
        return {name: files.read(name).decode() for name in names}


@pytest.mark.slow
def test_the_manual_builds_strictly_and_loads_nothing_from_other_servers(
    site: dict[str, str],
) -> None:
    assert {page.replace(".md", ".html") for page in pages()} <= set(site)
    for name in [name for name in site if name.endswith(".html")]:
        text = site[name]
        loads = re.findall(r'<(?:script|link|img|iframe)\b[^>]*\b(?:src|href)="?([^" >]+)', text)
        assert loads
        assert not [target for target in loads if "//" in target], name
        bare = re.sub(r"<pre.*?</pre>|<script.*?</script>", "", text, flags=re.S)
        unrendered = re.findall(r"^(?:- |\||```|===).*", bare, re.M)
        assert not unrendered, f"{name}: a list or table needs an empty line before it"


@pytest.mark.slow
def test_the_manual_contains_the_files_of_its_version(site: dict[str, str]) -> None:
    assert 'href="../files/deploy/firmware/acsar/acsar.ino"' in site["howto/flash.html"]
    carried = {name.removeprefix("files/") for name in site if name.startswith("files/")}
    assert len(carried) > 10
    for name in carried:
        assert site[f"files/{name}"] == text_of(name.removesuffix(".txt"))
    assert "deploy/firmware.zip" in site["howto/flash.html"]
    assert "acsard/&lt;id&gt;/..." in site["reference/settings.html"], "escaped"
    assert "float | None" in html.unescape(site["reference/python.html"])
    # No link leads to a repository of which a robot has another version, or none.
    assert not [name for name, text in site.items() if "/blob/" in text]

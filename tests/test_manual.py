"""The manual: each page is in its contents, it builds strictly, and Home leads to the answers."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.each import each
from tests.pages import MANUAL, ROOT, prose, text_of

HERE = ROOT / "deploy/manual"
HOME = "index.md"

# Questions of users, the page that answers each, and words of the answer.
QUESTIONS = {
    "Why does the robot not move?": ("tutorial/why.md", "acsard echo state -n 1 --short"),
    "What does the code `battery_empty` mean?": ("reference/codes.md", "`battery_empty`"),
    "Why does the code `not_newer` keep my program from driving?": (
        "reference/reasons.md",
        "`not_newer`",
    ),
    "Which wire goes to pin 5?": ("howto/wire.md", "| 5 (PE3) |"),
    "What does my own firmware send?": ("reference/line.md", "ap12.50"),
    "How do I stop the robot, and release the stop?": ("explanation/latches.md", "srv/clear"),
    "What must my program send before it drives?": ("explanation/arming.md", "zero"),
    "How do I drive from Go?": ("howto/languages.md", "go run"),
    "What is the default of `wheel_radius`?": ("reference/settings.md", "`wheel_radius`"),
    "How do I install it without internet?": ("howto/install-package.md", "dpkg --install"),
    "How do I undo an upgrade?": ("howto/upgrade.md", "service rollback"),
    "What happened at 14:05?": ("howto/what-happened.md", "show --from 14:05"),
    "How do I let a phone drive?": ("howto/phone.md", "invite operator"),
    "Why can `ros2 topic pub` not drive?": ("howto/ros-drive.md", "it sends no zero"),
    "How do I stop all robots?": ("howto/fleet-all.md", "acsard call stop --id"),
    "How do I let a laptop in?": ("howto/access.md", "tls init"),
    "Which role may clear a stop?": ("reference/keys.md", "| operator | all of viewer"),
    "How do I change a setting for good?": ("howto/settings.md", "--keep"),
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
    return {
        str((here.parent / target).resolve().relative_to((HERE / "pages").resolve()))
        for target in targets
    }


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


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the manual strictly, and return the directory of its site."""
    work = tmp_path_factory.mktemp("built") / "manual"
    shutil.copytree(HERE, work, ignore=shutil.ignore_patterns("site", ".cache"))
    command = [sys.executable, "-m", "zensical", "build", "--strict", "-f", "mkdocs.yml"]
    done = subprocess.run(
        command, cwd=work, capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return work / "site"


def test_the_manual_builds_strictly_and_loads_nothing_from_other_servers(site: Path) -> None:
    built = {str(path.relative_to(site).with_suffix(".md")) for path in site.rglob("*.html")}
    assert set(pages()) <= built
    for path in site.rglob("*.html"):
        loads = re.findall(
            r"<(?:script|link|img|iframe)\b[^>]*\b(?:src|href)=\"?([^\" >]+)", path.read_text()
        )
        assert loads
        assert not [target for target in loads if "//" in target], path
        assert "|---" not in path.read_text(), f"{path}: a table is not rendered"

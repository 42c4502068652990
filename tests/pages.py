"""The pages of the project, their blocks of code, and which commands the tests run.

A page says with a comment which commands `tests/system/test_pages.py` does not run, and why:
`<!-- not run: needs ROS -->`. Below the title it is about all blocks of the page, and otherwise
about the block in the next line. If it quotes parts of commands (`--port DEVICE`), it is about
these commands only.
"""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path
from textwrap import dedent
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]

PAGES = ["README.md", "acsard/README.md", "tests/README.md", "deploy/README.md"]
PAGES += [str(path.relative_to(ROOT)) for path in sorted(ROOT.glob("deploy/*/README.md"))]
PAGES += [str(path.relative_to(ROOT)) for path in sorted(ROOT.glob(".github/**/*.md"))]

MANUAL = [str(path.relative_to(ROOT)) for path in sorted(ROOT.glob("deploy/manual/pages/**/*.md"))]

PAGES += MANUAL

_NOT_RUN = r"<!-- not run: ((?:(?! -->).)*) -->\n"
_WHOLE_PAGE = re.compile(rf"\A# .*\n+{_NOT_RUN}")
_FENCED = re.compile(rf"^ *(?:{_NOT_RUN} *)?```([a-z0-9]*)\n(.*?)^ *```$", re.M | re.S)


class Block(NamedTuple):
    """A fenced block and its place on a page."""

    page: str
    line: int
    language: str
    text: str
    not_run: str

    @property
    def where(self) -> str:
        return f"{self.page}:{self.line}"

    def commands(self) -> list[str]:
        """Return the commands of the block, without comments and without printed output."""
        lines = self.text.splitlines()
        if self.language == "console":
            lines = [line.removeprefix("$ ") for line in lines if line.startswith("$ ")]
        elif self.language != "sh":
            return []
        bare = [re.sub(r"(^|\s)#.*", "", line).strip() for line in lines]
        return [re.sub(r"\s+", " ", line) for line in bare if line]

    def run(self) -> list[str]:
        """Return the commands that the page does not exempt."""
        exempt = re.findall("`([^`]+)`", self.not_run)
        if self.not_run and not exempt:
            return []
        return [line for line in self.commands() if not any(part in line for part in exempt)]

    def printed(self) -> list[str]:
        """Return the output that a console block shows."""
        lines = self.text.splitlines() if self.language == "console" else []
        return [line for line in lines if not line.startswith("$ ")]


def text_of(page: str) -> str:
    return (ROOT / page).read_text(encoding="utf-8")


@cache
def blocks(*languages: str) -> list[Block]:
    """Return the fenced blocks of all pages in these languages, or in any language."""
    found = []
    for page in PAGES:
        text = text_of(page)
        whole = _WHOLE_PAGE.match(text)
        for match in _FENCED.finditer(text):
            line = text.count("\n", 0, match.start(2)) + 1
            reason = match[1] or (whole[1] if whole else "")
            found.append(Block(page, line, match[2], dedent(match[3]), reason))
    return [block for block in found if block.language in languages or not languages]


def prose(page: str) -> str:
    """Return a page without its fenced blocks."""
    return _FENCED.sub("", text_of(page))

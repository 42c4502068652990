"""The README is true: its key table is the topic table, and its commands and examples exist.

`python -m tests.test_readme` rewrites the table.
"""

from __future__ import annotations

import re
import tomllib
from argparse import _SubParsersAction
from pathlib import Path

from acsard.cli import parser
from acsard.core.messages.topics import TOPICS

README = Path(__file__).parent.parent / "README.md"
TABLE = re.compile(r"(<!-- keys: acsard topics -->\n).*?(<!-- end of keys -->)", re.S)


def table() -> str:
    rows = ["| key | direction | type | rate | meaning |", "|---|---|---|---|---|"]
    for t in TOPICS:
        cells = (f"`{t.key}`", t.direction, t.type, t.rate, t.note)
        rows.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join(rows) + "\n"


def test_the_key_table_is_the_topic_table() -> None:
    match = TABLE.search(README.read_text())
    assert match is not None
    assert match[0].split("-->\n", 1)[1].rsplit("<!--", 1)[0] == table()


def test_every_verb_named_in_the_readme_exists() -> None:
    (verbs,) = [a.choices for a in parser()._actions if isinstance(a, _SubParsersAction)]
    named = set(re.findall(r"^\$ acsard ([a-z]+)|`acsard ([a-z]+)[ `]", README.read_text(), re.M))
    assert {a or b for a, b in named} <= set(verbs)


def test_every_extra_is_named_on_a_page() -> None:
    """A reader learns from the pages which features each extra adds."""
    root = README.parent
    extras = tomllib.loads((root / "pyproject.toml").read_text())["project"]
    pages = "".join(page.read_text() for page in (README, *root.glob("deploy/*/README.md")))
    for extra in extras["optional-dependencies"]:
        assert re.search(rf"`{extra}`|\[(\w+,)*{extra}(,\w+)*\]", pages), extra


def test_no_placeholder_waits_for_its_text() -> None:
    assert re.findall(r"^[ \t]*([A-Z][A-Z_]{2,})[ \t]*$", README.read_text(), re.M) == []


if __name__ == "__main__":
    text = README.read_text()
    README.write_text(TABLE.sub(lambda m: m[1] + table() + m[2], text))

"""The README is true: its commands and extras exist."""

from __future__ import annotations

import re
import tomllib
from argparse import _SubParsersAction
from pathlib import Path

from acsard.cli import parser

README = Path(__file__).parent.parent / "README.md"


def test_every_verb_named_in_the_readme_exists() -> None:
    (verbs,) = [a.choices for a in parser()._actions if isinstance(a, _SubParsersAction)]
    named = set(re.findall(r"^\$ acsard ([a-z]+)|`acsard ([a-z]+)[ `]", README.read_text(), re.M))
    assert {a or b for a, b in named} <= set(verbs)


def test_every_extra_is_named_on_a_page() -> None:
    """A reader learns from the pages which features each extra adds."""
    root = README.parent
    extras = tomllib.loads((root / "pyproject.toml").read_text())["project"]
    files = (README, root / "tests/README.md", *root.glob("deploy/*/README.md"))
    pages = "".join(page.read_text() for page in files)
    for extra in extras["optional-dependencies"]:
        assert re.search(rf"`{extra}`|\[(\w+,)*{extra}(,\w+)*\]", pages), extra


def test_the_readme_has_no_placeholder() -> None:
    assert re.findall(r"^[ \t]*([A-Z][A-Z_]{2,})[ \t]*$", README.read_text(), re.M) == []

"""Yields changes that undo one hunk of an old commit: old defects of this product."""

from __future__ import annotations

import ast
import hashlib
import re
import subprocess
from collections.abc import Iterator
from difflib import SequenceMatcher
from functools import partial
from pathlib import Path

from tests.power.trials import Trial

NEWEST, COMMITS = "19ebc69b", 500
"""The hunks are those of so many commits, of which this one is the newest."""
MOST_FILES = 6
"""A commit that changes more modules of the product is no single mend."""
LEAST_CONTEXT = 1


def hunks(root: Path) -> Iterator[Trial]:
    """Yield each hunk that can be undone today, the newest first.

    Only commits that change the product and its tests count.
    """

    def git(*words: str) -> str:
        done = subprocess.run(["git", "-C", root, *words], capture_output=True, text=True)
        return done.stdout

    for commit in git("log", f"-{COMMITS}", "--no-merges", "--format=%H", NEWEST).split():
        names = git("diff", "--name-only", f"{commit}^", commit).split()
        python = [name for name in names if name.endswith(".py")]
        changed = [name for name in python if name.startswith("acsard/")]
        tested = any(name.startswith("tests/") for name in python)
        if not tested or not 0 < len(changed) <= MOST_FILES:
            continue
        for path in changed:
            if not (root / path).exists():
                continue
            text = (root / path).read_text(encoding="utf-8")
            patch = git("diff", "-U3", f"{commit}^", commit, "--", path)
            for hunk in re.split(r"(?m)^@@ .*\n", patch)[1:]:
                undone = undo(text, hunk)
                if undone is not None and program(undone) not in ("", program(text)):
                    name = f"{commit[:8]} {path} {hashlib.sha256(hunk.encode()).hexdigest()[:8]}"
                    yield Trial("hunks", name, path, lines(text, undone), partial(str, undone))


def undo(text: str, hunk: str) -> str | None:
    """Return the text before the hunk, None if not exactly one place in the text fits it."""
    old = [line[1:] for line in hunk.splitlines() if line[:1] in (" ", "-")]
    new = [line[1:] for line in hunk.splitlines() if line[:1] in (" ", "+")]
    same = [line[:1] == " " for line in hunk.splitlines()]
    before, after = same.index(False), same[::-1].index(False)
    present = text.splitlines()
    for context in range(3, LEAST_CONTEXT - 1, -1):
        top, bottom = max(0, before - context), max(0, after - context)
        wanted = new[top : len(new) - bottom]
        starts = range(len(present) - len(wanted) + 1)
        found = [at for at in starts if present[at : at + len(wanted)] == wanted]
        if len(found) == 1:
            rest = present[found[0] + len(wanted) :]
            kept = [*present[: found[0]], *old[top : len(old) - bottom], *rest]
            return "\n".join(kept) + "\n"
    return None


def program(text: str) -> str:
    """Return what the source does, without docstrings and imports, and "" if it does nothing."""
    try:
        tree = ast.parse(text)
    except SyntaxError:
        return ""
    for node in ast.walk(tree):
        block = getattr(node, "body", None)
        if isinstance(block, list):
            node.body = [  # type: ignore[attr-defined]
                part
                for part in block
                if not isinstance(part, ast.Import | ast.ImportFrom)
                and not (isinstance(part, ast.Expr) and isinstance(part.value, ast.Constant))
            ]
    return ast.dump(tree)


def lines(text: str, other: str) -> frozenset[int]:
    """Return the numbers of the lines that differ, and of those beside a place without lines."""
    found = set[int]()
    matcher = SequenceMatcher(None, text.splitlines(), other.splitlines(), autojunk=False)
    for kind, start, end, _, _ in matcher.get_opcodes():
        if kind != "equal":
            found |= set(range(start + 1, end + 1)) or {start, start + 1}
    return frozenset(found)

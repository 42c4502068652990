"""Does what a change needs before its commit: python -m tests [--approve] [WORDS OF PYTEST]

Formats the code, writes the generated files, runs the linters, and then the tests of the files that
differ from the last commit: those that import a changed module, those that changed, and those of
the whole tree. `--approve` writes the approved texts anew; look at their difference.
"""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

from tests.pages import ROOT

PROGRAMS = Path(sys.executable).parent
TOOLS = (
    (PROGRAMS / "ruff", "check", "--fix"),
    (PROGRAMS / "ruff", "format"),
    (sys.executable, "-m", "tests.tools.tables"),
    (PROGRAMS / "lint-imports",),
    (PROGRAMS / "mypy",),
)


def changed() -> list[str]:
    """Return the files that differ from the last commit, or are new."""
    words = ["git", "ls-files", "--modified", "--others", "--exclude-standard"]
    staged = ["git", "diff", "--name-only", "--cached"]
    found = [subprocess.check_output(each, cwd=ROOT, text=True) for each in (words, staged)]
    return sorted({path for text in found for path in text.splitlines()})


def tests_of(files: Iterable[str]) -> list[str]:
    """Return the test files that changed, or import a module of `files`."""
    found = {path for path in files if Path(path).name.startswith("test_")}
    for path in files:
        if not path.endswith(".py"):
            continue
        place, _, name = path.removesuffix(".py").replace("/", ".").rpartition(".")
        whole, room = re.escape(f"{place}.{name}"), re.escape(place)
        imports = rf"(from|import) {whole}\b|from {room} import .*\b{name}\b"
        for test in (ROOT / "tests").rglob("test_*.py"):
            if re.search(imports, test.read_text(encoding="utf-8")):
                found.add(str(test.relative_to(ROOT)))
    return sorted(path for path in found if (ROOT / path).exists())


def main(words: list[str]) -> int:
    for command in TOOLS:
        if code := subprocess.call(command, cwd=ROOT):
            return code
    whole = sorted(str(path.relative_to(ROOT)) for path in (ROOT / "tests").glob("test_*.py"))
    tests = dict.fromkeys([*whole, *tests_of(changed())])
    print(f"tests: {' '.join(path for path in tests if path not in whole)} and tests/test_*.py")
    return subprocess.call([sys.executable, "-m", "pytest", *words, *tests], cwd=ROOT)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

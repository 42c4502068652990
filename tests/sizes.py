"""`python -m tests.sizes` prints the lines of each package of `acsard` and its longest modules.

There is no limit. A module or function that is far longer than the others may need to be split.
"""

from __future__ import annotations

import ast
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "acsard"
SHOWN = 10


def functions(path: Path) -> Iterator[tuple[int, str]]:
    """Yield the number of lines and the place of each function of a module."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            where = f"{path.relative_to(PACKAGE.parent)}:{node.lineno} {node.name}"
            yield (node.end_lineno or node.lineno) - node.lineno + 1, where


def main() -> None:
    """Print the table of packages, the longest modules and the longest functions."""
    modules = sorted(PACKAGE.rglob("*.py"))
    lengths = {path: len(path.read_text(encoding="utf-8").splitlines()) for path in modules}
    lines, count = Counter[str](), Counter[str]()
    for path, length in lengths.items():
        package = str(path.relative_to(PACKAGE).parent)
        lines[package] += length
        count[package] += 1
    for package, length in lines.most_common():
        print(f"{package:24} {count[package]:4} modules {length:6} lines")
    print(f"{'all':24} {len(modules):4} modules {sum(lengths.values()):6} lines\n")
    for path, length in Counter(lengths).most_common(SHOWN):
        print(f"{length:4} lines  {path.relative_to(PACKAGE.parent)}")
    print()
    longest = sorted((entry for path in modules for entry in functions(path)), reverse=True)
    for length, where in longest[:SHOWN]:
        print(f"{length:4} lines  {where}")


if __name__ == "__main__":
    main()

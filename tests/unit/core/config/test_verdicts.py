"""Each configuration in `verdicts.txt` has the problems (`!`) and warnings (`?`) that follow it.

To write these lines anew, run `pytest --approve tests/unit/core/config/test_verdicts.py`, and then
read `git diff`.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from acsard.core.config.contradictions import warnings
from acsard.core.config.parsing import ConfigError, parse

PAGE = Path(__file__).with_name("verdicts.txt")


def verdict(text: str) -> list[str]:
    """Return a line for each problem of a configuration, or else for each warning."""
    try:
        config = parse(text.encode())
    except ConfigError as error:
        return [f"! {problem}" for problem in error.problems]
    return [f"? {warning}" for warning in warnings(config)]


def test_each_configuration_has_its_problems_and_warnings(
    approved: Callable[[Path, str], None],
) -> None:
    blocks = []
    for block in PAGE.read_text(encoding="utf-8").rstrip("\n").split("\n\n"):
        lines = [line for line in block.splitlines() if not line.startswith(("! ", "? "))]
        blocks.append("\n".join([*lines, *verdict("\n".join(lines))]))
    approved(PAGE, "\n\n".join(blocks) + "\n")

"""`python -m tests.tools.interface`: write down the public names of the version that is released.

Only the steps of a release run it, as `deploy/release/README.md` says. The names are those of the
reference in the manual. `tests/test_interface.py` compares them with the names of the last release.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

from acsard import __version__

ROOT = Path(__file__).resolve().parents[2]

REFERENCE = ROOT / "deploy/manual/pages/reference"

PUBLIC = (
    "settings", "keys", "messages", "codes", "events", "counters", "commands", "python", "http",
    "websocket", "ros", "status-line",
)  # fmt: skip
"""The pages whose tables are the public interface."""

RELEASED = ROOT / "tests/vectors/interface.txt"


def names() -> set[str]:
    """Return the names of all pages."""
    return {
        name for page in PUBLIC for name in names_of(page, (REFERENCE / f"{page}.md").read_text())
    }


def names_of(page: str, text: str) -> Iterator[str]:
    """Yield each name of a page: `settings/limits/linear_speed`, `messages/Odometry/pose`."""
    section = ""
    for line in text.splitlines():
        if line.startswith("## ") and page != "codes":  # a code is one word everywhere
            section = f"{line.removeprefix('## ').strip('`')}/"
        elif line.startswith("| "):
            first = re.sub(r"^\| `[A-Z]+` \| ", "", line).split(" | ")[0]  # no method of HTTP
            for code in re.findall(r"`([^`]+)`|<code>(.+?)</code>", first):
                # An argument's value and a method's arguments are not a part of its name.
                yield f"{page}/{section}{re.split('[ (=]', ''.join(code))[0]}"


def released() -> set[str]:
    """Return the names of the last release. Before the first one there is no such file."""
    lines = RELEASED.read_text().splitlines()
    return {line for line in lines if not line.startswith("#")}


if __name__ == "__main__":
    number = __version__.partition(".dev")[0]
    head = f"# The public names of {number}, written by python -m tests.tools.interface.\n"
    RELEASED.write_text(head + "".join(f"{name}\n" for name in sorted(names())))

"""The public names of this tree and of each release, which `tests/test_interface.py` compares.

The names are those of the reference in the manual. `python -m tests.tools.tables` writes those of
a release, a number without `.dev`, into a file of that number, which no later tree changes.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from html import unescape
from pathlib import Path

from acsard import __version__
from acsard.host.version import order

ROOT = Path(__file__).resolve().parents[2]

REFERENCE = ROOT / "deploy/manual/pages/reference"

PUBLIC = (
    "settings", "keys", "messages", "codes", "events", "counters", "commands", "python", "http",
    "websocket", "ros", "status-line",
)  # fmt: skip
"""The pages whose tables are the public interface."""

RELEASED = ROOT / "tests/vectors/interface"


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
            first, second, *_ = [*re.sub(r"^\| `[A-Z]+` \| ", "", line).split(" | "), ""]
            for code in re.findall(r"`([^`]+)`|<code>(.+?)</code>", first):
                # An argument's value and a method's arguments are not a part of its name.
                name = re.split("[ (=]", "".join(code))[0].replace("\\|", "|")
                yield f"{page}/{section}{unescape(name)}"
                if page == "messages":  # the values of a field that has no others
                    for value in re.findall(r"`([^`]+)`", second):
                        yield f"{page}/{section}{name}/{value}"


def file_of_release() -> str:
    """Return the text of the file of this version."""
    head = f"# The public names of {__version__}, written by python -m tests.tools.tables.\n"
    return head + "".join(f"{name}\n" for name in sorted(names()))


def last_release(before: str = __version__) -> Path:
    """Return the file of the last release before a version."""
    files = {order(path.stem): path for path in RELEASED.glob("*.txt")}
    return files[max(number for number in files if number < order(before))]


def released(before: str = __version__) -> set[str]:
    """Return the names of the last release before a version."""
    lines = last_release(before).read_text().splitlines()
    return {line for line in lines if not line.startswith("#")}

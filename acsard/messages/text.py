"""Makes text from strangers, such as names, reasons and messages, harmless for a terminal."""

from __future__ import annotations

import re


def printable(text: str) -> str:
    """Return the text on one line, without control characters that a terminal would obey."""
    return "".join(" " if c.isspace() else c if c.isprintable() else "\ufffd" for c in text)


def lines(text: str) -> str:
    """Make a text of several lines printable, and keep its line breaks."""
    return "\n".join(map(printable, text.split("\n")))


_ABOVE_ASCII = re.compile(r"[^\x00-\x7e]")


def json_line(text: str) -> str:
    """Escape the unprintable characters of a JSON text; the JSON value stays the same."""
    return _ABOVE_ASCII.sub(
        lambda m: m[0] if m[0].isprintable() or ord(m[0]) > 0xFFFF else f"\\u{ord(m[0]):04x}", text
    )

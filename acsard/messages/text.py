"""Text from elsewhere, made harmless for a terminal: names, reasons and messages of strangers."""

from __future__ import annotations

import re


def printable(text: str) -> str:
    """The text without what a terminal would obey, on one line."""
    return "".join(" " if c.isspace() else c if c.isprintable() else "\ufffd" for c in text)


def lines(text: str) -> str:
    """The same of a text that may have lines."""
    return "\n".join(map(printable, text.split("\n")))


_ABOVE_ASCII = re.compile(r"[^\x00-\x7e]")


def json_line(text: str) -> str:
    """JSON with what cannot be printed escaped: it stays the same JSON."""
    return _ABOVE_ASCII.sub(
        lambda m: m[0] if m[0].isprintable() or ord(m[0]) > 0xFFFF else f"\\u{ord(m[0]):04x}", text
    )

"""Writes settings as the text of an `acsard.toml`."""

from __future__ import annotations

from collections.abc import Mapping

from acsard.core.config.validation import write


def document(table: dict[str, object], path: str = "") -> list[str]:
    """Return the lines of a TOML document, nested tables last; `path` is the dotted name."""
    lines: list[str] = []
    tables: list[str] = []
    for key, value in table.items():
        where = f"{path}.{key}" if path else key
        if isinstance(value, dict):
            tables += ["", f"[{where}]", *document(value, where)]
        elif isinstance(value, list | tuple) and value and isinstance(value[0], dict):
            for item in value:
                tables += ["", f"[[{where}]]", *document(item, where)]
        else:
            lines.append(f"{key} = {write(value)}")
    return lines + tables


def excerpt(keys: Mapping[str, object]) -> list[str]:
    """Return the lines of a TOML document with some settings, by dotted key, and headers."""
    lines: list[str] = []
    table = ""
    for key, value in sorted(keys.items(), key=lambda item: item[0].count(".")):
        where, _, name = key.rpartition(".")
        if where != table:
            lines += [""] * bool(lines) + [f"[{where}]"]
            table = where
        lines.append(f"{name} = {write(value)}")
    return lines

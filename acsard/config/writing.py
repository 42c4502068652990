"""A configuration as the text of an `acsard.toml`."""

from __future__ import annotations

from acsard.config.validation import write


def document(table: dict[str, object], path: str = "") -> list[str]:
    """The lines of a TOML document: plain keys first, then tables, then lists of tables."""
    lines: list[str] = []
    tables: list[str] = []
    for key, value in table.items():
        where = f"{path}.{key}" if path else key
        if isinstance(value, dict):
            tables += ["", f"[{where}]", *document(value, where)]
        elif isinstance(value, list | tuple) and value and isinstance(value[0], dict):
            for one in value:
                tables += ["", f"[[{where}]]", *document(one, where)]
        else:
            lines.append(f"{key} = {write(value)}")
    return lines + tables

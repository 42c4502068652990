"""Changes values in the text of an `acsard.toml`, and keeps its comments, order and line ends.

Needs the library tomlkit (extra `tools`).
"""

from __future__ import annotations

import re
from collections.abc import Mapping

from acsard.core.config.parsing import effective, from_builtins, parse
from acsard.core.config.validation import write


def edited(text: str, keys: Mapping[str, object]) -> str:
    """Return the content of an `acsard.toml` with new values, by dotted key.

    Raises `ConfigError` for an invalid old or new content, and `ValueError` for tables in a form
    that cannot be changed safely.
    """
    from tomlkit.exceptions import TOMLKitError

    wanted = effective(parse(text.encode()))
    for key, value in keys.items():
        *path, name = key.split(".")
        plain = wanted
        for part in path:
            plain = plain[part]  # type: ignore[assignment]
        plain[name] = value
    try:
        changed = _changed(text, keys)
    except TOMLKitError as error:
        raise ValueError(str(error)) from None
    if parse(changed.encode()) != from_builtins(wanted):
        raise ValueError("acsard cannot safely change tables that are written in this form")
    return changed


def _changed(text: str, keys: Mapping[str, object]) -> str:
    import tomlkit

    crlf = "\r\n" in text and text.count("\r\n") == text.count("\n")
    text, keys = _dotted(text.replace("\r\n", "\n") if crlf else text, keys)
    document = tomlkit.parse(text)
    for key, value in keys.items():
        *path, name = key.split(".")
        table = document
        for part in path:
            if part not in table:
                table[part] = tomlkit.table()
            table = table[part]
        if not (name in table and _adjusted(table[name], value)):
            table[name] = value
    changed = tomlkit.dumps(document)
    return changed.replace("\n", "\r\n") if crlf else changed


def _adjusted(array: object, value: object) -> bool:
    # Keeps its comments. False: it is partly changed at most, and the caller must replace it.
    from tomlkit.items import Array

    if not (isinstance(array, Array) and isinstance(value, list | tuple)):
        return False
    for n in reversed(range(len(array))):
        if array[n] not in value:
            del array[n]
    count = len(array)
    if list(array) != list(value[:count]):
        return False
    array.extend(value[count:])
    return True


def _dotted(text: str, keys: Mapping[str, object]) -> tuple[str, dict[str, object]]:
    # Insert new keys as lines `mcu.port = ...` into tables without a header `[mcu]`. Also returns
    # the keys that are still to be put into the text.
    import tomlkit

    # tomlkit cannot insert such keys: it would put a table header between the dotted keys.
    document = tomlkit.parse(text)
    lines, remaining = text.splitlines(keepends=True), dict(keys)
    for key, value in keys.items():
        table = key.partition(".")[0]
        top = next((n for n, s in enumerate(lines) if s.lstrip().startswith("[")), len(lines))
        places = [n for n in range(top) if re.match(rf"\s*{table}\s*\.", lines[n])]
        if not places or _has(document, key):
            continue
        lines.insert(places[0], f"{key} = {write(value)}\n")
        del remaining[key]
    return "".join(lines), remaining


def _has(document: object, key: str) -> bool:
    for part in key.split("."):
        if not isinstance(document, Mapping) or part not in document:
            return False
        document = document[part]
    return True

"""Changes an `acsard.toml` in place: comments kept, all or nothing."""

from __future__ import annotations

import os
import re
import stat
import tempfile
from collections.abc import Mapping
from pathlib import Path

from acsard.runtime.exits import Exit, ExitError
from acsard.validation import write


def require_tomlkit() -> None:
    """Say at once what is missing, before anybody has spent a minute on a check."""
    try:
        import tomlkit  # noqa: F401
    except ImportError:
        raise ExitError(
            Exit.FAILURE,
            "--write needs the library tomlkit; run: pip install 'acsard[mcu]', or leave --write "
            "out and paste the lines",
        ) from None


def change(file: Path, keys: Mapping[str, object]) -> None:
    """Set dotted keys in the file; raises `ExitError` and leaves it as it was if it cannot be."""
    from tomlkit.exceptions import TOMLKitError

    from acsard.config import ConfigError, effective, parse

    try:
        file = file.resolve(strict=True)
        text = file.read_bytes().decode()  # not read_text: it would lose CRLF
        wanted = effective(parse(text.encode()))
        for key, value in keys.items():
            *path, name = key.split(".")
            plain = wanted
            for part in path:
                plain = plain[part]  # type: ignore[assignment]
            plain[name] = value
        changed = _changed(text, keys)
        if effective(parse(changed.encode())) != wanted:
            raise ValueError("its tables are written in a way that cannot be changed safely")
        _replace(file, changed)
    except (OSError, ValueError, ConfigError, TOMLKitError) as error:
        raise ExitError(
            Exit.FAILURE, f"{file} is left as it was: {error}; write the lines by hand"
        ) from None


def _changed(text: str, keys: Mapping[str, object]) -> str:
    """The text with these keys; all lines end as its lines end."""
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
        table[name] = value
    changed = tomlkit.dumps(document)
    return changed.replace("\n", "\r\n") if crlf else changed


def _dotted(text: str, keys: Mapping[str, object]) -> tuple[str, dict[str, object]]:
    """Tables written as top-level dotted keys (`mcu.port = ...`) get new keys in the same form;
    tomlkit would open a table in the middle of them. The text, and the keys still to be set."""
    import tomlkit

    document = tomlkit.parse(text)
    lines, left = text.splitlines(keepends=True), dict(keys)
    for key, value in keys.items():
        table = key.partition(".")[0]
        top = next((n for n, s in enumerate(lines) if s.lstrip().startswith("[")), len(lines))
        places = [n for n in range(top) if re.match(rf"\s*{table}\s*\.", lines[n])]
        if not places or _has(document, key):
            continue
        lines.insert(places[0], f"{key} = {write(value)}\n")
        del left[key]
    return "".join(lines), left


def _has(document: object, key: str) -> bool:
    for part in key.split("."):
        if not isinstance(document, Mapping) or part not in document:
            return False
        document = document[part]
    return True


def _replace(file: Path, text: str) -> None:
    """The file is the old one or the new one, never half of it; who may read it stays."""
    before = file.stat()
    handle, name = tempfile.mkstemp(dir=file.parent, prefix=f".{file.name}.")
    try:
        with os.fdopen(handle, "w", encoding="utf-8", newline="") as new:
            new.write(text)
            new.flush()
            os.fchmod(new.fileno(), stat.S_IMODE(before.st_mode))
            try:
                os.fchown(new.fileno(), before.st_uid, before.st_gid)
            except PermissionError:
                pass  # another's file in a directory of ours: it becomes ours
            os.fsync(new.fileno())
        os.replace(name, file)
    except BaseException:
        os.unlink(name)
        raise

"""Changes an `acsard.toml` in place: comments kept, all or nothing."""

from __future__ import annotations

import os
import stat
import tempfile
from collections.abc import Mapping
from pathlib import Path

from acsard.runtime.exits import Exit, ExitError


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
    import tomlkit

    from acsard.config import ConfigError, effective, parse

    try:
        file = file.resolve(strict=True)
        text = file.read_text(encoding="utf-8")
        wanted = effective(parse(text.encode()))
        document = tomlkit.parse(text)
        for key, value in keys.items():
            *path, name = key.split(".")
            table, plain = document, wanted
            for part in path:
                if part not in table:
                    table[part] = tomlkit.table()
                table, plain = table[part], plain[part]  # type: ignore[assignment]
            table[name] = plain[name] = value
        changed = tomlkit.dumps(document)
        if effective(parse(changed.encode())) != wanted:
            raise ValueError("its tables are written in a way that cannot be changed safely")
        _replace(file, changed)
    except (OSError, ValueError, ConfigError) as error:
        raise ExitError(
            Exit.FAILURE, f"{file} is left as it was: {error}; write the lines by hand"
        ) from None


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

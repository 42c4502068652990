"""Changes a user's files in place, completely or not at all."""

from __future__ import annotations

import os
import stat
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path

from acsard.config.editing import edited
from acsard.config.parsing import ConfigError, parse
from acsard.config.settings import Config
from acsard.host.exits import Exit, ExitError
from acsard.host.extras import install

NEW_MODE = 0o644
"""Mode of a new configuration. It holds no secrets, and the service's own user reads it."""

Keys = Mapping[str, object]
"""Values by dotted keys, such as "mcu.port"."""


def require_tomlkit() -> None:
    """Raise an error now if tomlkit is missing, before a person has spent minutes on a check."""
    try:
        import tomlkit  # noqa: F401
    except ImportError:
        raise ExitError(
            Exit.FAILURE,
            f"--write needs the library tomlkit; run: {install('mcu')}, or leave --write out and "
            "paste the lines",
        ) from None


def change(file: Path, keys: Keys | Callable[[Config], Keys], *, new: bool = False) -> Keys:
    """Set keys in an `acsard.toml`, and return them.

    `keys` may be a function that computes them from the configuration. Raises `ExitError` and
    leaves the file unchanged if that is impossible. With `new` the file need not exist.
    """
    try:
        place, text, given = _changed(file, keys, new)
        replace(place, text)
        return given
    except (OSError, ValueError, ConfigError) as error:
        raise _left(file, error) from None


def require_changeable(
    file: Path, keys: Keys | Callable[[Config], Keys], *, new: bool = False
) -> None:
    """Raise the error that `change` would raise, before other work depends on the change."""
    try:
        place, _, _ = _changed(file, keys, new)
        if not os.access(place.parent, os.W_OK):
            raise PermissionError(f"no permission to write to {place.parent}")
    except (OSError, ValueError, ConfigError) as error:
        raise _left(file, error) from None


def _changed(
    file: Path, keys: Keys | Callable[[Config], Keys], new: bool
) -> tuple[Path, str, Keys]:
    """Return the resolved path, the text with the new keys, and the keys."""
    place = file.resolve(strict=not new)
    # `read_text` would lose CRLF line ends.
    text = "" if new and not place.exists() else place.read_bytes().decode()
    given = keys(parse(text.encode())) if callable(keys) else keys
    return place, edited(text, given), given


def _left(file: Path, error: Exception) -> ExitError:
    return ExitError(Exit.FAILURE, f"{file} is left as it was: {error}; write the lines by hand")


def replace(file: Path, text: str, *, synced: bool = True) -> None:
    """Replace the file by one with this text; its owner and its mode stay.

    Args:
        file: The file. Other processes find the old one or the new one, never a part of it.
        text: The new content.
        synced: True waits for the disk before the rename, so that a power cut leaves the old file
            or the new one. After False a power cut may leave a part of the new one until `sync`.
    """
    before = file.stat() if file.exists() else None
    handle, name = tempfile.mkstemp(dir=file.parent, prefix=f".{file.name}.")
    try:
        with os.fdopen(handle, "w", encoding="utf-8", newline="") as new:
            new.write(text)
            new.flush()
            os.fchmod(new.fileno(), stat.S_IMODE(before.st_mode) if before else NEW_MODE)
            try:
                if before:
                    os.fchown(new.fileno(), before.st_uid, before.st_gid)
            except PermissionError:
                # The file of another user in a directory of ours becomes ours.
                pass
            if synced:
                os.fsync(new.fileno())
        os.replace(name, file)
    except BaseException:
        os.unlink(name)
        raise


def sync(file: Path) -> None:
    """Wait until the disk has the file and its name."""
    for path in (file, file.parent):
        handle = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)

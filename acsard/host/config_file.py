"""Finds the configuration file, and changes values in the file, completely or not at all."""

from __future__ import annotations

import os
import subprocess
from codecs import BOM_UTF8
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path

from msgspec import Struct

from acsard.core.config.parsing import MAX_BYTES, ConfigError, parse
from acsard.core.config.settings import Config
from acsard.core.config.toml_editing import edited
from acsard.core.values import AcsardError
from acsard.host.atomic_file import replace, sync
from acsard.host.config_edit_process import edited_in_process
from acsard.host.errors import Exit, ExitError, MendableError
from acsard.host.extras import install

SEARCH_PATHS = (Path("acsard.toml"), Path("/etc/acsard/acsard.toml"))


def read(file: Path) -> bytes:
    """Return the content of a configuration file, but at most `MAX_BYTES` + 1 bytes.

    `parse` refuses more than `MAX_BYTES`. The daemon reads the file while it controls the robot, so
    reading a huge file must not take much memory or time. Raises `OSError` if the file cannot be
    read.
    """
    with file.open("rb") as opened:
        return opened.read(MAX_BYTES + 1)


def find(path: str | None) -> tuple[str, bytes]:
    """Return the path and the content of the configuration file.

    If `path` is None or "", the file is the one that $ACSARD_CONFIG names. If this variable is not
    set, it is the first existing file of `SEARCH_PATHS`. If there is no such file, return
    ("built-in defaults", b""). Raises `ExitError` if the file cannot be read.
    """
    named = path or os.environ.get("ACSARD_CONFIG")
    if named:
        try:
            return named, read(Path(named))
        except OSError as error:
            raise ExitError(
                Exit.BAD_CONFIG,
                f"cannot read {named}: {error.strerror}; correct --config or ACSARD_CONFIG, or the "
                "permissions of the file",
            ) from None
    for place in SEARCH_PATHS:
        try:
            return str(place), read(place)
        except FileNotFoundError:
            continue
        except OSError as error:
            raise ExitError(
                Exit.BAD_CONFIG,
                f"cannot read {place}: {error.strerror}; correct the permissions of this file, "
                "or name another file with --config",
            ) from None
    return "built-in defaults", b""


def writable(path: str | None) -> Path:
    """Return the path of the configuration file that the option --write changes.

    `path` is the value of the option --config, or None. Raises `MendableError` if there is no
    configuration file, if this user may not change the file, or if the library tomlkit is missing.
    Raises `MendableError` too if the file is the `acsard.toml` of a clone of acsard.
    """
    require_tomlkit()
    where, text = find(path)
    if not text and not Path(where).is_file():
        raise MendableError(
            "--write has no configuration file to change. Run this command on the robot, because a "
            "file on another machine does not affect the robot. Then either name the "
            "robot's file with --config, or make an acsard.toml on the robot (it may be empty)",
        )
    if _is_reference(Path(where)):
        raise MendableError(
            f"--write does not change {where}, because git tracks this file of the clone, and a "
            f"changed file hinders the next `git pull`: type `cp {where} robot.toml` and add "
            "--config robot.toml",
        )
    require_changeable(Path(where), {})
    return Path(where)


Keys = Mapping[str, object]
"""Maps dotted keys, such as "mcu.port", to configuration values."""


class Edit(Struct, frozen=True):
    """A prepared change of the configuration file of a running daemon."""

    file: Path
    keys: Keys
    """Maps the changed keys to their new values."""
    before: bytes
    """The content of the file from which `after` was computed."""
    after: str
    """The new content of the file."""


def prepare_edit(file: Path | None, keys: Keys) -> Edit:
    """Prepare the change that writes settings into the configuration file of the running daemon.

    `file` is this file, or None if the daemon runs without a configuration file. `keys` are the
    settings with their new values. Raises `MendableError` in these cases:

    - `file` is None, missing, read-only or tracked by git.
    - `keys` contains a timeout in [[commands.sources]].
    - The old or the new text is not a valid configuration.
    - The library tomlkit is missing, or computing the new text takes too long.
    """
    if file is None:
        raise MendableError(
            "the daemon runs without a configuration file: make an acsard.toml on the robot (it "
            "may be empty), name it with --config, and restart the daemon"
        )
    try:
        if any(key.startswith("commands.sources.") for key in keys):
            raise ValueError("the daemon cannot write a timeout of [[commands.sources]] to a file")
        place = _target(file)
        _require_writable(place)
        if is_tracked(place):
            raise MendableError(
                "git tracks it, and a changed file hinders the next `git pull`; start the daemon "
                "with a copy of it (--config)"
            )
        before = read(place)
        return Edit(file, keys, before, edited_in_process(_decoded(before), keys))
    except (OSError, ValueError, MendableError) as error:
        raise _not_changed(file, error) from None


def apply_edit(edit: Edit) -> None:
    """Write a prepared change to the configuration file.

    If another program has changed the file since the change was prepared, prepare the change again
    for the new content. If the change cannot be written, raise `MendableError` and leave the file
    unchanged.
    """
    try:
        # A change takes 0.2 s to compute, and a person's editor may write the file meanwhile.
        for _ in range(3):
            place = _target(edit.file)
            _require_writable(place)
            if read(place) == edit.before:
                replace(place, edit.after.encode())
                # Without this sync, a power cut may bring the old file back after the daemon has
                # reported success. Some file systems refuse the sync.
                with suppress(OSError):
                    sync(place.parent)
                return
            edit = prepare_edit(edit.file, edit.keys)
        raise ValueError("another program changes it again and again")
    except (OSError, ValueError) as error:
        raise _not_changed(edit.file, error) from None


def _target(file: Path, new: bool = False) -> Path:
    """Return the path of `file` without symbolic links. If `new` is true, the file may be missing.

    Raises `OSError` if the links form a loop, or if the file is missing and `new` is false.
    """
    # `Path.resolve` of Python 3.11 raises RuntimeError for a loop.
    try:
        return Path(os.path.realpath(file, strict=True))
    except FileNotFoundError:
        if not new:
            raise
        return Path(os.path.realpath(file))


def _require_writable(place: Path) -> None:
    """Raise `ValueError` if the daemon may not replace the file at `place`.

    `place` is a path without symbolic links.
    """
    if not place.is_file():
        raise ValueError("it is not a regular file")
    # Check the mode bits too, because root may write every file. Without these checks the daemon
    # would replace a read-only file, because that needs no permission to write to the file itself.
    if not (os.access(place, os.W_OK) and place.stat().st_mode & 0o222):
        raise ValueError("it is read-only for the daemon")
    if not os.access(place.parent, os.W_OK):
        raise ValueError(f"the daemon has no permission to write to {place.parent}")


def is_tracked(place: Path) -> bool:
    """Return whether git tracks the file at `place`, a path without symbolic links.

    The `acsard.toml` of a clone of acsard always counts as tracked. If git is missing or does not
    answer, all other files count as not tracked. Files in a repository of another user count as not
    tracked too, because git refuses to read that repository.
    """
    if not any((parent / ".git").exists() for parent in place.parents):
        return False
    # git refuses to read a repository of another user, because the configuration of that repository
    # could make git run any program with the daemon's rights.
    words = ["git", "-C", str(place.parent), "ls-files", "--error-unmatch", "--", place.name]
    try:
        asked = subprocess.run(words, capture_output=True, timeout=2.0)
    except (OSError, subprocess.TimeoutExpired):
        return _is_reference(place)
    return asked.returncode == 0 or _is_reference(place)


def _is_reference(file: Path) -> bool:
    place = Path(os.path.realpath(file))
    top = place.parent
    in_clone = (top / ".git").exists() and (top / "acsard" / "__init__.py").is_file()
    return in_clone and place.name == "acsard.toml"


def require_tomlkit() -> None:
    """Raise `MendableError` if the library tomlkit is missing.

    A tool that works for a long time should call this first, to avoid failing at the end.
    """
    try:
        import tomlkit  # noqa: F401
    except ImportError:
        raise MendableError(
            f"--write needs the library tomlkit; run: {install('write')}, or leave out --write and "
            "copy the printed lines into the file",
        ) from None


def change(file: Path, keys: Keys | Callable[[Config], Keys], *, new: bool = False) -> Keys:
    """Set keys in an `acsard.toml`, and return the keys with their new values.

    `keys` maps the keys to the new values, or is a function that computes this mapping from the
    file's configuration. If `new` is true, a missing file is created. If the file cannot be
    changed, raise `MendableError` and leave it unchanged.
    """
    try:
        place, text, changes = _changed(file, keys, new)
        replace(place, text.encode())
        return changes
    except (OSError, ValueError, ConfigError) as error:
        raise _not_changed(file, error) from None


def require_changeable(
    file: Path, keys: Keys | Callable[[Config], Keys], *, new: bool = False
) -> None:
    """Raise `MendableError` if `change` would fail with the same arguments.

    A tool that works for a long time should call this first, to avoid failing at the end.
    """
    try:
        place, _, _ = _changed(file, keys, new)
        if not os.access(place.parent, os.W_OK):
            raise PermissionError(f"no permission to write to {place.parent}")
    except (OSError, ValueError, ConfigError) as error:
        raise _not_changed(file, error) from None


def _changed(
    file: Path, keys: Keys | Callable[[Config], Keys], new: bool
) -> tuple[Path, str, Keys]:
    place = _target(file, new)
    # `read_text` would lose CRLF line ends.
    text = "" if new and not place.exists() else _decoded(read(place))
    changes = keys(parse(text.encode())) if callable(keys) else keys
    return place, edited(text, changes), changes


def _decoded(content: bytes) -> str:
    # `read` may cut a character of a file that is too large. That is not the mistake to report, so
    # replace the character. The text stays too large, and `parse` reports that.
    # An editor on Windows may have put a byte-order mark before the text. The changed file does not
    # need the mark.
    text = content.removeprefix(BOM_UTF8)
    return text.decode(errors="replace" if len(content) > MAX_BYTES else "strict")


def _not_changed(file: Path, error: Exception) -> MendableError:
    # The text of an `AcsardError` contains its own remedy.
    mend = "" if isinstance(error, AcsardError) else "; edit the file by hand"
    return MendableError(f"{file} was not changed: {error}{mend}")

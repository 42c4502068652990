"""Finds the configuration file, and changes values in the file, completely or not at all."""

from __future__ import annotations

import fcntl
import os
from codecs import BOM_UTF8
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

from acsard.core.config.parsing import MAX_BYTES, ConfigError, parse
from acsard.core.config.settings import Config
from acsard.core.config.toml_editing import edited
from acsard.core.values import AcsardError
from acsard.host.atomic_file import real_path, replace
from acsard.host.errors import Exit, ExitError, MendableError
from acsard.host.extras import install

SEARCH_PATHS = (Path("acsard.toml"), Path("/etc/acsard/acsard.toml"))


def read(file: Path) -> bytes:
    """Return at most `MAX_BYTES` + 1 bytes, which `parse` refuses. Raises `OSError`.

    Reading a huge file must not take much memory or time.
    """
    with file.open("rb") as opened:
        return opened.read(MAX_BYTES + 1)


def find(path: str | None) -> tuple[str, bytes]:
    """Return the path and the content of the configuration file.

    Without `path`, it is that of $ACSARD_CONFIG, otherwise the first of `SEARCH_PATHS`, otherwise
    ("built-in defaults", b""). Raises `ExitError`.
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
    """Return the file that --write and --keep change; `path` is that of --config, or None.

    Raises `MendableError`, also for the `acsard.toml` of a clone and without tomlkit.
    """
    require_tomlkit()
    where, text = find(path)
    if not text and not Path(where).is_file():
        raise MendableError(
            "there is no configuration file to change. Run this command on the robot, because a "
            "file on another machine does not affect the robot. Then either name the "
            "robot's file with --config, or make an acsard.toml on the robot (it may be empty)",
        )
    if _is_reference(Path(where)):
        raise MendableError(
            f"{where} was not changed, because git tracks this file of the clone, and a "
            f"changed file hinders the next `git pull`: type `cp -n {where} robot.toml` and add "
            "--config robot.toml",
        )
    require_changeable(Path(where), {})
    return Path(where)


Keys = Mapping[str, object]  # values by dotted key, such as "mcu.port"


def _require_writable(place: Path) -> None:
    # Raises `ValueError`.
    # Check the mode bits too, because root may write every file, and because replacing a file needs
    # no permission to write to the file itself.
    if not (os.access(place, os.W_OK) and place.stat().st_mode & 0o222):
        raise ValueError("it is read-only")
    if not os.access(place.parent, os.W_OK):
        raise ValueError(f"no permission to write to {place.parent}")


def _is_reference(file: Path) -> bool:
    place = Path(os.path.realpath(file))
    top = place.parent
    in_clone = (top / ".git").exists() and (top / "acsard" / "__init__.py").is_file()
    return in_clone and place.name == "acsard.toml"


def require_tomlkit() -> None:
    """Raise `MendableError` without tomlkit, before a tool works for long and fails at the end."""
    try:
        import tomlkit  # noqa: F401
    except ImportError:
        raise MendableError(
            f"changing the file needs the library tomlkit: {install()}, or edit the file by hand"
        ) from None


def change(file: Path, keys: Keys | Callable[[Config], Keys], *, new: bool = False) -> Keys:
    """Set keys in an `acsard.toml`, and return them with their new values.

    They may be computed from the file's configuration. `new` may create the file. Raises
    `MendableError` and then leaves it unchanged.
    """
    try:
        with _locked(real_path(file, new).parent):
            place, text, changes = _changed(file, keys, new)
            replace(place, text.encode())
            return changes
    except (OSError, ValueError, ConfigError) as error:
        raise _not_changed(file, error) from None


@contextmanager
def _locked(directory: Path) -> Iterator[None]:
    # Two changes at once would lose one: the sync of a slow disk is between read and replacement.
    handle = os.open(directory, os.O_RDONLY | os.O_CLOEXEC)
    try:
        with suppress(OSError):  # a file system may have no locks
            fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


def require_changeable(
    file: Path, keys: Keys | Callable[[Config], Keys], *, new: bool = False
) -> None:
    """Raise `MendableError` if `change` would fail, before a tool works for long."""
    try:
        place, _, _ = _changed(file, keys, new)
        if place.exists():
            _require_writable(place)
        elif not os.access(place.parent, os.W_OK):
            raise PermissionError(f"no permission to write to {place.parent}")
    except (OSError, ValueError, ConfigError) as error:
        raise _not_changed(file, error) from None


def _changed(
    file: Path, keys: Keys | Callable[[Config], Keys], new: bool
) -> tuple[Path, str, Keys]:
    place = real_path(file, new)
    # Reading a pipe might never end, and a file in the place of a device would remove the device.
    if place.exists() and not place.is_file():
        raise ValueError("it is not a regular file")
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

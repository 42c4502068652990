"""Finds the configuration file, and changes its values in place, completely or not at all."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path

from acsard.core.config.editing import edited
from acsard.core.config.parsing import ConfigError, parse
from acsard.core.config.settings import Config
from acsard.host.atomic_file import replace
from acsard.host.errors import Exit, ExitError, MendableError
from acsard.host.extras import install

PLACES = (Path("acsard.toml"), Path("/etc/acsard/acsard.toml"))


def find(path: str | None) -> tuple[str, bytes]:
    """Return the path and the content of the configuration, or ("built-in defaults", b"")."""
    named = path or os.environ.get("ACSARD_CONFIG")
    if named:
        try:
            return named, Path(named).read_bytes()
        except OSError as error:
            raise ExitError(
                Exit.BAD_CONFIG, f"cannot read {named}: {error.strerror}; correct --config"
            ) from None
    for place in PLACES:
        try:
            return str(place), place.read_bytes()
        except FileNotFoundError:
            continue
        except OSError as error:
            raise ExitError(Exit.BAD_CONFIG, f"cannot read {place}: {error.strerror}") from None
    return "built-in defaults", b""


def writable(path: str | None) -> Path:
    """Return the file that --write changes.

    Raises `MendableError` if it or the library tomlkit is missing, or if it is the reference file
    of a clone of acsard.
    """
    require_tomlkit()
    where, text = find(path)
    if not text and not Path(where).is_file():
        raise MendableError(
            "--write has no configuration file to change: run it on the robot, and name the "
            "file with --config or make an acsard.toml there (it may be empty); a file on "
            "another machine changes nothing on the robot",
        )
    if _is_reference(Path(where)):
        raise MendableError(
            f"--write does not change {where}, because git tracks this file of the clone, and a "
            f"changed file hinders the next `git pull`: type `cp {where} robot.toml` and add "
            "--config robot.toml",
        )
    return Path(where)


def _is_reference(file: Path) -> bool:
    """Return whether this is the `acsard.toml` in the top directory of a clone of acsard."""
    place = file.resolve()
    top = place.parent
    in_clone = (top / ".git").exists() and (top / "acsard" / "__init__.py").is_file()
    return in_clone and place.name == "acsard.toml"


Keys = Mapping[str, object]
"""Values by dotted keys, such as "mcu.port"."""


def require_tomlkit() -> None:
    """Raise an error now if tomlkit is missing, before a person has spent minutes on a check."""
    try:
        import tomlkit  # noqa: F401
    except ImportError:
        raise MendableError(
            f"--write needs the library tomlkit; run: {install('write')}, or leave --write out and "
            "paste the lines",
        ) from None


def change(file: Path, keys: Keys | Callable[[Config], Keys], *, new: bool = False) -> Keys:
    """Set keys in an `acsard.toml`, and return them.

    `keys` may be a function that computes them from the configuration. Raises `MendableError` and
    leaves the file unchanged if that is impossible. With `new` the file need not exist.
    """
    try:
        place, text, given = _changed(file, keys, new)
        replace(place, text.encode())
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


def _left(file: Path, error: Exception) -> MendableError:
    return MendableError(f"{file} was not changed: {error}; write the lines by hand")

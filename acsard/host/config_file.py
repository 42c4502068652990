"""Finds the configuration file, and checks whether it can be changed."""

from __future__ import annotations

import os
from pathlib import Path

from acsard.host.exits import Exit, ExitError
from acsard.host.files import require_tomlkit

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

    Raises `ExitError` if it or the library tomlkit is missing.
    """
    require_tomlkit()
    where, text = find(path)
    if not text and not Path(where).is_file():
        raise ExitError(
            Exit.FAILURE,
            "--write has no configuration file to write to: on the robot, name it by --config, or "
            "make an acsard.toml there (an empty one is valid); a file on another machine changes "
            "nothing for the robot",
        )
    return Path(where)

"""Checks whether a service can run this installation: the venv and the Python that it uses."""

from __future__ import annotations

import os
import stat
import sys
from collections.abc import Sequence
from pathlib import Path

HOME = "/opt/acsard/venv"
"""Path of the venv in the unit files of `deploy/`."""

OUT_OF_SIGHT = ("/home", "/root", "/run/user", "/tmp", "/var/tmp")
"""Directories that a service cannot see."""


def misplaced(
    prefix: str = sys.prefix,
    base: str = sys.base_prefix,
    executable: str = sys.executable,
    hidden: Sequence[str] = OUT_OF_SIGHT,
) -> str:
    """Return why a service cannot run this installation, or "" if it can."""
    if prefix == base or _hidden(Path(prefix), hidden):
        return (
            f"{prefix} is no place for a service, which cannot see homes and /tmp; install acsard "
            f"in a venv at {HOME} (deploy/systemd/README.md)"
        )
    # A venv borrows its Python: its bin/python is a link to the one that it was made with.
    interpreter = Path(os.path.realpath(executable))
    for path in (Path(base), interpreter):
        if _hidden(path, hidden):
            return (
                f"the venv {prefix} borrows the Python in {path}, where a service sees nothing; "
                f"{_anew(prefix)}"
            )
    for path in (Path(prefix), interpreter):
        closed = _closed(path)
        if closed:
            return (
                f"the service's user may not enter {closed}, and needs {path}; `chmod o+rx "
                f"{closed}`, or {_anew(prefix)}"
            )
    return ""


def _anew(prefix: str) -> str:
    return f"make it anew with the system's: /usr/bin/python3 -m venv --clear {prefix}"


def _hidden(path: Path, hidden: Sequence[str]) -> bool:
    real = Path(os.path.realpath(path))
    return any(real.is_relative_to(place) for place in hidden)


def _closed(path: Path) -> Path | None:
    """Return the first part of `path` that other users may not enter, or None."""
    for place in (*reversed(path.parents), path):
        try:
            mode = place.stat().st_mode
        except PermissionError:
            return place
        except OSError:
            # The path does not exist, so nothing keeps the service out.
            return None
        if not mode & stat.S_IXOTH:
            return place
    return None

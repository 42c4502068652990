"""Finds the files of `deploy/` that a package of acsard contains."""

from __future__ import annotations

from pathlib import Path

import acsard
from acsard.host.errors import MendableError

# `pyproject.toml` has the same list for the wheel, and `acsard.toml` beside them.
PACKAGED = ("systemd", "udev", "zenoh", "ros2")


def source() -> Path:
    """Return `deploy/`, inside the package or beside it in a clone. Raises `MendableError`."""
    package = Path(acsard.__file__).parent
    inside = package / "deploy"
    if inside.is_dir():
        return inside
    clone = package.parent / "deploy"
    if not clone.is_dir():
        raise MendableError(
            f"the installation of acsard is incomplete: neither {inside} nor {clone} exists; "
            "install acsard again"
        )
    return clone


def reference(deploy: Path) -> Path:
    """Return the `acsard.toml` with all defaults, inside `deploy/` or beside it in a clone."""
    inside = deploy / "acsard.toml"
    return inside if inside.is_file() else deploy.parent / "acsard.toml"

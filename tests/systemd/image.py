"""`python -m tests.systemd.image DIR` makes the root file system of the container.

It needs only Python's own library, so `.ci/run` can make it while pip installs the rest.
"""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
import sys
from pathlib import Path

OURS = sys.version_info[:2]

SUITES = {(3, 11): "bookworm", (3, 13): "trixie"}
"""The Debian releases with our Python version, so that our installed packages run in there.

With any other Python the container is the Debian that we run on, with our Python mounted into it.
"""

PACKAGES = "systemd,systemd-sysv,dbus,udev,umockdev,iproute2,python3-minimal,libpython3-stdlib"


class UnavailableError(Exception):
    """This machine cannot run the container. The message says why."""


def suite() -> str:
    """Return the name of the Debian release to boot, or "" if none suits our Python version."""
    if OURS in SUITES:
        return SUITES[OURS]
    try:
        here = platform.freedesktop_os_release()
    except OSError:
        return ""
    return here.get("VERSION_CODENAME", "") if here["ID"] == "debian" else ""


def needs() -> str:
    """Return the reason why this machine cannot boot a container, or "" if it can."""
    if os.geteuid() != 0:
        return "not root"
    missing = [tool for tool in ("mmdebstrap", "systemd-nspawn") if shutil.which(tool) is None]
    if missing:
        return f"no {' and no '.join(missing)} (Debian: mmdebstrap, systemd-container)"
    if not suite():
        return "no Debian has Python {}.{}, and this is none that could be lent ours".format(*OURS)
    return "" if cgroups() else "no cgroup v2 hierarchy"


def cgroups() -> Path | None:
    for place in (Path("/sys/fs/cgroup"), Path("/sys/fs/cgroup/unified")):
        if (place / "cgroup.procs").exists() and (place / "cgroup.controllers").exists():
            return place
    return None


def build(where: Path) -> Path:
    """Make a root file system at `where`, unless this directory has one already."""
    if (where / "usr/lib/systemd/systemd").exists():
        return where
    where.parent.mkdir(parents=True, exist_ok=True)
    leave_out = ("doc", "locale", "man", "info")
    words = ["mmdebstrap", "--quiet", "--variant=minbase", f"--include={PACKAGES}"]
    words += ["--dpkgopt=force-unsafe-io"]
    words += [f"--dpkgopt=path-exclude=/usr/share/{name}/*" for name in leave_out]
    words += [suite(), str(where)]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    if done.returncode:
        shutil.rmtree(where, ignore_errors=True)
        raise UnavailableError(f"mmdebstrap: {done.stderr.strip()[-300:]}")
    return where


if __name__ == "__main__":
    if not needs():
        build(Path(sys.argv[1]))

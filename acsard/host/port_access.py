"""Says why a serial device cannot be opened or who uses it, and what to do about that."""

from __future__ import annotations

import grp
import os
import pwd
import stat
from collections.abc import Sequence
from pathlib import Path

from acsard.host.processes import Holder, is_pty, masters_of

GETTY = "agetty"  # the login console of Debian and Raspberry Pi OS

GROUP_RIGHTS = stat.S_IRGRP | stat.S_IWGRP

TTY_GROUP = 5  # of each Debian system; a login console gives the port to it

UNSEEN_GROUP = 65534  # any group outside of the service's user namespace (PrivateUsers=)


def console_advice(path: str) -> str:
    """Return how to remove the login console from a port. Ending it is no use: it starts again."""
    name = os.path.basename(path if is_pty(path) else os.path.realpath(path))
    return (
        "on a Raspberry Pi, `sudo raspi-config`, Interface Options, Serial Port: no login shell, "
        f"but serial hardware; elsewhere `sudo systemctl disable --now serial-getty@{name}`, and "
        "remove `console=` with this port from the kernel's command line (cmdline.txt). Then start "
        "the computer again"
    )


def denial(path: str) -> tuple[str, str]:
    """Return why this user may not open the device, and what to do."""
    status = os.stat(path)
    if status.st_gid == UNSEEN_GROUP:
        return f"{path} is not open to the group dialout, to which the service belongs", (
            "`sudo acsard doctor` names a login console that uses it; if there is none, let its "
            'udev rule set GROUP="dialout" and MODE="0660", as deploy/udev/70-acsar.rules does'
        )
    group, mode = _group(status.st_gid), stat.S_IMODE(status.st_mode)
    if mode & GROUP_RIGHTS != GROUP_RIGHTS:
        text = f"{path} has the mode {mode:03o}, so no group may open it"
        if status.st_gid == TTY_GROUP and not is_pty(path):
            return f"{text}: a login console ({GETTY}) probably uses it", console_advice(path)
        return text, f"run `sudo chmod g+rw {path}`, or correct the udev rule of this device"
    text = f"{path} belongs to group {group}"
    if status.st_gid in (os.getgid(), *os.getgroups()):
        text += ", and you are in it, but something else forbids to open it"
        return text, f"`ls -l {path}` and `getfacl {path}` show more; is this a container?"
    if _is_member(group):
        return f"{text}; you are in it, but this session is older", "log out and in again"
    if status.st_gid in (0, TTY_GROUP):  # whoever is in it may do much more
        return text, (
            f"run `sudo chown root:dialout {path}`, and let the udev rule of this device (as in "
            'deploy/udev/70-acsar.rules) set GROUP="dialout"'
        )
    return (
        f"{text}, but you are not in it",
        f"run `sudo usermod -aG {group} $USER`, then log in again (the systemd service does not "
        "need this for dialout, because its unit names that group)",
    )


def advice_about(path: str, holder: Holder) -> str:
    """Return what to do about a program that uses the port; "" if it simulates the board."""
    if holder.name == GETTY:
        return console_advice(path)
    if holder in masters_of(path):
        return ""
    if is_pty(path):
        return "end that program, unless it belongs to your simulator of the board"
    return f"end that program (`kill {holder.pid}`), or let it use another port"


def _group(number: int) -> str:
    try:
        return grp.getgrgid(number).gr_name
    except KeyError:
        return str(number)


def _is_member(group: str) -> bool:
    members: Sequence[str] = ()
    try:
        members = grp.getgrnam(group).gr_mem
        return pwd.getpwuid(os.getuid()).pw_name in members
    except KeyError:
        return False


def is_orphan(path: str) -> bool:
    """Whether a character device has no device. Opening a port would restart an Arduino."""
    number = os.stat(path).st_rdev
    place = Path("/sys/dev/char")
    if is_pty(path) or not place.is_dir():  # a pty has no entry
        return False
    return not (place / f"{os.major(number)}:{os.minor(number)}").exists()

"""acsard as a system service: its files, its commands, and which steps install or remove it.

The files are those of `deploy/`, with the path of this installation in the unit. Nothing that
somebody else wrote is overwritten or removed without force.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path

import acsard
from acsard.host.exits import Exit, ExitError
from acsard.host.placement import HOME
from acsard.host.steps import File, Keep, Remove, RemoveAll, Run, Step, Write, called

UNIT, DOOR, PAGE = "acsard.service", "acsard-door.service", "acsard-web.service"
ALL = (UNIT, DOOR, PAGE)
STOP = "acsard-stop"
UNITS = Path("/etc/systemd/system")
ETC = Path("/etc/acsard")
LAN = "lan.conf"
TLS = "/etc/acsard/tls"
"""Where `lan.conf` believes the certificates to be."""
STATES = {
    UNIT: (Path("/var/lib/acsard"), "its recordings, and the stop that it keeps"),
    PAGE: (Path("/var/lib/acsard-web"), "invitations to the page"),
}
"""Where units keep what they write, and what that is."""

Found = Mapping[Path, bytes | None]
"""What is there now in the place of each file."""

ASK_S = 10.0
"""systemd answers at once, or hangs."""

RELOAD = (
    Run(("systemctl", "daemon-reload")),
    Run(("udevadm", "control", "--reload"), may_fail=True),
)
AGAIN = ("tty", "usb-serial", "misc")
"""Subsystems with devices that the rules are about: they are looked at again."""

INSTALLED = (
    *RELOAD,
    Run(("udevadm", "trigger", *(f"--subsystem-match={one}" for one in AGAIN)), may_fail=True),
    # First by itself, whatever becomes of it: the page's unit mounts the directory it is given.
    Run(("systemctl", "start", UNIT), may_fail=True),
    Run(("systemctl", "enable", "--now", *ALL)),
)
GONE = (*RELOAD, Run(("systemctl", "reset-failed", *ALL), may_fail=True))


def files() -> list[File]:
    """Every file of the service, as this installation writes it."""
    reference = _reference().read_text(encoding="utf-8")
    return [
        *(_unit(name) for name in ALL),
        File(Path("/opt/acsard/bin") / STOP, (source() / "systemd" / STOP).read_bytes(), 0o755),
        File(
            Path("/etc/udev/rules.d/70-acsar.rules"),
            (source() / "udev" / "70-acsar.rules").read_bytes(),
        ),
        File(
            ETC / "acsard.toml",
            reference.replace('port = "sim"', 'port = "/dev/acsar"').encode(),
            kept=True,
        ),
    ]


def _unit(name: str) -> File:
    text = (source() / "systemd" / name).read_text(encoding="utf-8")
    return File(UNITS / name, text.replace(HOME, sys.prefix).encode())


def lan_drop_in(unit: str) -> File:
    """What lets a unit onto the local network and gives it its certificates."""
    return File(UNITS / f"{unit}.d" / LAN, (source() / "systemd" / LAN).read_bytes())


def admitting(directory: Path) -> Write | Keep | None:
    """What opens the installed service's door with these certificates; None without a service.

    The unit itself sees loopback only, and none of root's files. A drop-in that is there keeps its
    networks, which somebody may have narrowed.
    """
    if os.geteuid() != 0 or not (UNITS / DOOR).exists():
        return None
    file = lan_drop_in(DOOR)
    return admitted(file, file.found(), directory)


def admitted(file: File, found: bytes | None, directory: Path) -> Write | Keep:
    """The drop-in, as it is `found` or else as it comes, with the certificates of `directory`."""
    place = str(directory).encode()
    text = re.sub(
        rb"(?m)^(LoadCredential=[\w.-]+:).*/",
        lambda match: match[1] + place + b"/",
        file.content if found is None else found,
    )
    if text == found:
        return Keep(file.path, "it names these certificates")
    return Write(File(file.path, text))


def present(wanted: Iterable[File]) -> dict[Path, bytes | None]:
    """What is there now in the place of these files."""
    return {file.path: file.found() for file in wanted}


def installing(wanted: Iterable[File], found: Found, *, force: bool) -> list[Step]:
    """The steps to the service; raises `ExitError` when they would overwrite somebody's work."""
    steps: list[Step] = []
    changed: list[str] = []
    for file in wanted:
        there = found[file.path]
        if there == file.content or (file.kept and there is not None):
            steps.append(Keep(file.path))
            continue
        if there is not None:
            changed.append(str(file.path))
        steps.append(Write(file))
    if changed and not force:
        paths = ", ".join(changed)
        raise ExitError(Exit.FAILURE, f"would overwrite {paths}; look at them, or use --force")
    return [*steps, *INSTALLED]


def own_places() -> list[Path]:
    """Directories that may hold more of the service than was installed."""
    return [*(UNITS / f"{unit}.d" for unit in reversed(ALL)), ETC]


def strangers(files: Iterable[File], places: Iterable[Path]) -> list[Path]:
    """What else is in these places: certificates, drop-ins of somebody's own."""
    ours = {file.path for file in files}
    inside = (path for place in places if place.is_dir() for path in sorted(place.iterdir()))
    return [path for path in inside if path not in ours]


def uninstalling(
    wanted: Iterable[File],
    found: Found,
    others: Iterable[Path] = (),
    *,
    force: bool,
    purge: bool = False,
    stateful: Iterable[str] = (),
) -> list[Step]:
    """The steps that undo it, and what stays with the reason.

    What somebody has changed stays unless forced; a `kept` file, `others` and the `STATES` of the
    `stateful` units unless purged.
    """
    there = [file for file in wanted if found[file.path] is not None]
    why: dict[Path, str] = {}
    for file in there:
        if found[file.path] == file.content or purge:
            continue
        if file.kept:
            why[file.path] = "your configuration; --purge removes it"
        elif not force:
            why[file.path] = "somebody has changed it; --force removes it"
    if any(path.name == UNIT for path in why):
        # A unit that is started again must find what sends zeros after it.
        why |= {f.path: f"{UNIT} stays and needs it" for f in there if f.path.name == STOP}
    steps: list[Step] = [
        Keep(file.path, why[file.path]) if file.path in why else Remove(file.path) for file in there
    ]
    for path in others:
        what = "certificates and their authority" if path == Path(TLS) else "not of the service"
        steps.append(RemoveAll(path) if purge else Keep(path, f"{what}; --purge removes it"))
    for unit in stateful:
        where, what = STATES[unit]
        # systemd knows where it truly is; it must still know the unit.
        clean = Run(("systemctl", "clean", "--what=state", unit))
        steps.insert(0, clean if purge else Keep(where, f"{what}; --purge removes it"))
    units = [name for name in reversed(ALL) if any(file.path.name == name for file in there)]
    leaving = [Run(("systemctl", "disable", "--now", *units))] if units else []
    return [*leaving, *steps, *GONE]


def state(unit: str) -> str:
    """What systemd says of a unit, "" where it does not answer."""
    about = "--property=ActiveState,SubState,StatusText,NRestarts"
    try:
        done = called(("systemctl", "show", unit, about), ASK_S)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return done.stdout.strip() or done.stderr.strip()


def source() -> Path:
    """The files of `deploy/`: inside the package, or beside it in a clone."""
    package = Path(acsard.__file__).parent
    inside = package / "deploy"
    if inside.is_dir():
        return inside
    clone = package.parent / "deploy"
    if not clone.is_dir():
        raise ExitError(Exit.FAILURE, f"neither {inside} nor {clone} is there; install acsard anew")
    return clone


def _reference() -> Path:
    """The reference configuration, which lies beside `deploy/` in a clone."""
    inside = source() / "acsard.toml"
    return inside if inside.is_file() else source().parent / "acsard.toml"

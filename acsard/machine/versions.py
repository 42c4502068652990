"""Keeps versions of acsard side by side in /opt/acsard, and says which of them the service runs.

`/opt/acsard/<version>` is a complete copy with `bin/` and `lib/`. The link `current` names the
version in use, and `previous` the one before it. A copy gets its name, and a link its target, in
one step: after a kill or a power cut at any moment, `current` is a version that starts.
"""

from __future__ import annotations

import compileall
import fcntl
import os
import re
import shutil
import stat
import subprocess
import sys
import tempfile
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager, suppress
from filecmp import cmp
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from itertools import count
from pathlib import Path

import acsard
from acsard.host import version as own
from acsard.host.atomic_file import sync
from acsard.host.child import how_it_ended
from acsard.host.errors import MendableError
from acsard.host.processes import run_command
from acsard.machine.deploy_files import PACKAGED, reference, source

HOME = Path("/opt/acsard")
CURRENT, PREVIOUS = "current", "previous"
PACKAGE = "dist"  # the Debian package's own copies, from which it makes the others by hard links
STOP_PROGRAM = "acsard-stop"

UNFINISHED = ".unfinished-"

# The extras that users install. `test` and `dds` are for developers.
EXTRAS = frozenset({"foxglove", "tools"})

# systemd hides these from the service.
HIDDEN_DIRECTORIES = ("/home", "/root", "/run/user", "/tmp", "/var/tmp")

CHECK_TIMEOUT_S = 60.0  # Python starts slowly from an SD card


def launcher(interpreter: str) -> str:
    """Return the text of `bin/acsard`.

    It resolves `current` once, so no process imports from two versions.
    """
    return f"""\
#!{interpreter} -I
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "lib"))

from acsard.cli import entry

entry()
"""


# Which versions there are


def current(home: Path = HOME) -> str:
    """Return the version that the service runs, or ""."""
    return _target(home / CURRENT)


def previous(home: Path = HOME) -> str:
    """Return the version that the service ran before, or ""."""
    return _target(home / PREVIOUS)


def _target(link: Path) -> str:
    try:
        return os.readlink(link)
    except OSError:
        return ""


def installed(home: Path = HOME) -> list[str]:
    """Return all complete versions, the newest last."""
    programs = {path.parent.parent.name: path for path in home.glob(f"[0-9]*/bin/{STOP_PROGRAM}")}
    # Commits have no order: of two with the same number, the one that was made later is newer.
    return sorted(programs, key=lambda name: (own.order(name), programs[name].stat().st_mtime))


def unused(home: Path = HOME) -> str:
    """Return the newest version if it is newer than the one in use, or ""."""
    names, used = installed(home), current(home)
    return names[-1] if used in names and names[-1] != used else ""


def use(name: str, home: Path = HOME) -> None:
    """Make `name` the version in use, and the present one `previous`. Raises `OSError`."""
    before = current(home)
    if before and before != name:
        _link(home / PREVIOUS, before)
    _link(home / CURRENT, name)


def go_back(name: str, older: str, home: Path = HOME) -> None:
    """Undo `use`: `name` was in use before, and `older` or "" the previous one."""
    _link(home / CURRENT, name)
    if older:
        _link(home / PREVIOUS, older)
    else:
        (home / PREVIOUS).unlink(missing_ok=True)


def deploy_of(name: str, home: Path = HOME) -> Path:
    """Return the `deploy/` of a version."""
    return home / name / "lib" / "acsard" / "deploy"


def remove_others(home: Path = HOME) -> None:
    """Remove each version that is not in use, not the previous one and not of the package."""
    packaged = {path.name for path in (home / PACKAGE).glob("*")}
    for name in {*installed(home)} - {current(home), previous(home)} - packaged:
        with suppress(OSError):
            # If this program is killed now, the rest is no version, and `changing` removes it.
            os.rename(home / name, home / f"{UNFINISHED}{name}")
        shutil.rmtree(home / f"{UNFINISHED}{name}", ignore_errors=True)


@contextmanager
def changing(home: Path = HOME) -> Iterator[None]:
    """Keep other changes out. Raises `MendableError` while another program changes a version."""
    handle = os.open(home, os.O_RDONLY | os.O_CLOEXEC)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise MendableError(
                f"another program changes the version in {home}; wait until it has ended"
            ) from None
        for place in home.glob(f"{UNFINISHED}*"):  # its program was killed
            shutil.rmtree(place, ignore_errors=True)
        yield
    finally:
        os.close(handle)


def _link(link: Path, target: str) -> None:
    new = link.with_name(f".{link.name}")
    with suppress(FileNotFoundError):
        new.unlink()
    new.symlink_to(target)
    os.replace(new, link)
    sync(link.parent)


# A copy of the environment that runs this


def make_home(home: Path = HOME) -> None:
    """Make the directory of the versions, which every user may read."""
    if not home.exists():
        home.mkdir(parents=True)
        home.chmod(0o755)


def copy(home: Path = HOME) -> str:
    """Copy acsard and its libraries from the environment that runs this; return the copy's name.

    It is the version. If a copy with other content has this name, a number follows. Raises
    `MendableError`, and leaves nothing then.
    """
    python = service_python()
    place = Path(tempfile.mkdtemp(dir=home, prefix=UNFINISHED))
    try:
        _fill(place, python)
        for name in _names():
            there = home / name
            if not there.exists():
                _finish(place)
                os.rename(place, there)
                sync(home)
                return name
            if same(place, there):
                return name
        raise AssertionError  # the names do not end
    except OSError as error:
        raise MendableError(
            f"cannot copy acsard to {home}: {error.strerror or error}; remove the cause and run "
            "the command again. Nothing else was changed"
        ) from None
    finally:
        shutil.rmtree(place, ignore_errors=True)


def _names() -> Iterator[str]:
    name = own.version()
    yield name
    separator = "." if "+" in name else "+"
    for number in count(2):
        yield f"{name}{separator}{number}"


def is_own(name: str) -> bool:
    """Return whether `name` is a copy of the version that runs this."""
    return re.fullmatch(rf"{re.escape(own.version())}([.+]\d+)?", name) is not None


def service_python(hidden: Sequence[str] = HIDDEN_DIRECTORIES) -> str:
    """Return a Python of this version that the service may run. Raises `MendableError`."""
    name = f"python3.{sys.version_info.minor}"
    present = os.path.realpath(sys.executable)
    why = _closed(Path(present), hidden) or _closed(Path(sys.base_prefix), hidden)
    if not why:
        return present
    for place in (f"/usr/bin/{name}", f"/usr/local/bin/{name}"):
        if os.access(place, os.X_OK) and not _closed(Path(place), hidden):
            return place
    raise MendableError(
        f"a service cannot run {present}: {why}; install {name} for all users (`sudo apt install "
        f"{name}`), or make the environment of acsard again with a Python that all users may run, "
        "such as /usr/bin/python3"
    )


def _closed(path: Path, hidden: Sequence[str]) -> str:
    real = Path(os.path.realpath(path))
    if any(real.is_relative_to(place) for place in hidden):
        return "services have no access to home directories and /tmp"
    for place in (*reversed(real.parents), real):
        if not place.stat().st_mode & stat.S_IXOTH:
            return f"its user has no permission to enter {place}"
    return ""


def _fill(place: Path, python: str) -> None:
    lib, deploy = place / "lib", source()
    for package in closure():
        _copy_installed(package, lib)
    ours = lib / "acsard"
    skipped = shutil.ignore_patterns("__pycache__")
    shutil.copytree(Path(acsard.__file__).parent, ours, ignore=skipped, dirs_exist_ok=True)
    for name in PACKAGED:
        shutil.copytree(deploy / name, ours / "deploy" / name, ignore=skipped, dirs_exist_ok=True)
    _copy_file(reference(deploy), ours / "deploy" / "acsard.toml")
    if commit := own.source():
        (ours / own.COMMIT_FILE).write_text(f"{commit}\n")
    programs = place / "bin"
    programs.mkdir()
    (programs / "acsard").write_text(launcher(python))
    _copy_file(deploy / "systemd" / STOP_PROGRAM, programs / STOP_PROGRAM)
    for program in programs.iterdir():
        program.chmod(0o755)


def _finish(place: Path) -> None:
    compileall.compile_dir(place / "lib", quiet=2)
    _require_start(place)
    # Root's umask, or the modes of a user's own environment, may hide files from the service.
    for directory, _, files in os.walk(place):
        os.chmod(directory, 0o755)
        for name in files:
            file = os.path.join(directory, name)
            os.chmod(file, 0o755 if os.stat(file).st_mode & 0o100 else 0o644)
    # Wait until the disk has stored all files, before one of them has its name.
    if run_command(("sync", "--file-system", str(place)), CHECK_TIMEOUT_S).returncode:
        os.sync()


def _require_start(place: Path) -> None:
    try:
        # `run` imports all that the daemon needs.
        done = run_command((str(place / "bin" / "acsard"), "run", "--help"), CHECK_TIMEOUT_S)
        trouble = done.stderr.strip() or how_it_ended(done.returncode) if done.returncode else ""
    except (OSError, subprocess.TimeoutExpired) as error:
        trouble = str(error)
    if trouble:
        raise MendableError(
            f"the copy of acsard does not start: {trouble}; correct the environment {sys.prefix} "
            "and run the command again"
        )


def same(one: Path, other: Path) -> bool:
    """Return whether two versions have the same content, except bytecode."""
    files = [_files(tree) for tree in (one, other)]
    return files[0] == files[1] and all(
        cmp(one / name, other / name, shallow=False) for name in files[0]
    )


def _files(tree: Path) -> set[Path]:
    return {
        path.relative_to(tree)
        for path in tree.rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }


# Which libraries belong to acsard

REQUIREMENT = re.compile(r"\s*([\w.-]+)\s*(?:\[([^]]*)\])?[^;]*(?:;(.*))?")
EXTRA = re.compile(r"""extra\s*==\s*["']([\w.-]+)["']""")


def closure() -> list[Distribution]:
    """Return acsard and all its installed libraries. Raises `MendableError` if one is missing."""
    found: dict[str, Distribution] = {}
    _collect("acsard", EXTRAS, False, found)
    return list(found.values())


def _collect(
    name: str, extras: Collection[str], optional: bool, found: dict[str, Distribution]
) -> None:
    key = f"{re.sub('[-_.]+', '-', name).lower()}[{','.join(sorted(extras))}]"
    if key in found:
        return
    try:
        found[key] = package = distribution(name)
    except PackageNotFoundError:
        if optional:
            return
        raise MendableError(
            f"the library {name} is missing in {sys.prefix}; install acsard again in this "
            "environment"
        ) from None
    for requirement in package.requires or ():
        parts = REQUIREMENT.fullmatch(requirement)
        assert parts is not None, requirement
        wanted, more, condition = parts[1], parts[2] or "", parts[3] or ""
        of_extra = EXTRA.search(condition)
        if of_extra is None or of_extra[1] in extras:
            # A library with a condition may be for other systems, and is missing then.
            _collect(wanted, [word.strip() for word in more.split(",")], bool(condition), found)


def _copy_installed(package: Distribution, lib: Path) -> None:
    if package.files is None:
        raise MendableError(
            f"the library {package.name} has no list of its files, because another program than "
            f"pip, uv or pipx installed it; install acsard in an environment without the system's "
            "libraries"
        )
    for file in package.files:
        # Programs of the library are outside of `lib`.
        if ".." in file.parts or file.suffix == ".pth":
            continue
        # An environment from which acsard runs in its clone lists only what pip wrote about it.
        if package.name == "acsard" and not file.parts[0].endswith(".dist-info"):
            continue
        there = Path(str(package.locate_file(file)))
        # Bytecode that is missing is made again, which takes a minute on a slow computer.
        if file.suffix != ".pyc" or there.exists():
            _copy_file(there, lib / file)


def _copy_file(file: Path, to: Path) -> None:
    to.parent.mkdir(parents=True, exist_ok=True)
    shutil.copy2(file, to)


if __name__ == "__main__":
    # `acsard service upgrade DIRECTORY` runs this with the Python of the new version.
    print(copy())  # noqa: T201

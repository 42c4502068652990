"""Make the packages and bare roots of Debian and Ubuntu, in which tests install them.

$ACSARD_TEST_DEBS names a directory for both. What it already has is used again. The roots of arm64
run under qemu-user-static, so their speed means nothing.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from hashlib import md5
from pathlib import Path

from acsard import __version__
from acsard.host.version import DIRTY, full_version, source_of
from tests.system.harness import ROOT

SYSTEMS = {"deb12": "bookworm", "deb13": "trixie", "ubuntu24.04": "noble"}
PYTHONS = {"deb12": "3.11", "deb13": "3.13", "ubuntu24.04": "3.12"}

MACHINES = {"amd64": "x86_64", "arm64": "aarch64"}

UBUNTU = (
    "deb [signed-by=/usr/share/keyrings/ubuntu-archive-keyring.gpg] "
    "http://archive.ubuntu.com/ubuntu noble main universe"
)

COMMIT = source_of(ROOT).removesuffix(DIRTY)

NUMBER = full_version(__version__, COMMIT)  # of the packages
NEWER = f"9{NUMBER[1:]}"  # of copies which only have another version

BINFMT = Path("/proc/sys/fs/binfmt_misc")


def missing_programs() -> str:
    """Return the reason why this machine cannot make packages and roots, or ""."""
    if os.geteuid() != 0:
        return "not root"
    wanted = ("mmdebstrap", "ip", "x86_64-linux-gnu-strip", "aarch64-linux-gnu-strip")
    names = [name for name in wanted if shutil.which(name) is None]
    if not Path("/usr/share/keyrings/ubuntu-archive-keyring.gpg").exists():
        names.append("ubuntu-keyring (a package of Debian 13)")
    return f"no {', '.join(names)}" if names else ""


def runs_arm64() -> bool:
    """Return whether this kernel runs programs for arm64, also in a root without qemu.

    If qemu-user-static is installed but not registered, as in a container, register it.
    """
    entry = BINFMT / "qemu-aarch64"
    rule = Path("/usr/lib/binfmt.d/qemu-aarch64.conf")
    if not entry.exists() and rule.exists() and (BINFMT / "register").exists():
        (BINFMT / "register").write_text(rule.read_text().strip())
    return entry.exists() and "F" in entry.read_text().split("flags:")[1].splitlines()[0]


def packages(out: Path, commit: str = COMMIT) -> list[Path]:
    """Return the packages of a commit, as its own release script makes them, in `out`.

    If this directory is there, it has them.
    """
    if not out.exists():
        with tempfile.TemporaryDirectory(dir=out.parent) as work:
            clone, made = Path(work, "clone"), Path(work, "made")
            _run("git", "clone", "--quiet", str(ROOT), str(clone))
            _run("git", "-C", str(clone), "checkout", "--quiet", commit)
            _run(str(clone / "deploy/release/build"), "--out", str(made))
            made.rename(out)
    return sorted(out.glob("*.deb"))


def package(made: Iterable[Path], system: str, machine: str) -> Path:
    """Return the package for a system and an architecture."""
    return next(path for path in made if path.name.endswith(f"~{system}_{machine}.deb"))


def newer(package: Path, out: Path) -> Path:
    """Write a copy of the package with the version `NEWER`, and return it."""
    with tempfile.TemporaryDirectory() as work:
        tree = Path(work, "tree")
        _run("dpkg-deb", "--raw-extract", str(package), str(tree))
        home = tree / "opt/acsard/dist"
        (home / NUMBER).rename(home / NEWER)
        ours = home / NEWER / "lib/acsard"
        texts = [tree / "DEBIAN/control", tree / "DEBIAN/postinst", ours / "__init__.py"]
        for file in (*texts, *ours.glob("__pycache__/__init__*.pyc")):
            data = file.read_bytes()
            for before, after in ((NUMBER, NEWER), (debian_version(NUMBER), debian_version(NEWER))):
                data = data.replace(before.encode(), after.encode())
            file.write_bytes(data)
        files = [
            path for path in tree.rglob("*") if path.is_file() and path.parent.name != "DEBIAN"
        ]
        sums = {path.relative_to(tree): md5(path.read_bytes()).hexdigest() for path in files}
        lines = [f"{digest}  {name}\n" for name, digest in sums.items()]
        (tree / "DEBIAN/md5sums").write_text("".join(lines))
        target = out / package.name.replace(debian_version(NUMBER), debian_version(NEWER))
        _run("dpkg-deb", "-Znone", "--root-owner-group", "--build", str(tree), str(target))
    return target


def debian_version(number: str) -> str:
    """Return the version as the packages write it."""
    return number.replace(".dev", "~dev")


def packages_of_tests(where: Path, system: str, machine: str) -> Path:
    """Return a directory with what the tests import besides acsard, without numpy."""
    place = where / f"test-packages-{system}-{machine}"
    if not place.exists():
        project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
        extras = project["optional-dependencies"]
        # No unit test needs argparse-manpage, which has no wheel.
        unneeded = ("acsard", "argparse-manpage")
        wanted = [name for name in extras["test"] if not name.startswith(unneeded)]
        words = [sys.executable, "-m", "pip", "install", "--quiet", "--target", str(place)]
        words += ["--only-binary", ":all:", "--python-version", PYTHONS[system]]
        for glibc in range(17, 37):  # Debian 12 has 2.36
            words += ["--platform", f"manylinux_2_{glibc}_{MACHINES[machine]}"]
        words += ["--platform", f"manylinux2014_{MACHINES[machine]}"]
        # The package leaves these out, but a copy of an environment has them.
        _run(*words, *wanted, *extras["foxglove"], "markdown-it-py", "pygments")
        # The tests run on the system's numpy.
        for name in place.glob("numpy*"):
            shutil.rmtree(name)
    return place


class Root:
    """A minimal system without Python, in a directory, with this machine's /proc, /sys and /dev."""

    def __init__(self, path: Path, system: str, machine: str) -> None:
        self.path, self.system, self.machine = path, system, machine

    def words(self, *words: str) -> list[str]:
        """Return the words of a host command that runs `words` inside."""
        variables = ["HOME=/root", "PATH=/usr/sbin:/usr/bin", "LANG=C.UTF-8", "TERM=dumb"]
        variables += ["DEBIAN_FRONTEND=noninteractive"]
        # The mounts end with the program, because they are in a mount namespace of its own.
        enter = (
            'mount -t proc proc "$0/proc" && mount --rbind /sys "$0/sys" && '
            'mount --rbind /dev "$0/dev" && exec chroot "$0" "$@"'
        )
        words = ("env", "-i", *variables, *words)
        return ["unshare", "--mount", "sh", "-c", enter, str(self.path), *words]

    def run(self, command: str, within: float = 900.0) -> str:
        """Run a shell command inside, and return its output. Fail if it fails."""
        # At a timeout all programs end that the command has started.
        words = ["unshare", "--pid", "--fork", "--kill-child", *self.words("sh", "-c", command)]
        done = subprocess.run(
            words, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
            text=True, timeout=within,
        )  # fmt: skip
        assert done.returncode == 0, f"{command}\n{done.stdout}"
        return done.stdout

    def files(self) -> dict[str, str]:
        """Return each file of the root with its kind and mode, but not what changes by itself."""
        passing = ("proc", "dev", "sys", "tmp", "run", "var/cache", "var/log", "var/lib/dpkg",
                   "var/lib/apt", "var/lib/systemd/deb-systemd-helper-enabled")  # fmt: skip
        found = {}
        for directory, names, files in os.walk(self.path):
            inside = os.path.relpath(directory, self.path)
            names[:] = [
                name for name in names if os.path.normpath(f"{inside}/{name}") not in passing
            ]
            for name in (*names, *files):
                path = os.path.join(directory, name)
                found[os.path.normpath(f"/{inside}/{name}")] = oct(os.lstat(path).st_mode)
        return found


@contextmanager
def root(where: Path, system: str, machine: str) -> Iterator[Root]:
    """Provide a newly made minimal root with apt's lists, and remove it afterwards."""
    suite = SYSTEMS[system]
    base = where / f"{suite}-{machine}.tar"
    if not base.exists():
        words = ["mmdebstrap", "--quiet", "--variant=minbase", f"--architectures={machine}"]
        # mmdebstrap removes apt's lists, which are not part of an installation by a person.
        source = UBUNTU if suite == "noble" else "http://deb.debian.org/debian"
        # Ubuntu's minbase has no apt.
        words += ["--skip=cleanup/apt", "--include=apt", suite, str(base), source]
        _run(*words)
    with tempfile.TemporaryDirectory(dir=where) as place:
        _run("tar", "-xf", str(base), "-C", place)
        os.chmod(place, 0o755)
        shutil.copyfile("/etc/resolv.conf", Path(place, "etc/resolv.conf"))
        yield Root(Path(place), system, machine)


def _run(*words: str) -> None:
    done = subprocess.run(words, capture_output=True, text=True, timeout=1800)
    assert done.returncode == 0, f"{' '.join(words)}\n{done.stdout}{done.stderr}"

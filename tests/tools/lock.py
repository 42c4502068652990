"""`python -m tests.tools.lock`: rewrite the two lock files with today's versions.

`deploy/systemd/requirements.lock` has what an install of acsard with the extra `tools` takes from
the package index, including what builds it. `deploy/release/requirements.lock` has the programs
that make a release, which are the group `release` in `pyproject.toml`.

It asks pip for each supported Python and platform, and pins the hashes of those wheels. All
platforms get the same versions. `--check` prints the changes and writes nothing.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import tomllib
from collections import defaultdict
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import product
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]

LOCK = ROOT / "deploy" / "systemd" / "requirements.lock"

RELEASE_LOCK = ROOT / "deploy" / "release" / "requirements.lock"

PYTHONS = ("3.11", "3.12", "3.13", "3.14")

MACHINES = ("x86_64", "aarch64")

# Debian 12 has glibc 2.36, which runs wheels for 2.36 and for all earlier versions.
GLIBC = 36

# The index has no wheel of these. They need nothing themselves.
WITHOUT_WHEEL = ("argparse-manpage",)

HEAD = """\
# The packages that run and build the service, for Python 3.11 to 3.14 on x86_64 and aarch64:
#
#     pip install -r requirements.lock
#
# Written by `python -m tests.tools.lock`. .ci/run tests on it. The nightly job runs the unit tests
# on the lowest versions that pyproject.toml allows, and on the newest.
"""

RUN = "\n# To run acsard with the extra `tools`:\n"
BUILD = "\n# To build acsard:\n"

RELEASE_HEAD = """\
# The programs that make and check a release, for Python 3.11 to 3.14 on x86_64, and what builds
# acsard. Written by `python -m tests.tools.lock`.
"""

Pins = dict[str, tuple[str, set[str]]]
"""Maps a distribution to its version and the hashes of its wheels."""


def run_requirements() -> list[str]:
    """Return the requirements in `pyproject.toml` to run acsard with the extra `tools`."""
    project = _pyproject()["project"]
    return sorted({*project["dependencies"], *project["optional-dependencies"]["tools"]})


def build_requirements() -> list[str]:
    """Return the requirements in `pyproject.toml` to build acsard."""
    return sorted(_pyproject()["build-system"]["requires"])


def release_requirements() -> list[str]:
    """Return the requirements in `pyproject.toml` to make, build and check a release."""
    return sorted([*_pyproject()["dependency-groups"]["release"], *build_requirements()])


def _has_wheel(requirement: str) -> bool:
    return not requirement.startswith(WITHOUT_WHEEL)


def _pyproject() -> dict[str, Any]:
    return tomllib.loads((ROOT / "pyproject.toml").read_text())


def resolved(
    requirements: Sequence[str], python: str, machine: str, versions: dict[str, str]
) -> dict[str, tuple[str, str]]:
    """Return the version and hash of each distribution that pip would install on this platform.

    `versions` maps distributions to versions that pip must use.
    """
    platforms = [f"manylinux_2_{minor}_{machine}" for minor in range(GLIBC, 4, -1)]
    platforms += [f"manylinux2014_{machine}"]
    with tempfile.TemporaryDirectory() as path:
        constraints = Path(path, "held")
        constraints.write_text("".join(f"{name}=={item}\n" for name, item in versions.items()))
        words = ["--only-binary", ":all:", "--target", path, "--constraint", str(constraints)]
        words += ["--implementation", "cp", "--python-version", python]
        words += [word for item in platforms for word in ("--platform", item)]
        return _reported(*words, *filter(_has_wheel, requirements))


def sources(requirements: Sequence[str]) -> Pins:
    """Return the pins of the requirements without a wheel."""
    asked = [requirement for requirement in requirements if not _has_wheel(requirement)]
    found = _reported("--no-deps", "--no-binary", ",".join(WITHOUT_WHEEL), *asked)
    return {name: (version, {digest}) for name, (version, digest) in found.items()}


def _reported(*words: str) -> dict[str, tuple[str, str]]:
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--dry-run", "--report", "-"]
    done = subprocess.run(
        [*pip, "--ignore-installed", *words], stdout=subprocess.PIPE, text=True, check=True
    )
    packages: list[Any] = json.loads(done.stdout)["install"]
    return {
        item["metadata"]["name"].lower().replace("_", "-").replace(".", "-"): (
            item["metadata"]["version"],
            item["download_info"]["archive_info"]["hashes"]["sha256"],
        )
        for item in packages
    }


def pins(requirements: Sequence[str], machines: Sequence[str], held: Pins) -> Pins:
    """Return the pins of these requirements and all that they need; `held` keeps its versions."""
    versions = {name: version for name, (version, _) in held.items()}
    hashes: defaultdict[str, set[str]] = defaultdict(set)

    def take(found: dict[str, tuple[str, str]]) -> None:
        for name, (version, digest) in found.items():
            assert versions.setdefault(name, version) == version, name
            hashes[name].add(digest)

    # Resolve for the oldest Python first: no other Python gets a version that it cannot install.
    first, *others = product(PYTHONS, machines)
    take(resolved(requirements, *first, versions))
    fixed = dict(versions)
    with ThreadPoolExecutor(8) as pool:  # pip mostly waits for the index
        for found in pool.map(lambda item: resolved(requirements, item[0], item[1], fixed), others):
            take(found)
    return {name: (versions[name], hashes[name]) for name in sorted(hashes)}


def lines(pinned: Pins) -> str:
    """Return the pins as lines of a lock file."""
    text = ""
    for name, (version, hashes) in pinned.items():
        digests = "".join(f" \\\n    --hash=sha256:{digest}" for digest in sorted(hashes))
        text += f"{name}=={version}{digests}\n"
    return text


def locks() -> dict[Path, str]:
    """Return the contents of the lock files."""
    run = pins(run_requirements(), MACHINES, {})
    build = pins(build_requirements(), MACHINES[:1], run)  # no machine code is in them
    more = {name: pin for name, pin in build.items() if name not in run}
    release = pins(release_requirements(), MACHINES[:1], run | build)
    release |= sources(release_requirements())
    return {
        LOCK: HEAD + RUN + lines(run) + BUILD + lines(more),
        RELEASE_LOCK: RELEASE_HEAD + lines(dict(sorted(release.items()))),
    }


def main() -> int:
    same = True
    for file, text in locks().items():
        if "--check" not in sys.argv:
            file.parent.mkdir(exist_ok=True)
            file.write_text(text)
        elif not file.exists() or file.read_text() != text:
            same = False
            print(f"{file.relative_to(ROOT)}:\n{text}")
    return 0 if same else 1


if __name__ == "__main__":
    sys.exit(main())

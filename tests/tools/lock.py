"""`python -m tests.tools.lock`: rewrite the two lock files with today's versions.

`deploy/systemd/requirements.lock` has what an install of acsard with the extra `tools` takes from
the package index, including what builds it. `deploy/release/requirements.lock` has the programs
that make a release, which are the group `release` in `pyproject.toml`.

It asks pip for each supported Python and platform, and pins the hashes of those wheels. All
platforms get the same versions. The licences that the distributions declare stand there too, for
the SBOM. `--check` prints the changes and writes nothing.
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
from typing import Any, NamedTuple

from packaging.licenses import InvalidLicenseExpression, canonicalize_license_expression

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


class Pin(NamedTuple):
    version: str
    hashes: set[str]  # of all its wheels
    licence: str  # the comment of the lock


Pins = dict[str, Pin]  # by distribution


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
) -> Pins:
    """Return each distribution that pip would install on this platform, with the hash of one wheel.

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
    return _reported("--no-deps", "--no-binary", ",".join(WITHOUT_WHEEL), *asked)


def _reported(*words: str) -> Pins:
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--dry-run", "--report", "-"]
    done = subprocess.run(
        [*pip, "--ignore-installed", *words], stdout=subprocess.PIPE, text=True, check=True
    )
    packages: list[Any] = json.loads(done.stdout)["install"]
    return {
        item["metadata"]["name"].lower().replace("_", "-").replace(".", "-"): Pin(
            item["metadata"]["version"],
            {item["download_info"]["archive_info"]["hashes"]["sha256"]},
            licence(item["metadata"]),
        )
        for item in packages
    }


def licence(metadata: dict[str, Any]) -> str:
    """Return the comment with the licence of a distribution.

    It is an SPDX expression if the distribution declares one, and otherwise the names of its
    classifiers, which may leave open which BSD licence it is.
    """
    for said in (metadata.get("license_expression"), metadata.get("license")):
        try:
            return f"# licence: {canonicalize_license_expression(said or '')}"
        except InvalidLicenseExpression:
            continue
    classifiers = [item for item in metadata["classifier"] if item.startswith("License ::")]
    names = [item.rpartition(" :: ")[2] for item in classifiers]
    assert names, f"{metadata['name']} declares no licence that this pip reads; take a newer pip"
    return f"# licence, by name: {', '.join(names)}"


def pins(requirements: Sequence[str], machines: Sequence[str], held: Pins) -> Pins:
    """Return the pins of these requirements and all that they need; `held` keeps its versions."""
    versions = {name: pin.version for name, pin in held.items()}
    hashes: defaultdict[str, set[str]] = defaultdict(set)
    licences: dict[str, str] = {}

    def take(found: Pins) -> None:
        for name, pin in found.items():
            assert versions.setdefault(name, pin.version) == pin.version, name
            hashes[name] |= pin.hashes
            licences[name] = pin.licence

    # Resolve for the oldest Python first: no other Python gets a version that it cannot install.
    first, *others = product(PYTHONS, machines)
    take(resolved(requirements, *first, versions))
    fixed = dict(versions)
    with ThreadPoolExecutor(8) as pool:  # pip mostly waits for the index
        for found in pool.map(lambda item: resolved(requirements, item[0], item[1], fixed), others):
            take(found)
    return {name: Pin(versions[name], hashes[name], licences[name]) for name in sorted(hashes)}


def lines(pinned: Pins) -> str:
    """Return the pins as lines of a lock file."""
    text = ""
    for name, pin in pinned.items():
        digests = "".join(f" \\\n    --hash=sha256:{digest}" for digest in sorted(pin.hashes))
        text += f"{pin.licence}\n{name}=={pin.version}{digests}\n"
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

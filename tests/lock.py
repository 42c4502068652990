"""`python -m tests.lock`: rewrite `deploy/systemd/requirements.lock` with today's versions.

It asks pip which distributions an install of acsard with the extra `tools` takes from the
package index, including those needed to build it. It asks for each supported Python on x86_64 and
aarch64, and pins the hashes of those wheels. All platforms get the same versions. `--check` prints
the changes and writes nothing.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import tomllib
from collections import defaultdict
from itertools import product
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]

LOCK = ROOT / "deploy" / "systemd" / "requirements.lock"

PYTHONS = ("3.11", "3.12", "3.13")

MACHINES = ("x86_64", "aarch64")

GLIBC = 36
"""Wheel platforms.

Debian 12 has glibc 2.36, which runs wheels for 2.36 and for all earlier versions.
"""

HEAD = """\
# The packages that build and run the service, for Python 3.11 to 3.13 on x86_64 and aarch64:
#
#     pip install -r requirements.lock
#
# Written by `python -m tests.lock`. .ci/run tests on it. The nightly job runs the unit tests
# on the lowest versions that pyproject.toml allows.
"""


def declared_requirements() -> list[str]:
    """Return the requirements in `pyproject.toml`, both to build acsard and to run it."""
    pyproject = tomllib.loads((ROOT / "pyproject.toml").read_text())
    project = pyproject["project"]
    asked = {*pyproject["build-system"]["requires"], *project["dependencies"]}
    return sorted(asked.union(project["optional-dependencies"]["tools"]))


def resolved(python: str, machine: str, versions: dict[str, str]) -> dict[str, tuple[str, str]]:
    """Return the version and hash of each distribution that pip would install on this platform.

    `versions` maps distributions to versions that pip must use.
    """
    platforms = [f"manylinux_2_{minor}_{machine}" for minor in range(GLIBC, 4, -1)]
    platforms += [f"manylinux2014_{machine}"]
    with tempfile.TemporaryDirectory() as path:
        constraints = Path(path, "held")
        constraints.write_text("".join(f"{name}=={item}\n" for name, item in versions.items()))
        words = [sys.executable, "-m", "pip", "install", "--quiet", "--dry-run", "--report", "-"]
        words += ["--ignore-installed", "--only-binary", ":all:", "--target", path]
        words += ["--implementation", "cp", "--python-version", python]
        words += [word for item in platforms for word in ("--platform", item)]
        done = subprocess.run(
            [*words, "--constraint", str(constraints), *declared_requirements()],
            stdout=subprocess.PIPE, text=True, check=True,
        )  # fmt: skip
    packages: list[Any] = json.loads(done.stdout)["install"]
    return {
        item["metadata"]["name"].lower().replace("_", "-"): (
            item["metadata"]["version"],
            item["download_info"]["archive_info"]["hashes"]["sha256"],
        )
        for item in packages
    }


def lock() -> str:
    """Return the contents of the whole lock file."""
    versions: dict[str, str] = {}
    hashes: defaultdict[str, set[str]] = defaultdict(set)
    # Resolve for the oldest Python first: no other Python gets a version that it cannot install.
    for python, machine in product(PYTHONS, MACHINES):
        for name, (version, digest) in resolved(python, machine, versions).items():
            assert versions.setdefault(name, version) == version, name
            hashes[name].add(digest)
    lines = [HEAD]
    for name in sorted(versions):
        digests = "".join(f" \\\n    --hash=sha256:{checksum}" for checksum in sorted(hashes[name]))
        lines.append(f"{name}=={versions[name]}{digests}\n")
    return "".join(lines)


def main() -> int:
    text = lock()
    if "--check" in sys.argv:
        same = LOCK.read_text() == text
        print("as it is" if same else text)
        return 0 if same else 1
    LOCK.write_text(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""`python -m tests.tools.lowest`: print pip constraints for the lowest allowed versions.

It writes one `name==version` per line: for each dependency the lowest version that
`pyproject.toml` allows. The output is for `pip install --constraint`.
"""

from __future__ import annotations

import re
import tomllib
from itertools import chain
from pathlib import Path

PYPROJECT = Path(__file__).resolve().parents[2] / "pyproject.toml"

BOUND = re.compile(r"^([A-Za-z0-9-]+)[>=]=([0-9.]+)")


def lowest() -> dict[str, str]:
    """Return the lowest version of each distribution."""
    pyproject = tomllib.loads(PYPROJECT.read_text())
    project, builder = pyproject["project"], pyproject["build-system"]["requires"]
    versions: dict[str, str] = {}
    extras = project["optional-dependencies"].values()
    for requirement in chain(builder, project["dependencies"], *extras):
        if requirement.startswith("acsard["):
            continue
        bound = BOUND.match(requirement)
        assert bound is not None, f"{requirement} has no lower bound"
        name, version = bound.groups()
        assert versions.setdefault(name, version) == version, f"{name} has two lower bounds"
    return versions


if __name__ == "__main__":
    for name, version in sorted(lowest().items()):
        print(f"{name}=={version}")

"""The lock files, from which the service and a release are made, satisfy `pyproject.toml`."""

from __future__ import annotations

import re
from pathlib import Path

from packaging.requirements import Requirement

from tests.each import each
from tests.tools.lock import (
    LOCK,
    RELEASE_LOCK,
    build_requirements,
    release_requirements,
    run_requirements,
)
from tests.tools.lowest import lowest

PIN = re.compile(r"^([a-z0-9-]+)==(\S+) \\\n((?: {4}--hash=sha256:[0-9a-f]{64}(?: \\)?\n)+)", re.M)


@each("lock", [LOCK, RELEASE_LOCK])
def test_every_line_of_a_lock_is_a_version_with_its_hashes(lock: Path) -> None:
    text = lock.read_text()
    bare = PIN.sub("", text)
    assert [line for line in bare.splitlines() if line and not line.startswith("#")] == []
    assert PIN.search(text) is not None


@each(
    ("lock", "requirements"),
    [
        (LOCK, [*run_requirements(), *build_requirements()]),
        (RELEASE_LOCK, release_requirements()),
    ],
)
def test_a_lock_has_all_that_is_needed_in_versions_that_are_allowed(
    lock: Path, requirements: list[str]
) -> None:
    pins = {name: version for name, version, _ in PIN.findall(lock.read_text())}
    for text in requirements:
        need = Requirement(text)
        assert need.specifier.contains(pins[need.name]), text


def test_a_release_is_built_with_the_versions_that_build_the_service() -> None:
    service, release = (
        {name: version for name, version, _ in PIN.findall(lock.read_text())}
        for lock in (LOCK, RELEASE_LOCK)
    )
    assert {name: service[name] for name in service.keys() & release} == {
        name: release[name] for name in service.keys() & release
    }


def test_every_dependency_has_one_lower_bound() -> None:
    assert {"eclipse-zenoh", "hatchling", "numpy", "pytest"} <= set(lowest())

"""The lock file from which the service is installed satisfies `pyproject.toml`."""

from __future__ import annotations

import re

from packaging.requirements import Requirement

from tests.lock import LOCK, declared_requirements
from tests.lowest import lowest

PIN = re.compile(r"^([a-z0-9-]+)==(\S+) \\\n((?: {4}--hash=sha256:[0-9a-f]{64}(?: \\)?\n)+)", re.M)


def test_every_line_of_the_lock_is_a_version_with_its_hashes() -> None:
    text = LOCK.read_text()
    bare = PIN.sub("", text)
    assert [line for line in bare.splitlines() if not line.startswith("#")] == []
    assert PIN.search(text) is not None


def test_the_lock_has_all_that_the_service_needs_in_versions_that_are_allowed() -> None:
    pins = {name: version for name, version, _ in PIN.findall(LOCK.read_text())}
    for text in declared_requirements():
        need = Requirement(text)
        assert need.specifier.contains(pins[need.name]), text


def test_every_dependency_has_one_lower_bound() -> None:
    assert {"eclipse-zenoh", "hatchling", "numpy", "pytest"} <= set(lowest())

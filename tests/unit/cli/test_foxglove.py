"""Tests of the errors that `acsard foxglove` reports before it connects.

They concern its library and its address.
"""

from __future__ import annotations

import argparse
import sys

import pytest

from acsard.cli import foxglove
from acsard.host.errors import Exit, ExitError, UsageError


def test_without_its_library_it_says_which_extra_to_install(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name in [name for name in sys.modules if name.startswith("acsard.foxglove")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "foxglove", None)  # as if the library were not installed
    with pytest.raises(ExitError, match=r"pip install .*\[foxglove\]'") as told:
        foxglove.main(argparse.Namespace())
    assert told.value.code == Exit.FAILURE


def test_beyond_this_machine_it_does_not_listen() -> None:
    with pytest.raises(UsageError, match="has no authentication"):
        foxglove.main(argparse.Namespace(address="0.0.0.0:8765"))

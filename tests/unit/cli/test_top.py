"""Tests of `acsard top` without its screen: the error when its library is missing."""

from __future__ import annotations

import argparse
import sys

import pytest

from acsard.cli import top
from acsard.host.errors import Exit, ExitError


def test_without_its_library_it_says_which_extra_to_install(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delitem(sys.modules, "acsard.top.terminal", raising=False)
    monkeypatch.delattr("acsard.top.terminal", raising=False)
    monkeypatch.setitem(sys.modules, "rich.console", None)  # as if the library were not installed
    with pytest.raises(ExitError, match=r"pip install .*\[top\]'") as told:
        top.main(argparse.Namespace())
    assert told.value.code == Exit.FAILURE

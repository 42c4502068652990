"""Tests of the advice that an error gives for a missing library."""

from __future__ import annotations

import shlex
import sys
import tomllib
from typing import get_args

from acsard.host.extras import Extra, install, missing
from tests.each import each
from tests.pages import ROOT


@each("extra", get_args(Extra))
def test_the_advised_command_installs_into_the_present_venv(extra: Extra) -> None:
    words = shlex.split(install(extra).split("`")[1])
    assert words == [sys.executable, "-m", "pip", "install", f".[{extra}]"]


def test_the_error_names_the_library_and_the_extra() -> None:
    assert "needs the library segno" in str(missing("segno"))
    assert "[tools]" in str(missing("segno"))


def test_the_tests_install_both_extras_of_users() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    assert set(extras) == {*get_args(Extra), "test", "dds"}
    assert "acsard[foxglove,tools]" in extras["test"]

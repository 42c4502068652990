"""Tests of the install command that an error gives for a missing library."""

from __future__ import annotations

import json
import os
import shlex
import sys
import tomllib
from importlib.metadata import Distribution, PathDistribution
from pathlib import Path
from typing import get_args

import pytest

from acsard.host.extras import Extra, install, requirements_of
from tests.system.harness import ROOT


def installed(where: Path, **direct: object) -> Distribution:
    """Return a distribution with two extras.

    `direct` is the content of its direct_url.json, which says from where pip installed it.
    """
    info = where / "acsard-1.dist-info"
    info.mkdir()
    lines = ["Name: acsard", "Requires-Dist: zenoh", "Requires-Dist: one<2,>=1; extra == 'tls'"]
    lines += ["Requires-Dist: two; extra == 'tls'", "Requires-Dist: three; extra == 'web'"]
    (info / "METADATA").write_text("\n".join(lines) + "\n\n")
    if direct:
        (info / "direct_url.json").write_text(json.dumps(direct))
    return PathDistribution(info)


@pytest.mark.parametrize("editable", [True, False])
def test_an_installation_from_a_clone_installs_the_extra_from_the_clone(
    tmp_path: Path, editable: bool
) -> None:
    clone = tmp_path / "my clone"
    clone.mkdir()
    (clone / "pyproject.toml").touch()
    installation = installed(tmp_path, url=clone.as_uri(), dir_info={"editable": editable})
    assert requirements_of(installation, "tls") == [*(["-e"] if editable else []), f"{clone}[tls]"]


@pytest.mark.parametrize("url", ["file:///gone/away", "https://example.org/acsard.whl"])
def test_an_installation_from_a_missing_source_installs_only_the_libraries(
    tmp_path: Path, url: str
) -> None:
    assert requirements_of(installed(tmp_path, url=url), "tls") == ["one<2,>=1", "two"]


def test_an_installation_from_an_unknown_source_installs_only_the_libraries(tmp_path: Path) -> None:
    assert requirements_of(installed(tmp_path), "web") == ["three"]


@pytest.mark.parametrize("extra", get_args(Extra))
def test_the_advised_command_installs_into_the_present_venv(extra: Extra) -> None:
    words = shlex.split(install(extra))
    # the user who runs the tests may not be the one who installed
    if not os.access(sys.prefix, os.W_OK):
        assert words.pop(0) == "sudo"
    assert words[:4] == [sys.executable, "-m", "pip", "install"]
    assert words[-1] == f"{ROOT}[{extra}]"


def test_the_extra_all_has_every_optional_library_and_test_has_them_too() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = {name: set(wanted) for name, wanted in project["optional-dependencies"].items()}
    each = [extras[name] for name in get_args(Extra)]
    assert set(extras) == {*get_args(Extra), "all", "test", "dds"}
    assert set.union(*each) == extras["all"]
    assert extras["all"] <= extras["test"]

"""Tests of the advice that an error gives for a missing library."""

from __future__ import annotations

import json
import shlex
import sys
import tomllib
from importlib import metadata
from pathlib import Path
from typing import get_args

import pytest

from acsard.host import extras
from acsard.host.extras import Extra, install, missing
from tests.each import each
from tests.pages import ROOT

PIP = [sys.executable, "-m", "pip", "install"]
WHEEL = "file:///tmp/acsard-0.2.0-py3-none-any.whl"


class Installed:
    def __init__(self, url: str) -> None:
        self._url = url

    def read_text(self, name: str) -> str | None:
        return json.dumps({"url": self._url}) if self._url else None


@each("extra", get_args(Extra))
@each(
    ("url", "what"),
    [
        ("file:///home/ann/acsard", ".[{}]"),
        (WHEEL, f"acsard[{{}}] @ {WHEEL}"),
        ("", "acsard[{}]"),
    ],
)
@each(
    ("file", "command"),
    [
        ("", PIP),
        ("uv-receipt.toml", ["uv", "tool", "install"]),
        ("pipx_metadata.json", ["pipx", "install", "--force"]),
    ],
)
def test_the_advised_command_installs_the_extra_as_acsard_was_installed(
    extra: Extra,
    url: str,
    what: str,
    file: str,
    command: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(metadata, "distribution", lambda name: Installed(url))
    monkeypatch.setattr(extras, "find_spec", lambda library: None)
    prefix = tmp_path / (file or "venv")
    prefix.mkdir(exist_ok=True)
    monkeypatch.setattr(sys, "prefix", str(prefix))
    if file:
        (prefix / file).touch()
    words = shlex.split(install(extra).split("`")[1])
    assert words == [*command, what.format(extra)]


@each("file", ["uv-receipt.toml", "pipx_metadata.json"])
def test_uv_and_pipx_keep_the_other_extra(
    file: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(extras, "find_spec", lambda library: library == "aiohttp" or None)
    monkeypatch.setattr(sys, "prefix", str(tmp_path))
    (tmp_path / file).touch()
    assert "[foxglove,tools]" in install("foxglove")


def test_the_error_names_the_library_and_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(extras, "find_spec", lambda library: None)
    assert "needs the library segno" in str(missing("segno"))
    assert "[tools]" in str(missing("segno"))


def test_the_tests_install_both_extras_of_users() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    optional = project["optional-dependencies"]
    assert set(optional) == {*get_args(Extra), "test", "dds"}
    assert "acsard[foxglove,tools]" in optional["test"]

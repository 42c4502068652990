"""`acsard check` prints the effective configuration, or says which part of it is wrong."""

from __future__ import annotations

import argparse
from pathlib import Path

import msgspec
import pytest

from acsard.cli.check import main
from acsard.core.config.parsing import from_builtins, parse


def test_a_good_file_is_printed_with_its_place_and_its_warnings(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "robot.toml"
    file.write_text("[mcu]\nbaud_rate = 9600\n[control]\nrate = 29\n")
    assert main(argparse.Namespace(config=str(file), json=False)) == 0
    out, err = capsys.readouterr()
    assert out.startswith(f"# effective configuration from {file}\n")
    assert parse(out.encode()) == parse(file.read_bytes())
    assert err.startswith(f"{file}: warning: control.rate = 29 ")


def test_a_good_file_is_printed_as_json_on_request(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "robot.toml"
    file.write_text('[robot]\nid = "r7"\n')
    assert main(argparse.Namespace(config=str(file), json=True)) == 0
    assert from_builtins(msgspec.json.decode(capsys.readouterr().out)) == parse(file.read_bytes())

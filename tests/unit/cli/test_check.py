"""The configuration in force, printed as TOML that means the same."""

from __future__ import annotations

import argparse
import tomllib
from pathlib import Path

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from acsard.cli.check import main, toml
from acsard.config.parsing import effective, from_builtins, parse
from acsard.config.settings import Config, McuConfig
from acsard.host.exits import ExitError
from tests.unit.keys import KEYS

CONFIGS = [
    b"",
    b'[control]\nrate = "auto"',
    b"[commands]\nsources = []",
    b'[[commands.sources]]\nname = "x"\npriority = 0\ntimeout = 10.0',
    b'[bus]\nlisten = ["tcp/127.0.0.1:1", "tcp/[::1]:2"]\nconnect = ["tcp/localhost:3"]',
    b'[mcu]\nport = "/dev/serial/by-id/usb-\\"odd\\" \\\\ \\u00e9\\t"',
    b"[odometry]\npose_covariance_diagonal = [1e-6, 0, 1e9, 0.1, 3, 1e-300]",
]


def printed(config: Config) -> str:
    return "\n".join(toml(effective(config)))


@pytest.mark.parametrize("text", CONFIGS)
def test_what_is_printed_means_the_same_configuration(text: bytes) -> None:
    config = parse(text)
    assert from_builtins(tomllib.loads(printed(config))) == config
    assert parse(printed(config).encode()) == config


def test_what_is_printed_again_is_the_same_text() -> None:
    text = printed(parse(CONFIGS[4]))
    assert printed(parse(text.encode())) == text


@given(st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), min_size=1))
@settings(max_examples=200)
def test_any_text_survives_printing(port: str) -> None:
    config = Config(mcu=McuConfig(port=port[:256]))
    assert parse(printed(config).encode()) == config


def test_every_key_is_printed_once_with_its_table() -> None:
    lines = printed(Config()).splitlines()
    assert [line for line in lines if line.startswith("[") and line.endswith("]")].count(
        "[[commands.sources]]"
    ) == len(Config().commands.sources)
    for key in KEYS:
        table, _, name = key.path.rpartition(".")
        head = "[[commands.sources]]" if "sources[0]" in table else f"[{table}]"
        after = lines[lines.index(head) + 1 :]
        inner = after[: after.index("")] if "" in after else after
        assert sum(line.startswith(f"{name} = ") for line in inner) == 1, key.path


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


def test_a_bad_file_ends_with_the_code_for_bad_configuration(tmp_path: Path) -> None:
    file = tmp_path / "robot.toml"
    file.write_text("colour = 1\n")
    with pytest.raises(ExitError) as caught:
        main(argparse.Namespace(config=str(file), json=False))
    assert int(caught.value.code) == 78


def test_a_delete_character_survives_printing() -> None:
    config = Config(mcu=McuConfig(port="a\x7fb"))
    assert parse("\n".join(toml(effective(config))).encode()) == config

"""A configuration that is written as TOML reads back with the same meaning."""

from __future__ import annotations

import tomllib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsard.core.config.parsing import effective, from_builtins, parse
from acsard.core.config.settings import Config, McuConfig
from acsard.core.config.toml_text import document, excerpt
from tests.each import each
from tests.unit.keys import KEYS

CONFIGS = [
    b"",
    b'[control]\nrate = "auto"',
    b"[commands]\nsources = []",
    b'[[commands.sources]]\nname = "x"\npriority = 0\ntimeout = 10.0',
    b'[bus]\nlisten = ["tcp/127.0.0.1:1", "tcp/[::1]:2"]\nconnect = ["tcp/localhost:3"]',
    b'[mcu]\nport = "/dev/serial/by-id/usb-\\"odd\\" \\\\ \\u00e9\\t"',
]


def printed(config: Config) -> str:
    return "\n".join(document(effective(config)))


@each("text", CONFIGS)
def test_a_printed_configuration_reads_back_as_the_same_configuration(text: bytes) -> None:
    config = parse(text)
    assert from_builtins(tomllib.loads(printed(config))) == config
    assert parse(printed(config).encode()) == config


def test_printing_a_printed_configuration_gives_the_same_text() -> None:
    text = printed(parse(CONFIGS[4]))
    assert printed(parse(text.encode())) == text


@pytest.mark.slow
@given(st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), min_size=1))
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


def test_a_delete_character_survives_printing() -> None:
    config = Config(mcu=McuConfig(port="a\x7fb"))
    assert parse("\n".join(document(effective(config))).encode()) == config


def test_an_excerpt_of_keys_is_toml_grouped_by_table() -> None:
    keys = {"mcu.wheels.rear_left": "-c", "mcu.baud_rate": 57600, "control.rate": "auto"}
    text = "\n".join(excerpt(keys))
    assert tomllib.loads(text) == {
        "mcu": {"baud_rate": 57600, "wheels": {"rear_left": "-c"}},
        "control": {"rate": "auto"},
    }
    assert text.splitlines()[0] == "[mcu]"

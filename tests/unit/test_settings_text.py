"""The TOML text of a configuration: any text is judged, and what is written reads back the same."""

from __future__ import annotations

import tomllib
import zlib
from pathlib import Path

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from acsard.core.config.parsing import ConfigError, effective, from_builtins, parse
from acsard.core.config.settings import Config, McuConfig, Source
from acsard.core.config.toml_editing import edited
from acsard.core.config.toml_text import document, excerpt
from acsard.core.config.validation import show, write
from tests.each import each
from tests.unit.keys import KEYS

REFERENCE = Path(__file__).parents[2] / "acsard.toml"


# any text

NAMES = sorted({key.path.rpartition(".")[2] for key in KEYS} | {"id_", "x", "prot"})
TABLES = sorted({key.path.rpartition(".")[0] for key in KEYS} - {"commands.sources[0]"})
VALUES = st.one_of(
    st.integers().map(str),
    st.floats().map(str),
    st.sampled_from(
        ["true", "false", '"sim"', '"auto"', '"+a"', '"-d"', "[]", "{}", "{a = 1}", "[{}]", "''",
         "1979-05-27", "07:32:00", "1979-05-27T07:32:00Z", "0x10", "1_000", "[1, [2, 'x']]", "-0.0",
         '["tcp/127.0.0.1:7448"]', "[1, 1, 1, 1, 1, 1]", '"\\u0000"', '"""a\nb"""', "9600"],
    ),
)  # fmt: skip
LINES = st.one_of(
    st.builds(
        "{} = {}".format,
        st.sampled_from([*[key.path for key in KEYS if key.table is not Source], *NAMES]),
        VALUES,
    ),
    st.sampled_from(
        [f"[{table}]" for table in TABLES] + ["[[commands.sources]]", "# x", "[[mcu]]"]
    ),
)


def judged(data: bytes) -> None:
    """Fail if the text is neither a configuration nor has problems of one line each."""
    problems: list[str] = []
    try:
        config = parse(data)
    except ConfigError as error:
        problems = error.problems
    else:
        assert from_builtins(effective(config)) == config
        return
    assert problems
    assert not any("\n" in line for line in problems)


@pytest.mark.slow
@given(st.lists(LINES, max_size=12).map("\n".join))
@settings(max_examples=400)
def test_any_toml_like_text_gives_a_configuration_or_a_list_of_problems(text: str) -> None:
    judged(text.encode())


@pytest.mark.slow
@given(st.binary(max_size=60) | st.text(max_size=60).map(lambda text: text.encode("utf-8")))
@settings(max_examples=300)
@example(b"\xef\xbb\xbf[robot]")
def test_any_bytes_give_a_configuration_or_a_list_of_problems(data: bytes) -> None:
    judged(data)
    good = REFERENCE.read_bytes()
    at = zlib.crc32(data) % len(good)
    judged(good[:at] + data[:8] + good[at + len(data) // 2 :])


# what is written


def printed(config: Config) -> str:
    return "\n".join(document(effective(config)))


@each(
    "text",
    [
        b"", b'[control]\nrate = "auto"', b"[commands]\nsources = []",
        b'[[commands.sources]]\nname = "x"\npriority = 0\ntimeout = 10.0',
        b'[bus]\nlisten = ["tcp/127.0.0.1:1", "tcp/[::1]:2"]\nconnect = ["tcp/localhost:3"]',
        b'[mcu]\nport = "/dev/serial/by-id/usb-\\"odd\\" \\\\ \\u00e9\\t"',
    ],
)  # fmt: skip
def test_a_printed_configuration_reads_back_as_the_same_configuration(text: bytes) -> None:
    config = parse(text)
    assert from_builtins(tomllib.loads(printed(config))) == config
    assert parse(printed(config).encode()) == config


@pytest.mark.slow
@given(st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), min_size=1))
@example("a\x7fb")
def test_any_text_survives_printing(port: str) -> None:
    config = Config(mcu=McuConfig(port=port[:256]))
    assert parse(printed(config).encode()) == config
    assert tomllib.loads(f"key = {write(port)}") == {"key": port}


@given(st.recursive(st.integers() | st.floats(allow_nan=False) | st.booleans(), st.lists))
def test_written_numbers_and_lists_read_back_exactly(value: object) -> None:
    assert tomllib.loads(f"key = {write(value)}") == {"key": value}
    assert show("x" * 500) == '"' + "x" * 76 + "..."


def test_every_key_is_printed_once_with_its_table() -> None:
    tables = [part.strip().splitlines() for part in printed(Config()).split("\n\n")]
    heads = [head for head, *_ in tables]
    assert heads.count("[[commands.sources]]") == len(Config().commands.sources)
    for key in KEYS:
        table, _, name = key.path.rpartition(".")
        head = "[[commands.sources]]" if "sources[0]" in table else f"[{table}]"
        (_, *rows) = tables[heads.index(head)]
        assert sum(row.startswith(f"{name} = ") for row in rows) == 1, key.path


def test_an_excerpt_of_keys_is_toml_grouped_by_table() -> None:
    keys = {"mcu.wheels.rear_left": "-c", "mcu.baud_rate": 57600, "control.rate": "auto"}
    assert "\n".join(excerpt(keys)) == (
        '[mcu]\nbaud_rate = 57600\n\n[control]\nrate = "auto"\n\n[mcu.wheels]\nrear_left = "-c"'
    )


# what is edited

EDITS: dict[str, object] = {
    "mcu.baud_rate": 57600, "mcu.trailing_comma": True, "mcu.reply_period": 0.1,
    "mcu.wheels.rear_left": "-c", "control.rate": 50.0,
    "bus.listen": ["tcp/127.0.0.1:7448", "tls/0.0.0.0:7449"], "bus.tls": "/etc/acsard/tls",
}  # fmt: skip


@each(
    "text",
    [
        "", "# mine\n", "[mcu]\nport = 'sim' # here\n", "[mcu.wheels]\n# none\n", "bus.tls = ''\n",
        '[mcu]\nwheels = { front_right = "+a" }\n', '[bus]\nlisten = [\n  "tcp/[::1]:1",\n]\n',
        "mcu.port = 'sim'\nmcu.wheels.rear_left = '+c'\n",
        "# mine\nmcu.port = 'sim'\nmcu.encoder_counts = 5\n[drive]\nwheel_radius = 0.1\n",
        "[mcu.wheels]\n# none\n[drive]\nwheel_radius = 0.1\n[mcu]\nport = 'sim'\n",
        "[bus]\nmode = 'peer'\n[mcu]\n\n[drive]\nwheel_radius = 0.1\n",
    ],
)  # fmt: skip
def test_keys_are_set_in_any_style_of_toml_file(text: str) -> None:
    after = edited(text, EDITS)
    config = parse(after.encode())
    assert (config.mcu.baud_rate, config.mcu.trailing_comma) == (57600, True)
    assert (config.mcu.wheels.rear_left, config.rate_hz) == ("-c", 50.0)
    assert config.bus.listen == ("tcp/127.0.0.1:7448", "tls/0.0.0.0:7449")
    assert all(line in after for line in text.splitlines() if line.startswith("#"))


@each(
    ("text", "keys"),
    [
        ("[mcu]\n", {"mcu.baud_rate": 300}), ("[mcu]\n", {"mcu.baud_rate": 9600}),
        ("[mcu]\n", {"mcu.wheels.front_right": "+b"}), ("[mcu\n", {"mcu.baud_rate": 57600}),
        ("[mcu]\nbaud = 3\n", {"mcu.baud_rate": 57600}),
    ],
)  # fmt: skip
def test_an_edit_that_makes_the_file_invalid_is_refused(text: str, keys: dict[str, object]) -> None:
    with pytest.raises((ConfigError, ValueError)):
        edited(text, keys)


@each(
    ("names", "comments"),
    [(["anna", "eve", "carl"], ["anna", "hall 3", "bob"]), (["eve", "carl"], ["bob"]), ([], [])],
)
def test_a_changed_list_keeps_its_items_comments(names: list[str], comments: list[str]) -> None:
    text = """[access]
operators = [
    "anna",   # hall 3, until May
    # "bob" left the company
    "eve",
]
"""
    after = edited(text, {"access.operators": names})
    assert parse(after.encode()).access.operators == tuple(names)
    assert all(words in after for words in comments)


def test_windows_line_ends_are_kept() -> None:
    before = "# mine\r\n[mcu]\r\nport = 'sim' # here\r\n"
    after = edited(before, EDITS)
    assert after.startswith(before)
    assert after.count("\r\n") == after.count("\n") > 8
    assert "\r\r" not in after

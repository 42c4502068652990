"""All mistakes in a configuration are reported at once.

Each has a line with key, value and correction.
"""

from __future__ import annotations

import tomllib
from pathlib import Path

import msgspec
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from msgspec import inspect

from acsard.core.config.contradictions import warnings
from acsard.core.config.parsing import (
    ConfigError,
    effective,
    from_builtins,
    parse,
    parse_recorded,
)
from acsard.core.config.settings import Config, Source
from tests.each import each
from tests.unit.keys import KEYS, Key

REFERENCE = Path(__file__).parents[4] / "acsard.toml"

FLOATS = [key for key in KEYS if any(isinstance(kind, inspect.FloatType) for kind in key.numbers())]


def problems_of(
    text: str | bytes, overrides: dict[str, dict[str, object]] | None = None
) -> list[str]:
    with pytest.raises(ConfigError) as caught:
        parse(text if isinstance(text, bytes) else text.encode(), overrides)
    return caught.value.problems


def accepted(text: str) -> Config:
    return parse(text.encode())


# the file as a whole


def test_an_empty_file_gives_the_defaults() -> None:
    assert parse(b"") == Config()


def test_a_recorded_configuration_may_have_keys_of_another_version() -> None:
    text = b"""
    later = 1
    [limits]
    linear_speed = 0.7
    later = [1]
    [fog]
    x = 1
    [[commands.sources]]
    name = "app"
    priority = 10
    timeout = 0.25
    later = true
    """
    config = parse_recorded(text)
    assert config.limits.linear_speed == 0.7
    assert [source.name for source in config.commands.sources] == ["app"]
    with pytest.raises(ConfigError, match=r"limits.later = .*: unknown key"):
        parse(text)
    with pytest.raises(ConfigError, match=r"limits.linear_speed"):
        parse_recorded(b"[limits]\nlinear_speed = -1.0")


def test_a_file_may_begin_with_a_byte_order_mark() -> None:
    # Notepad on Windows writes this mark.
    config = parse(b'\xef\xbb\xbf[robot]\r\nid = "r7"\r\n')
    assert config.robot.id == "r7"


def test_the_reference_file_decodes_to_exactly_the_defaults() -> None:
    assert parse(REFERENCE.read_bytes()) == Config()


def test_the_reference_file_has_every_key_of_every_table_and_no_other() -> None:
    table = tomllib.loads(REFERENCE.read_text(encoding="utf-8"))
    for source in table["commands"]["sources"]:
        source.setdefault("timeout", 0.25)
        source.setdefault("neutral_first", "zero")
    assert table == msgspec.json.decode(msgspec.json.encode(effective(Config())))


@each("key", KEYS)
def test_the_reference_file_gives_each_key_its_default(key: Key) -> None:
    place = tomllib.loads(REFERENCE.read_text(encoding="utf-8"))
    *tables, name = key.path.replace("[0]", "").split(".")
    for table in tables:
        place = place[table]
    if isinstance(place, list):
        assert name in place[0]
    else:
        assert msgspec.convert(place[name], key.field.type) == key.field.default


def test_the_reference_file_explains_each_table_in_a_comment() -> None:
    lines = REFERENCE.read_text(encoding="utf-8").splitlines()
    heads = [i for i, line in enumerate(lines) if line.startswith("[")]
    silent = [
        lines[head]
        for head, end in zip(heads, [*heads[1:], len(lines)], strict=True)
        if not any(line.startswith("#") for line in lines[head:end])
        and not lines[head].startswith("[[")
    ]
    assert silent == []


def test_the_effective_configuration_reads_back_as_the_same_configuration() -> None:
    config = accepted('[robot]\nid = "x"\n[control]\nrate = "auto"\n[commands]\nsources = []')
    assert from_builtins(effective(config)) == config
    assert from_builtins(msgspec.json.decode(msgspec.json.encode(effective(config)))) == config


def test_every_value_of_a_file_is_in_the_configuration() -> None:
    config = accepted(
        """
        [mcu]
        port = "/dev/ttyUSB0"
        baud_rate = 57600
        wheels.front_left = "-b"
        [control]
        rate = 50
        [[commands.sources]]
        name = "only"
        priority = 1
        timeout = 0.5
        [odometry]
        yaw_variance_per_metre = 1
        """
    )
    assert config.mcu.port == "/dev/ttyUSB0"
    assert config.mcu.baud_rate == 57600
    assert config.mcu.wheels.front_left == "-b"
    assert config.rate_hz == 50.0
    assert config.commands.sources == (Source("only", 1, 0.5),)
    assert config.odometry.yaw_variance_per_metre == 1.0
    assert config.drive == Config().drive


# the command line


def test_the_command_line_overrides_the_file() -> None:
    config = parse(b'[mcu]\nport = "/dev/a"\nbaud_rate = 9600\n[control]\nrate = 20', {
        "mcu": {"port": "/dev/b"}, "robot": {"id": "r2"},
    })  # fmt: skip
    assert config.mcu.port == "/dev/b"
    assert config.mcu.baud_rate == 9600
    assert config.robot.id == "r2"


def test_a_mistake_on_the_command_line_is_reported_like_one_in_the_file() -> None:
    (line,) = problems_of(b"", {"mcu": {"baud_rate": 1200}})
    assert line.startswith("mcu.baud_rate = 1200: expected one of 9600, 19200")


def test_the_command_line_does_not_hide_that_the_file_has_a_value_instead_of_a_table() -> None:
    (line,) = problems_of(b"mcu = 5", {"mcu": {"port": "/dev/b"}})
    assert line.startswith("mcu = 5: expected a table")


# planted mistakes


def test_the_error_message_lists_all_problems() -> None:
    with pytest.raises(ConfigError) as caught:
        parse(b"a = 1\nb = 2")
    assert str(caught.value) == "\n".join(caught.value.problems)


# numbers


@pytest.mark.slow
@each("text", ["inf", "-inf", "nan"])
@each("key", FLOATS)
def test_a_number_that_is_not_finite_is_refused_at_every_key(key: Key, text: str) -> None:
    items = len(key.field.default) if isinstance(key.field.default, tuple) else 0
    for place in range(max(1, items)):
        value = (
            f"[{', '.join(text if i == place else '1' for i in range(items))}]" if items else text
        )
        (line,) = problems_of(key.document(value))
        assert line.startswith(f"{key.path} = {value}: expected a ")


# text that is not a configuration


@each(
    "text",
    ["[mcu", "mcu", "[mcu]\nport = /dev/ttyUSB0", "a = 1\na = 2", "[a]\n[a]", "a = 1 = 2", "\x00",
     "a = True", 'a = "\\q"', "a = 2020-13-01", '"', "a.b = 1\na = 2", "[[a]]\n[a]\n[a]"],
)  # fmt: skip
def test_text_that_is_not_toml_gives_one_line_with_the_position(text: str) -> None:
    (line,) = problems_of(text)
    assert line.startswith("not TOML: ")
    assert "line" in line or "end of document" in line
    assert "\n" not in line


@each("text", [b"\xff", "[robot]".encode("utf-16"), b'id = "\xe9"', b"\x80" * 99])
def test_bytes_that_are_not_utf8_give_one_line(text: bytes) -> None:
    (line,) = problems_of(text)
    assert line.startswith("not UTF-8 text: ")
    assert line.endswith("; save the file as UTF-8")
    assert "\n" not in line


# the wire (MCU.md section 2)


def wire(baud: int, rate: object, comma: bool = False) -> str:
    flag = str(comma).lower()
    return f"[mcu]\nbaud_rate = {baud}\ntrailing_comma = {flag}\n[control]\nrate = {rate}\n"


@each(
    ("baud", "rate", "comma"),
    [(9600, 23, False), (9600, 22, True), (19200, 46, False), (38400, 93, False),
     (57600, 139, False), (115200, 279, False), (115200, 271, True)],
)  # fmt: skip
def test_a_rate_up_to_80_percent_of_the_wire_passes_without_a_warning(
    baud: int, rate: int, comma: bool
) -> None:
    assert warnings(accepted(wire(baud, rate, comma))) == []


@each("baud", [9600, 19200, 38400, 57600, 115200])
@each("comma", [False, True])
def test_an_automatic_rate_never_causes_a_warning(baud: int, comma: bool) -> None:
    config = accepted(wire(baud, '"auto"', comma))
    assert warnings(config) == []
    assert config.rate_hz * (34 if comma else 33) * 10 <= 0.8 * baud


# clients that can reach the bus (SAFETY section 3)


@each("key", ["listen", "connect"])
@each("host", ["127.0.0.1", "127.8.9.1", "[::1]", "localhost"])
def test_an_endpoint_may_name_this_machine(key: str, host: str) -> None:
    config = accepted(f'[bus]\n{key} = ["tcp/{host}:7448"]')
    assert getattr(config.bus, key) == (f"tcp/{host}:7448",)


@each("key", ["listen", "connect"])
@each(
    "host", ["0.0.0.0", "[::]", "192.168.1.2", "[fe80::1]", "robot.local", "*", "128.0.0.1",
             "localhost.evil.org", "127.0.0.1.evil.org", "1"],
)  # fmt: skip
def test_an_endpoint_on_the_network_is_refused_unless_insecure_is_set(key: str, host: str) -> None:
    text = f'[bus]\n{key} = ["tcp/{host}:7448"]\n'
    (line,) = problems_of(text)
    assert line.startswith(f'bus.{key} = "tcp/{host}:7448": this endpoint is on the network')
    assert line.endswith("bus.insecure = true")
    config = accepted(text + "insecure = true")
    assert any("every program that reaches the bus can drive" in text for text in warnings(config))


@each(
    "endpoint",
    ["", "tcp", "tcp/", "tcp/127.0.0.1", "tcp/127.0.0.1:", "tcp/:7448", "tcp/127.0.0.1:65536",
     "tcp/127.0.0.1:-1", "tcp/127.0.0.1:x", "udp/127.0.0.1:7448", "127.0.0.1:7448",
     "tcp/127.0.0.1:7448#iface=eth0", "tcp/127.0.0.1:٧", " tcp/127.0.0.1:7448"],
)  # fmt: skip
def test_an_invalid_endpoint_is_refused_even_when_insecure(endpoint: str) -> None:
    (line,) = problems_of(f'[bus]\nlisten = ["{endpoint}"]\ninsecure = true')
    assert line.startswith("bus.listen = ")
    assert "tcp/127.0.0.1:7448" in line


# contradictions at their limits


# random input

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
DOTTED = [key.path for key in KEYS if key.table is not Source]
LINES = st.one_of(
    st.builds("{} = {}".format, st.sampled_from(DOTTED), VALUES),
    st.builds("{} = {}".format, st.sampled_from(NAMES), VALUES),
    st.sampled_from(
        [f"[{table}]" for table in TABLES] + ["[[commands.sources]]", "# x", "[[mcu]]"]
    ),
)


def outcome(data: bytes) -> Config | list[str]:
    """Return the configuration or its problems. Any other error from `parse` fails the test."""
    try:
        return parse(data)
    except ConfigError as error:
        return error.problems


def is_config_or_lines(result: Config | list[str]) -> bool:
    if isinstance(result, Config):
        return from_builtins(effective(result)) == result
    return bool(result) and not any("\n" in line for line in result)


@pytest.mark.slow
@given(st.lists(LINES, max_size=12).map("\n".join))
@settings(max_examples=400)
def test_any_toml_like_text_gives_a_configuration_or_a_list_of_problems(text: str) -> None:
    assert is_config_or_lines(outcome(text.encode()))


@pytest.mark.slow
@given(st.binary(max_size=60) | st.text(max_size=60).map(lambda text: text.encode("utf-8")))
@settings(max_examples=300)
@example(b"\xef\xbb\xbf[robot]")
def test_any_bytes_give_a_configuration_or_a_list_of_problems(data: bytes) -> None:
    assert is_config_or_lines(outcome(data))


@pytest.mark.slow
@given(data=st.data())
@settings(max_examples=150)
def test_a_damaged_reference_file_gives_a_configuration_or_a_list_of_problems(
    data: st.DataObject,
) -> None:
    good = REFERENCE.read_bytes()
    start = data.draw(st.integers(0, len(good)))
    end = data.draw(st.integers(start, min(len(good), start + 30)))
    damaged = good[:start] + data.draw(st.binary(max_size=8)) + good[end:]
    assert is_config_or_lines(outcome(damaged))


@each(
    "text",
    [
        '"a\\nb" = 1',
        '[robot]\n"a\\nb" = 1',
        '"\\u001b[2J" = 1',
    ],
)
def test_a_key_with_control_characters_is_reported_in_one_printable_line(text: str) -> None:
    (line,) = problems_of(text)
    assert line.isprintable()


@each(
    "text",
    [
        b"a = 1" + b"0" * 5000,
        b"[drive]\nwheel_radius = 0x1" + b"0" * 5000,
        b"a = 0x1" + b"0" * 5000,
        b"a = " + b"[" * 5000,
        b"a = " + b"[" * 600 + b"]" * 600,
        b"a" + b".a" * 3000 + b" = 1",
    ],
)
def test_a_very_long_number_or_very_deep_nesting_gives_one_problem(text: bytes) -> None:
    assert len(problems_of(text)) == 1


# names of certificates


@each("name", ["anna", "laptop anna", "a_b.c:d@e+f-g", "J\u00fcrgen", "x" * 64])
def test_a_certificate_may_have_any_name_that_fits_into_a_key(name: str) -> None:
    assert accepted(f'[access]\noperators = ["{name}"]').access.operators == (name,)


@each("name", ["", "a/b", "a*", "a$b", "a#b", "a?b", "@a", "a[b]", "two\\nlines", "x" * 65])
def test_a_certificate_name_that_fits_into_no_key_is_refused_with_the_valid_characters(
    name: str,
) -> None:
    (problem,) = problems_of(f'[access]\noperators = ["{name}"]')
    assert problem.startswith("access.operators = ")
    assert "letters, digits" in problem

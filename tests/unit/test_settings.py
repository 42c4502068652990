"""The configuration: defaults, ranges, the reference file, and a verdict on each mistake.

In `words/settings.txt` the problems (`!`) and warnings (`?`) follow each configuration. To write
these lines anew, run `pytest --approve tests/unit/test_settings.py`, and then read `git diff`.
"""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest
from msgspec import inspect

from acsard.core.config import simulated_faults
from acsard.core.config.contradictions import contradictions, warnings
from acsard.core.config.live import differences
from acsard.core.config.nearest import hint, nearest
from acsard.core.config.parsing import (
    ConfigError,
    effective,
    parse,
    parse_recorded,
)
from acsard.core.config.settings import (
    BusConfig,
    Config,
    ControlConfig,
    JointsConfig,
    McuConfig,
    Source,
    WebConfig,
    WheelMap,
)
from acsard.core.config.validation import build
from acsard.core.config.wire_time import highest_rate, wire_ns, wire_use
from acsard.host.errors import UsageError
from acsard.web.listen import parse_listen
from tests.each import each
from tests.unit.keys import KEYS, Key
from tests.vectors.lines import WIRE
from tests.wheels import TWO

PAGE = Path(__file__).parent / "words" / "settings.txt"
REFERENCE = Path(__file__).parents[2] / "acsard.toml"
NUMBERS = [key for key in KEYS if key.numbers()]


def problems_of(
    text: str | bytes, overrides: dict[str, dict[str, object]] | None = None
) -> list[str]:
    with pytest.raises(ConfigError) as caught:
        parse(text if isinstance(text, bytes) else text.encode(), overrides)
    assert str(caught.value) == "\n".join(caught.value.problems)
    return caught.value.problems


def verdict(text: str) -> list[str]:
    """Return a line for each problem of a configuration, or else for each warning."""
    try:
        config = parse(text.encode())
    except ConfigError as error:
        return [f"! {problem}" for problem in error.problems]
    return [f"? {warning}" for warning in warnings(config)]


def test_each_configuration_has_its_verdict(
    approved: Callable[[Path, str], None],
) -> None:
    blocks = []
    for block in PAGE.read_text(encoding="utf-8").rstrip("\n").split("\n\n"):
        lines = [line for line in block.splitlines() if not line.startswith(("! ", "? "))]
        found = verdict("\n".join(lines))
        assert all(line.isprintable() for line in found)
        blocks.append("\n".join([*lines, *found]))
    approved(PAGE, "\n\n".join(blocks) + "\n")


# defaults and ranges


def accepts(key: Key, value: float) -> bool:
    """Return whether the key's own range accepts `value`."""
    table: dict[str, Any] = {key.field.name: value}
    if key.table is Source:
        table = {"name": "x", "priority": 1} | table
    return build(key.table, table, "t", []) is not None


@each("key", NUMBERS)
def test_every_number_is_accepted_up_to_its_bounds_and_no_further(key: Key) -> None:
    (kind, *_) = key.numbers()
    assert kind.ge is not None
    assert kind.le is not None
    assert math.isfinite(kind.ge)
    assert math.isfinite(kind.le)
    whole = isinstance(kind, inspect.IntType)
    below: float = kind.ge - 1 if whole else math.nextafter(kind.ge, -math.inf)
    above: float = kind.le + 1 if whole else math.nextafter(kind.le, math.inf)
    values = (kind.ge, kind.le, below, above, math.nan, math.inf)
    assert [accepts(key, value) for value in values] == [True, True, False, False, False, False]


def test_the_reference_file_has_every_key_and_no_other_and_explains_each_table() -> None:
    text = REFERENCE.read_text(encoding="utf-8")
    differ = differences(parse(text.encode()), Config())
    assert not differ, f"acsard.toml (its) and core/config/settings.py (ours) differ: {differ}"
    assert parse(b"") == Config()
    table = tomllib.loads(text)
    for source in table["commands"]["sources"]:
        source.setdefault("timeout", 0.25)
        source.setdefault("neutral_first", "zero")
    assert table == msgspec.json.decode(msgspec.json.encode(effective(Config())))
    for part in re.split(r"^(?=\[(?!\[))", text, flags=re.M):
        assert re.search(r"^#", part, re.M), part


@each("name", ["a", "A-z_0", "x" * 32, "", "x" * 33, "a b", "a/b", "*", "$*", "é", "a.b", "#", "?"])
def test_a_name_is_letters_digits_underscore_and_minus(name: str) -> None:
    good = name in ("a", "A-z_0", "x" * 32)
    assert (build(Source, {"name": name, "priority": 1}, "t", []) is not None) == good


@each("letter", [chr(code) for code in range(128)])
@each("sign", ["+", "-"])
def test_a_motor_is_a_sign_and_a_letter_that_is_no_sign_of_the_line(letter: str, sign: str) -> None:
    good = letter in set("abcdefghijklmnopqrstuvwxyz") - {"n", "p"}
    for name in ("front_left", "left"):
        assert (build(WheelMap, {name: sign + letter}, "t", []) is not None) == good
        assert build(WheelMap, {name: letter}, "t", []) is None
        assert build(WheelMap, {name: sign + letter + "\n"}, "t", []) is None
    assert build(WheelMap, {"front_left": ""}, "t", []) is None


@each("frame", ["robot1/front_left", "", "/odom", "a b", "x" * 65, "é", "a-b"])
def test_a_frame_name_that_tf2_would_refuse_is_refused(frame: str) -> None:
    good = frame == "robot1/front_left"
    assert (build(JointsConfig, {"front_left": frame}, "t", []) is not None) == good


# the file and the command line


def test_the_command_line_overrides_the_file_and_is_judged_like_it() -> None:
    config = parse(b'[mcu]\nport = "/dev/a"\nbaud_rate = 9600\n[control]\nrate = 20', {
        "mcu": {"port": "/dev/b"}, "robot": {"id": "r2"},
    })  # fmt: skip
    assert (config.mcu.port, config.mcu.baud_rate, config.robot.id) == ("/dev/b", 9600, "r2")
    (line,) = problems_of(b"", {"mcu": {"baud_rate": 1200}})
    assert line.startswith("mcu.baud_rate = 1200: expected one of 9600, 19200")
    (line,) = problems_of(b"mcu = 5", {"mcu": {"port": "/dev/b"}})
    assert line.startswith("mcu = 5: expected a table")


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


def test_a_file_may_begin_with_the_mark_that_windows_writes() -> None:
    assert parse(b'\xef\xbb\xbf[robot]\r\nid = "r7"\r\n').robot.id == "r7"


@each("text", [b"\xff", "[robot]".encode("utf-16"), b'id = "\xe9"', b"\x80" * 99])
def test_bytes_that_are_not_utf8_give_one_line(text: bytes) -> None:
    (line,) = problems_of(text)
    assert line.startswith("not UTF-8 text: ")
    assert line.endswith("; save the file as UTF-8")


@each(
    "text",
    [b"a = 1" + b"0" * 5000, b"[drive]\nwheel_radius = 0x1" + b"0" * 5000, b"a = " + b"[" * 5000,
     b"a = " + b"[" * 600 + b"]" * 600, b"a" + b".a" * 3000 + b" = 1", b"\x00"],
)  # fmt: skip
def test_a_very_long_number_or_very_deep_nesting_gives_one_problem(text: bytes) -> None:
    (line,) = problems_of(text)
    assert "\n" not in line


# rules between keys


@each(
    "addresses",
    [
        ("http://127.0.0.1:8080", "http://localhost:8081", "http://[::1]:8080"),
        ("http://[::ffff:127.0.0.1]:8080",), ("http://192.168.0.1:80",), ("http://robot:8080",),
        ("https://0.0.0.0:8443", "https://127.0.0.1:8444"), ("http://127.0.0.1:0",),
        ("http://127.0.0.1:65536",),
    ],
)  # fmt: skip
@each("tls", ["", "/etc/acsard/tls"])
def test_check_and_page_refuse_the_same_addresses(addresses: tuple[str, ...], tls: str) -> None:
    try:
        endpoints = [parse_listen(address) for address in addresses]
        refused = any(address.secure for address in endpoints) and not tls
    except UsageError:
        refused = True
    config = Config(bus=BusConfig(tls=tls), web=WebConfig(address=addresses))
    assert (contradictions(config) != []) == refused


# the wire (MCU.md section 2)


@each(
    ("baud", "count", "ms", "most"),
    [(baud, count, ms, most) for baud, *columns in WIRE
     for count, (ms, most) in zip((33, 36, 41), columns, strict=True)],
)  # fmt: skip
def test_the_time_of_a_line_and_the_highest_rate_are_those_of_the_table(
    baud: int, count: int, ms: float, most: int
) -> None:
    assert wire_ns(count, baud) / 1e6 == pytest.approx(ms, rel=0.005)
    assert highest_rate(baud, count) == most
    assert wire_use(most, baud, count) <= 1 < wire_use(most + 1, baud, count)


@each(
    ("mcu", "count", "rates"),
    [
        (McuConfig(), 33, (23, 46, 93, 100, 100)),
        (McuConfig(encoder_counts=3200), 33, (23, 46, 93, 100, 100)),
        (McuConfig(trailing_comma=True), 34, (22, 45, 90, 100, 100)),
        (McuConfig(link_check="on"), 41, (18, 37, 74, 100, 100)),
        (McuConfig(link_check="on", trailing_comma=True), 42, (18, 36, 73, 100, 100)),
        (McuConfig(link_check="on", encoder_counts=3200), 62, (12, 24, 49, 74, 100)),
        (McuConfig(wheels=TWO), 17, (45, 90, 100, 100, 100)),
        (McuConfig(wheels=TWO, trailing_comma=True), 18, (42, 85, 100, 100, 100)),
        (McuConfig(wheels=TWO, link_check="on"), 25, (30, 61, 100, 100, 100)),
        (McuConfig(wheels=TWO, link_check="on", encoder_counts=3200), 38, (20, 40, 80, 100, 100)),
    ],
)  # fmt: skip
def test_an_automatic_rate_uses_at_most_80_percent_of_the_wire_for_the_longest_line(
    mcu: McuConfig, count: int, rates: tuple[int, ...]
) -> None:
    assert mcu.line_bytes == count
    bauds: tuple[Any, ...] = (9600, 19200, 38400, 57600, 115200)
    found = []
    for baud in bauds:
        config = Config(
            mcu=msgspec.structs.replace(mcu, baud_rate=baud), control=ControlConfig(rate="auto")
        )
        assert not [line for line in warnings(config) if "control.rate" in line]
        found.append(config.rate_hz)
    assert tuple(found) == rates
    assert Config(control=ControlConfig(rate=50)).rate_hz == 50.0


# names


@each(
    ("word", "suggestion"),
    [("oddom", "odom"), ("tf-static", "tf_static"), ("linear_speed", "limits.linear_speed"),
     ("nonsense", ""), ("", ""), ("x" * 1000, "")],
)  # fmt: skip
def test_a_misspelt_word_gets_a_suggestion(word: str, suggestion: str) -> None:
    known = ["odom", "state", "tf_static", "limits.linear_speed"]
    assert nearest(word, known) == [suggestion] * bool(suggestion)
    advice = f"did you mean {suggestion}?" if suggestion else "look there"
    assert hint(word, known, "look there") == advice


@each(
    ("text", "values"),
    [("mute", ()), ("stuck_encoder=a", (0,)), ("swapped_wheels=b:d", (1, 3)), ("reset=5", (5,)),
     ("bias=c:1.2", (2, 1.2)), ("wrong_baud=57600", (57600,)), ("stalls=5:0.15", (5, 0.15))],
)  # fmt: skip
def test_a_fault_is_read_with_its_numbers(text: str, values: tuple[float, ...]) -> None:
    assert simulated_faults.parse(text, "abcd") == (text.partition("=")[0], *values)

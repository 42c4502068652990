"""Tests of edits to the text of an acsard.toml: comments stay, and impossible edits are refused."""

from __future__ import annotations

import pytest
from tomlkit.exceptions import NonExistentKey

from acsard.core.config.parsing import ConfigError, parse
from acsard.core.config.toml_editing import edited
from tests.each import each

KEYS: dict[str, object] = {
    "mcu.baud_rate": 57600,
    "mcu.trailing_comma": True,
    "mcu.reply_period": 0.1,
    "mcu.wheels.rear_left": "-c",
    "control.rate": 50.0,
}


@each(
    "text",
    [
        "",
        "# mine\n",
        "[mcu]\nport = 'sim' # here\n",
        "[mcu.wheels]\n# none\n",
        '[mcu]\nwheels = { front_right = "+a" }\n',
        "mcu.port = 'sim'\nmcu.wheels.rear_left = '+c'\n",
        "# mine\nmcu.port = 'sim'\nmcu.encoder_counts = 5\n[drive]\nwheel_radius = 0.1\n",
        "[mcu.wheels]\n# none\n[drive]\nwheel_radius = 0.1\n[mcu]\nport = 'sim'\n",
        "[bus]\nmode = 'peer'\n[mcu]\n\n[drive]\nwheel_radius = 0.1\n",
    ],
)
def test_keys_are_set_in_any_style_of_toml_file(text: str) -> None:
    after = edited(text, KEYS)
    config = parse(after.encode())
    assert (config.mcu.baud_rate, config.mcu.trailing_comma) == (57600, True)
    assert config.mcu.wheels.rear_left == "-c"
    assert config.rate_hz == 50.0
    assert all(line in after for line in text.splitlines() if line.startswith("#"))


@each(
    ("text", "keys"),
    [
        ("[mcu]\n", {"mcu.baud_rate": 300}),
        ("[mcu]\n", {"mcu.baud_rate": 9600}),
        ("[mcu]\n", {"mcu.wheels.front_right": "+b"}),
        ("[mcu\n", {"mcu.baud_rate": 57600}),
        ("[mcu]\nbaud = 3\n", {"mcu.baud_rate": 57600}),
    ],
)
def test_an_edit_that_makes_the_file_invalid_is_refused(text: str, keys: dict[str, object]) -> None:
    with pytest.raises((ConfigError, ValueError)):
        edited(text, keys)


@each(
    ("names", "comments"),
    [
        (["anna", "eve", "carl"], ["anna", "hall 3", "bob"]),
        (["eve", "carl"], ["bob"]),
        (["eve", "anna"], []),
        ([], []),
    ],
)
def test_a_changed_list_keeps_the_comments_of_its_items(
    names: list[str], comments: list[str]
) -> None:
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


@each("text", ["", "[bus]\n", "bus.tls = ''\n", '[bus]\nlisten = [\n  "tcp/[::1]:1",  # here\n]\n'])
def test_a_list_is_set_like_any_other_value(text: str) -> None:
    endpoints = ["tcp/127.0.0.1:7448", "tls/0.0.0.0:7449"]
    after = edited(text, {"bus.listen": endpoints, "bus.tls": "/etc/acsard/tls"})
    assert parse(after.encode()).bus.listen == tuple(endpoints)


def test_windows_line_ends_are_kept() -> None:
    before = "# mine\r\n[mcu]\r\nport = 'sim' # here\r\n"
    after = edited(before, KEYS)
    assert after.startswith(before)
    assert after.count("\r\n") == after.count("\n") > 8
    assert "\r\r" not in after


def test_an_error_of_the_toml_library_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(text: str) -> None:
        raise NonExistentKey("mcu")

    monkeypatch.setattr("tomlkit.parse", fails)
    with pytest.raises(ValueError, match="mcu"):
        edited("# mine\n", KEYS)

"""Tests that turn findings into lines of acsard.toml."""

from __future__ import annotations

from acsard.checkup import advice
from acsard.checkup.findings import Finding
from acsard.config.contradictions import contradictions
from acsard.config.parsing import parse
from acsard.config.settings import Config
from tests.unit.checkup.robots import configured


def found(**keys: object) -> list[Finding]:
    return [Finding(k, "PASS", keys={f"mcu.{k}": v}) for k, v in keys.items()]


def test_only_what_differs_is_to_be_written() -> None:
    findings = found(baud_rate=115200, trailing_comma=True, reply_period=0.0)
    assert advice.changes(findings, Config()) == {"mcu.trailing_comma": True}


def test_longer_lines_are_not_advised_where_the_wire_has_no_room() -> None:
    wanted = found(link_check="auto", encoder_counts=3200)
    assert len(advice.changes(wanted, Config())) == 2
    slow = configured(Config(), baud_rate=57600)
    assert advice.changes(wanted, slow) == {"mcu.link_check": "auto"}
    slower = configured(Config(), baud_rate=38400)
    assert advice.changes(wanted, slower) == {}


def test_a_slow_wire_takes_the_rate_with_it() -> None:
    keys = advice.changes(found(baud_rate=9600, link_check="auto"), Config())
    assert keys == {"mcu.baud_rate": 9600, "control.rate": "auto"}
    config = advice.applied(keys, Config())
    assert config is not None
    assert contradictions(config) == []


def test_what_is_in_use_is_not_taken_away() -> None:
    text = b'[mcu]\nlink_check = "require"\nencoder_counts = 3200\n'
    keys = advice.changes(found(baud_rate=38400, link_check="require", encoder_counts=3200),
                          parse(text))  # fmt: skip
    assert keys == {"mcu.baud_rate": 38400, "control.rate": "auto"}


def test_a_value_that_no_key_takes_is_seen() -> None:
    assert advice.applied({"mcu.baud_rate": 300}, Config()) is None


def test_a_port_is_written_that_a_board_answered_at() -> None:
    assert advice.changes(found(trailing_comma=True), Config(), "/dev/one") == {
        "mcu.trailing_comma": True
    }
    answered = [Finding("baud rate", "PASS", keys={"mcu.baud_rate": 115200})]
    assert advice.changes(answered, Config(), "/dev/one") == {"mcu.port": "/dev/one"}

"""Tests of faults written by name in the configuration."""

from __future__ import annotations

import re

import pytest

from acsard.core.config.contradictions import warnings
from acsard.core.config.named_faults import NamedFault, forms, named
from acsard.core.config.parsing import ConfigError, parse
from acsard.core.config.settings import Config, McuConfig, SimConfig
from tests.each import each


@each(
    ("text", "values"),
    [
        ("mute", ()),
        ("stuck_encoder=a", (0,)),
        ("swapped_wheels=b:d", (1, 3)),
        ("bias=c:1.2", (2, 1.2)),
        ("wrong_baud=57600", (57600,)),
        ("pushed=0.12", (0.12,)),
        ("stalls=5:0.15", (5, 0.15)),
        ("reset=0.5", (0.5,)),
        ("reset=5", (5,)),
    ],
)
def test_a_fault_is_read_with_its_numbers_and_printed_as_it_was_written(
    text: str, values: tuple[float, ...]
) -> None:
    assert str(named(text)) == text
    assert named(text) == NamedFault(text.partition("=")[0], values)


REFUSED = [
    ("x", "not a known fault; the known faults are mute, noise, "),
    ("mut", "not a known fault; did you mean mute?"),
    ("stall=5:0.15", "not a known fault; did you mean stalls=NUMBER:NUMBER?"),
    ("mute=1", "write it as mute"),
    ("bias", "write it as bias=MOTOR:NUMBER"),
    ("bias=a", "write it as bias=MOTOR:NUMBER"),
    ("swapped_wheels=a:b:c", "write it as swapped_wheels=MOTOR:MOTOR"),
    ("stalls=5", "write it as stalls=NUMBER:NUMBER"),
    ("stuck_encoder=e", "motors are a, b, c and d"),
    ("stuck_encoder=ab", "motors are a, b, c and d"),
    ("bias=a:much", "write a number like 5 or 0.15, up to 1e+06"),
    ("pushed=nan", "write a number like"),
    ("pushed=-inf", "write a number like"),
    ("pushed=1000001", "up to 1e+06"),
    ("wrong_baud=300", "the baud rate must be one of 9600"),
    ("stalls=0.1:0.2", "the shorter duration of each"),
    ("stalls=0.2:0.2", "the shorter duration of each"),
    ("estop_pressed=-1:2", "give the seconds from the start to the fault"),
    ("estop_silent=1:-2", "give the seconds from the start to the fault"),
    (
        "bumper_pressed=5:1:2",
        "the bumpers have the numbers 1 to 4, in the order in which the board",
    ),
    ("bumper_pressed=1:-1:2", "give the seconds from the start to the fault"),
    ("driver_fault=1:-2", "give the seconds from the start to the fault"),
    ("stalls=5:0", "both values must be at least 0.001"),
    ("stalls=5:0.0009", "both values must be at least 0.001"),
]


@each(
    ("text", "words"),
    [*REFUSED, ("", "not a known fault"), ("reset=0", "above 0"), ("reset=-1", "above")],
)
def test_an_invalid_fault_is_refused_with_the_reason(text: str, words: str) -> None:
    with pytest.raises(ValueError, match=re.escape(words)):
        named(text)


def test_the_help_shows_how_arguments_are_written() -> None:
    assert "bias=MOTOR:NUMBER" in forms()
    assert "stuck_encoder=MOTOR" in forms()


# in a file


def problems(faults: str) -> list[str]:
    with pytest.raises(ConfigError) as caught:
        parse(f"[sim]\nfaults = {faults}".encode())
    return caught.value.problems


def test_the_configuration_accepts_several_simulator_faults() -> None:
    config = parse(b'[sim]\nfaults = ["ftdi", "stalls=5:0.15", "stuck_encoder=b"]')
    assert config.sim.faults == ("ftdi", "stalls=5:0.15", "stuck_encoder=b")


@each(("text", "words"), REFUSED)
def test_a_name_that_is_not_a_fault_is_reported_with_its_key_and_place(
    text: str, words: str
) -> None:
    (message,) = problems(f'["ftdi", "{text}"]')
    assert message.startswith(f'sim.faults[1] = "{text}": ')
    assert words in message


def test_every_mistake_is_reported() -> None:
    messages = problems('["mut", "ftdi", "stalls=5"]')
    assert [line.partition(" ")[0] for line in messages] == ["sim.faults[0]", "sim.faults[2]"]


def test_a_fault_that_needs_a_timer_is_refused_with_the_command_that_accepts_it() -> None:
    assert problems('["reset=5"]') == [
        'sim.faults[0] = "reset=5": works only as `acsard sim --fault reset=5`; '
        "remove it from sim.faults"
    ]


@each("faults", ['"ftdi"', "[1]", '[""]', r'["mute\n"]', f'["{"x" * 65}"]'])
def test_a_value_that_is_not_a_list_of_short_texts_is_refused_with_the_expected_type(
    faults: str,
) -> None:
    (message,) = problems(faults)
    assert message.startswith("sim.faults = ")
    assert "expected a list, each a fault that `acsard sim --fault` accepts, in quotes" in message


def test_faults_of_the_simulator_are_a_warning_but_not_for_a_real_device() -> None:
    sim = SimConfig(faults=("ftdi",))
    (warning,) = warnings(Config(sim=sim))
    assert (
        warning
        == 'sim.faults = ["ftdi"]: the simulator has these faults on purpose; write [] for none'
    )
    assert warnings(Config(sim=sim, mcu=McuConfig(port="/dev/x"))) == []

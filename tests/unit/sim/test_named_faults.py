"""Faults as a person names them."""

from __future__ import annotations

import pytest

from acsard.config.settings import Config
from acsard.sim.fake_mcu import FakeMcu
from acsard.sim.faults import ARGUMENTS, FAULTS
from acsard.sim.named_faults import NamedFault, forms, named


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("mute", ()),
        ("stuck_encoder=a", (0,)),
        ("swapped_wheels=b:d", (1, 3)),
        ("bias=c:1.2", (2, 1.2)),
        ("other_baud=57600", (57600,)),
        ("pushed=0.12", (0.12,)),
        ("stalls=5:0.15", (5, 0.15)),
        ("reset=0.5", (0.5,)),
        ("reset=5", (5,)),
    ],
)
def test_a_fault_is_read_with_its_numbers(text: str, values: tuple[float, ...]) -> None:
    assert named(text) == NamedFault(text.partition("=")[0], values)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "is not a fault"),
        ("x", "is not a fault"),
        ("mute=1", "is not a fault"),
        ("bias", "is not a fault"),
        ("bias=a", "is not a fault"),
        ("swapped_wheels=a:b:c", "is not a fault"),
        ("stuck_encoder=e", "motors are a, b, c and d"),
        ("stuck_encoder=ab", "motors are a, b, c and d"),
        ("bias=a:much", "much is not a number"),
        ("other_baud=300", "rates are 9600"),
        ("stalls=5", "is not a fault"),
        ("stalls=0.1:0.2", "fewer for each"),
        ("stalls=5:0", "fewer for each"),
        ("stalls=nan:1", "fewer for each"),
        ("reset=0", "above 0"),
        ("reset=nan", "above 0"),
    ],
)
def test_what_is_no_fault_is_refused_in_words(text: str, words: str) -> None:
    with pytest.raises(ValueError, match=words) as told:
        named(text)
    assert str(told.value).startswith(text)


def test_each_fault_can_be_turned_on_and_back() -> None:
    mcu = FakeMcu(Config())
    before = dict(vars(mcu))
    example = {"m": "b", "mm": "b:c", "mn": "b:2", "n": "9600", "nn": "5:0.1"}
    arguments = [f"{name}={example[kinds]}" for name, kinds in ARGUMENTS.items()]
    for text in (*FAULTS, *arguments):
        with named(text).on(mcu):
            assert vars(mcu) != before, text
        assert vars(mcu) == before, text


def test_the_help_shows_how_arguments_are_written() -> None:
    assert "bias=MOTOR:NUMBER" in forms()
    assert "stuck_encoder=MOTOR" in forms()

"""Faults as a person names them: `mute`, `stuck_encoder=b`, `bias=c:1.2`."""

from __future__ import annotations

from typing import get_args

from msgspec import Struct

from acsard.config.settings import Baud
from acsard.sim.fake_mcu import FakeMcu
from acsard.sim.faults import ARGUMENTS, FAULTS, Fault

MOTORS = "abcd"
RESET = "reset"
"""Needs a timer, so whoever has one turns it on: again and again after so many seconds."""


class NamedFault(Struct, frozen=True):
    """One fault and its numbers; motors are 0 to 3."""

    name: str
    values: tuple[int | float, ...] = ()

    def on(self, mcu: FakeMcu) -> Fault:
        """The `with` block in which this one has it."""
        block: Fault = getattr(mcu, self.name)(*self.values)
        return block


def forms() -> list[str]:
    """How the faults with arguments are written."""
    words = {"m": "MOTOR", "n": "NUMBER"}
    return [f"{name}={':'.join(words[k] for k in kinds)}" for name, kinds in ARGUMENTS.items()]


def named(text: str) -> NamedFault:
    """The fault a person means; raises `ValueError` in words."""
    name, _, given = text.partition("=")
    values = [word for word in given.split(":") if word]
    kinds = {RESET: "n", **dict.fromkeys(FAULTS, ""), **ARGUMENTS}.get(name)
    if kinds is None or len(values) != len(kinds):
        raise ValueError(f"{text} is not a fault")
    fault = NamedFault(
        name, tuple(_value(text, kind, word) for kind, word in zip(kinds, values, strict=True))
    )
    if name == RESET and not fault.values[0] > 0:
        raise ValueError(f"{text}: seconds between resets must be above 0")
    if name == "stalls" and not fault.values[0] > fault.values[1] > 0:
        raise ValueError(f"{text}: seconds from one stall to the next, and fewer for each")
    if name == "other_baud" and fault.values[0] not in get_args(Baud):
        raise ValueError(f"{text}: rates are {', '.join(map(str, get_args(Baud)))}")
    return fault


def _value(text: str, kind: str, word: str) -> int | float:
    if kind == "m":
        if word not in tuple(MOTORS):
            raise ValueError(f"{text}: motors are a, b, c and d")
        return MOTORS.index(word)
    try:
        value = float(word)
    except ValueError:
        raise ValueError(f"{text}: {word} is not a number") from None
    return int(value) if value.is_integer() else value

"""Parses the names of simulated faults, such as `mute`, `stuck_encoder=b` or `stalls=5:0.15`.

They are methods in `core/simulator/faults.py` and `core/simulator/fake_mcu.py`.
"""

from __future__ import annotations

import math
from typing import get_args

from msgspec import Struct

from acsard.core.config.nearest import nearest
from acsard.core.config.partial import Rule
from acsard.core.config.settings import Baud, Config
from acsard.core.config.validation import show

# Faults without arguments.
FAULTS = (
    "mute", "noise", "partial_line", "slow_reply", "sparse_replies", "spaces", "unpadded",
    "trailing_comma", "comma_latched", "no_check", "plain_only", "no_sample", "no_watchdog",
    "late_watchdog", "watchdog_fed_by_bad_lines", "lost_replies", "lost_commands", "bit_errors",
    "free_running", "ftdi", "estop", "bumpers",
)  # fmt: skip

# Faults with a letter for each argument: `n` is a number, `m` a motor, a to d, stored as 0 to 3.
ARGUMENTS = {
    "stuck_encoder": "m", "frozen_encoder": "m", "dead_motor": "m", "reversed_motor": "m",
    "reversed_encoder": "m",
    "reversed_wheel": "m", "swapped_motors": "mm", "swapped_encoders": "mm",
    "swapped_wheels": "mm", "bias": "mn", "wrong_baud": "n",
    "pushed": "n", "stalls": "nn", "estop_pressed": "nn", "estop_silent": "nn",
    "bumper_pressed": "nnn", "bumpers_silent": "nn", "driver_fault": "nn",
    "battery": "nn",
}  # fmt: skip

# Faults of the board's inputs, which end with a delay and a duration, s (0: without end).
INPUT_FAULTS = ("estop_pressed", "estop_silent", "bumper_pressed", "bumpers_silent", "driver_fault")

# Its argument is a period, s. It needs a timer, so only `acsard sim --fault` offers it.
RESET_FAULT = "reset"

MOTORS = "abcd"

MAX_ARGUMENT = 1e6  # prevents an overflow in the simulator

MIN_STALL_S = 0.001  # a shorter one has no visible effect


class NamedFault(Struct, frozen=True):
    """A simulated fault and its arguments; motors are 0 to 3 (a to d)."""

    name: str
    values: tuple[int | float, ...] = ()

    def __str__(self) -> str:
        # As a user writes it, such as "bias=a:0.9".
        kinds = ARGUMENTS.get(self.name, "n" * len(self.values))
        words = [
            MOTORS[int(value)] if kind == "m" else str(value)
            for kind, value in zip(kinds, self.values, strict=True)
        ]
        return f"{self.name}={':'.join(words)}" if words else self.name


def forms() -> list[str]:
    """Return each fault with arguments as a user writes it, such as "stuck_encoder=MOTOR"."""
    return [_form(name, kinds) for name, kinds in ARGUMENTS.items()]


def named(text: str) -> NamedFault:
    """Parse a fault such as "stalls=5:0.15". Raises `ValueError` with mistake and fix."""
    name, _, arguments = text.partition("=")
    known = {RESET_FAULT: "n", **dict.fromkeys(FAULTS, ""), **ARGUMENTS}
    if name not in known:
        near = nearest(name, known)
        hint = f"the known faults are {', '.join((*FAULTS, *forms()))}"
        if near:
            hint = f"did you mean {_form(near[0], known[near[0]])}?"
        raise ValueError(f"not a known fault; {hint}")
    kinds, values = known[name], [word for word in arguments.split(":") if word]
    if len(values) != len(kinds):
        raise ValueError(f"write it as {_form(name, kinds)}")
    fault = NamedFault(
        name, tuple(_value(kind, word) for kind, word in zip(kinds, values, strict=True))
    )
    if name == RESET_FAULT and not fault.values[0] > 0:
        raise ValueError("the seconds between resets must be above 0")
    if name == "stalls" and not fault.values[0] > fault.values[1] >= MIN_STALL_S:
        raise ValueError(
            "give the seconds from one stall to the next, then the shorter duration of each "
            f"stall in seconds; both values must be at least {MIN_STALL_S}"
        )
    if name == "bumper_pressed" and fault.values[0] not in (1, 2, 3, 4):
        raise ValueError(
            "the bumpers have the numbers 1 to 4, in the order in which the board reports them"
        )
    if name in INPUT_FAULTS and not min(fault.values) >= 0:
        raise ValueError(
            "give the seconds from the start to the fault, then the seconds that the fault lasts "
            "(0 means that it never ends)"
        )
    if name == "battery" and not (0 <= fault.values[0] <= 100 and fault.values[1] > 0):
        raise ValueError(
            "give the battery's charge at the start, 0 to 100 %, then the minutes that a full "
            "battery lasts"
        )
    if name == "wrong_baud" and fault.values[0] not in get_args(Baud):
        raise ValueError(f"the baud rate must be one of {', '.join(map(str, get_args(Baud)))}")
    return fault


def warnings(config: Config) -> list[str]:
    """Return a warning if `sim.faults` has an effect: a user could take it for a real one."""
    faults = config.sim.faults
    if not faults or not config.mcu.simulated:
        return []
    return [
        f"sim.faults = {show(faults)}: the simulator has these faults on purpose; write [] for none"
    ]


def _problems(config: Config) -> list[str]:
    errors = []
    for i, text in enumerate(config.sim.faults):
        where = f"sim.faults[{i}] = {show(text)}"
        try:
            if named(text).name == RESET_FAULT:
                errors.append(
                    f"{where}: works only as `acsard sim --fault {text}`; remove it from sim.faults"
                )
        except ValueError as error:
            errors.append(f"{where}: {error}")
    return errors


RULES: tuple[Rule, ...] = (_problems,)


def _form(name: str, kinds: str) -> str:
    words = {"m": "MOTOR", "n": "NUMBER"}
    return f"{name}={':'.join(words[kind] for kind in kinds)}" if kinds else name


def _value(kind: str, word: str) -> int | float:
    if kind == "m":
        if word not in tuple(MOTORS):
            raise ValueError("the motors are a, b, c and d")
        return MOTORS.index(word)
    try:
        value = float(word)
    except ValueError:
        value = math.nan
    if not abs(value) <= MAX_ARGUMENT:
        raise ValueError(f"write a number like 5 or 0.15, up to {MAX_ARGUMENT:g}")
    return int(value) if value.is_integer() else value

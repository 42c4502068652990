"""The faults of the simulated board and of its serial wire: one table with a row for each fault.

A row says how a user writes its fault, what the fault does, and which switches it sets.
`core/simulator/fake_mcu.py` obeys the switches. No fault is random: one that affects only some
lines affects every n-th. Motors and encoders are numbered from 0 in the order of their letters, an
encoder by its motor even if encoders are swapped.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any, Literal, get_args

from msgspec import Struct
from msgspec.structs import replace

from acsard.core.config.nearest import nearest
from acsard.core.config.partial import Rule
from acsard.core.config.settings import Baud, Config
from acsard.core.config.validation import show
from acsard.core.values import NS_PER_S, Ns

MAX_ARGUMENT = 1e6  # prevents an overflow in the simulator

MIN_STALL_S = 0.001  # a shorter one has no visible effect

NEVER_NS = 2**62

STATUS_NS = NS_PER_S // 10  # between two status lines

Parsed = tuple[str, *tuple[float, ...]]  # name and arguments of a fault

PressedInput = tuple[Ns, Ns, str, str]  # begin, end, field of the status line, value


class BoardClock(Struct):
    period_ns: Ns
    name: bytes = b""  # `FakeMcu` gives each one another, to tell it from an older one


class BoardBattery(Struct):
    minutes: float  # that a full one lasts at rest
    charge: float  # 0 to 1
    drained_ns: Ns  # when `charge` was computed
    rested_ns: Ns  # when all set points were zero


class Switches(Struct):
    """The switches of the simulated board; the defaults are those of a sound one."""

    baud_rate: int
    bumpers: str  # as the board reports released ones
    # By motor, in the order of the letters.
    gains: tuple[float, ...]
    drivers: tuple[int, ...]  # motor of each output
    drives: tuple[float, ...]  # from command to set point
    encoders: tuple[int, ...]  # motor whose encoder is at each input
    encoder_signs: tuple[int, ...]  # -1: the motor's encoder is reversed
    now_ns: Ns = 0  # when the newest fault began
    dead_band: float = 0.0  # rad/s: the motors ignore smaller commands
    muted: bool = False
    noise_bytes: bytes = b""
    cut_replies: bool = False
    stuck: int | None = None
    frozen: int | None = None
    extra_delay_ns: Ns = 0
    separator: str = ","
    ending: str = "\r\n"
    unpadded_replies: bool = False
    watchdog: bool = True
    watchdog_ns: Ns = 300_000_000  # without a valid line, the board stops the motors
    any_feeds: bool = False  # invalid lines also reset the watchdog
    reply_gap_ns: Ns = 0
    push: float | None = None  # m/s, by a person
    firmware: Literal["reference", "latched", "prefix", "plain_only"] = "reference"
    toggled: bool = False  # direction pins
    last_edge: bool = False  # which gives all edges of a report its direction
    samples: bool = True
    latency_ns: Ns = 0  # of the USB adapter, which sends its packet then; 0: none
    stall_every_ns: Ns = 0
    stall_ns: Ns = 0
    lose_reply: int = 0  # every n-th is hit; 0: none
    lose_command: int = 0
    bit_error: int = 0
    # `silent` leaves the field out. The last fault of a field decides, except that each pressed
    # bumper is reported.
    inputs: tuple[PressedInput, ...] = ()
    battery: BoardBattery | None = None
    clocks: dict[str, BoardClock] = {}  # of what the board does by itself


class Fault(Struct, frozen=True):
    """A row of the table."""

    arguments: str  # as a user writes them; MOTOR is a letter, all others are numbers
    text: str
    switch: Callable[..., Switches]  # from the present switches and the arguments
    accepts: Callable[..., bool] = lambda *_: True
    advice: str = ""  # for arguments that are not accepted


def _put(values: tuple[Any, ...], place: int, value: object) -> tuple[Any, ...]:
    return (*values[:place], value, *values[place + 1 :])


def _swap(values: tuple[Any, ...], place: int, other: int) -> tuple[Any, ...]:
    return _put(_put(values, place, values[other]), other, values[place])


def _swapped_wheels(s: Switches, motor: int, other: int) -> Switches:
    drivers, encoders = _swap(s.drivers, motor, other), _swap(s.encoders, motor, other)
    return replace(s, drivers=drivers, encoders=encoders)


def _reversed_wheel(s: Switches, motor: int) -> Switches:
    drives = _put(s.drives, motor, -s.drives[motor])
    signs = _put(s.encoder_signs, motor, -s.encoder_signs[motor])
    return replace(s, drives=drives, encoder_signs=signs)


def _reporting(s: Switches, field: str, value: str, after: float = 0, lasts: float = 0) -> Switches:
    begin_ns = s.now_ns + int(after * NS_PER_S)
    end_ns = begin_ns + int(lasts * NS_PER_S) if lasts else NEVER_NS
    inputs = (*s.inputs, (begin_ns, end_ns, field, value))
    return replace(s, inputs=inputs, clocks={"inputs": BoardClock(STATUS_NS)} | s.clocks)


def _pressed(s: Switches, number: float, after: float, lasts: float) -> Switches:
    marks = "".join("X" if i == number else mark for i, mark in enumerate(s.bumpers, 1))
    return _reporting(s, "bumpers", marks, after, lasts)


def _with_battery(s: Switches, percent: float, minutes: float) -> Switches:
    battery = BoardBattery(minutes, percent / 100, s.now_ns, s.now_ns)
    return replace(s, battery=battery, clocks=s.clocks | {"battery": BoardClock(STATUS_NS)})


def _free_running(s: Switches, period_s: float = 0.1) -> Switches:
    clocks = s.clocks | {"report": BoardClock(_ns(period_s))}
    return replace(s, clocks=clocks, unpadded_replies=True, ending=",\r\n")


def _ns(seconds: float) -> Ns:
    return int(seconds * NS_PER_S)


def _is_timed(*arguments: float) -> bool:
    return min(arguments) >= 0


TIMED_ADVICE = (
    "give the seconds from the start to the fault, then the seconds that the fault lasts "
    "(0 means that it never ends)"
)

# Arguments with a default are for tests: a user writes only those that the row names.
# fmt: off
FAULTS = {
    "mute": Fault("", "The board obeys lines but sends no replies and no status lines.",
        partial(replace, muted=True)),
    "noise": Fault("", "The board sends noise in front of each reply.",
        lambda s, data=b"\x00\xff~": replace(s, noise_bytes=data)),
    "partial_line": Fault("", "The board sends only the first half of each reply.",
        partial(replace, cut_replies=True)),
    "slow_reply": Fault("", "The board obeys and answers each line 0.03 s later.",
        lambda s, delay_s=0.03: replace(s, extra_delay_ns=_ns(delay_s))),
    "sparse_replies": Fault("", "The board sends at most ten replies per second.",
        lambda s, period_s=0.1: replace(s, reply_gap_ns=_ns(period_s))),
    "spaces": Fault("", "The board writes a space after every comma.",
        partial(replace, separator=", ")),
    "unpadded": Fault("", "The board writes speeds below ten with one integer digit, as 3.14.",
        partial(replace, unpadded_replies=True)),
    "trailing_comma": Fault("", "The board ends its replies with a comma.",
        partial(replace, ending=",\r\n")),
    "comma_latched": Fault("", "The board obeys each speed with a comma, and ignores checksums.",
        partial(replace, firmware="latched")),
    "toggled_direction": Fault("", "The board toggles a direction pin at a sign that differs from "
        "the last whole value's: a cut line can reverse the motor for good.",
        partial(replace, toggled=True)),
    "last_edge": Fault("", "The board counts edges of both directions alike; the last one of a "
        "report decides the sign.",
        partial(replace, last_edge=True)),
    "no_check": Fault("", "The board ignores the host's checksums, and replies without checksums.",
        partial(replace, firmware="prefix")),
    "plain_only": Fault("", "The board obeys only plain lines: one with a checksum is invalid.",
        partial(replace, firmware="plain_only")),
    "no_sample": Fault("", "The board's checked replies lack its time and its encoder counts.",
        partial(replace, samples=False)),
    "no_watchdog": Fault("", "The board never stops the motors by itself.",
        partial(replace, watchdog=False)),
    "late_watchdog": Fault("", "The board stops the motors only after 1 s without a valid line.",
        lambda s, time_s=1.0: replace(s, watchdog_ns=_ns(time_s))),
    "watchdog_fed_by_bad_lines": Fault("", "Invalid lines, too, reset the board's watchdog.",
        partial(replace, any_feeds=True)),
    "lost_replies": Fault("", "One of five replies is lost on its way to the host.",
        lambda s, every=5: replace(s, lose_reply=every)),
    "lost_commands": Fault("", "One of five lines is lost on its way to the board.",
        lambda s, every=5: replace(s, lose_command=every)),
    "bit_errors": Fault("", "One bit flips in one of seven lines, counted in both directions.",
        lambda s, every=7: replace(s, bit_error=every)),
    "free_running": Fault("", "The board reports ten times per second, and answers no line.",
        _free_running),
    "ftdi": Fault("", "A USB adapter delays replies by up to 16 ms.",
        lambda s, latency_s=0.016: replace(s, latency_ns=_ns(latency_s))),
    "estop": Fault("", "The board reports a released emergency stop ten times per second.",
        partial(_reporting, field="estop", value="ok")),
    "bumpers": Fault("", "The board reports released bumpers: those of safety.bumpers, or four.",
        lambda s: _reporting(s, "bumpers", s.bumpers)),
    "stuck_encoder": Fault("MOTOR", "The board reports that the motor stands still.",
        lambda s, motor: replace(s, stuck=motor)),
    "frozen_encoder": Fault("MOTOR", "The board repeats the last reported speed of the motor.",
        lambda s, motor: replace(s, frozen=motor)),
    "dead_motor": Fault("MOTOR", "The motor ignores its commands.",
        lambda s, motor: replace(s, drives=_put(s.drives, motor, 0.0))),
    "dead_band": Fault("RAD/S", "The motors ignore smaller commands.",
        lambda s, least: replace(s, dead_band=least)),
    "reversed_motor": Fault("MOTOR", "The two leads of the motor are swapped: it turns backward.",
        lambda s, motor: replace(s, drives=_put(s.drives, motor, -s.drives[motor]))),
    "reversed_encoder": Fault("MOTOR", "The signals A and B of the encoder are swapped.",
        lambda s, motor: replace(
            s, encoder_signs=_put(s.encoder_signs, motor, -s.encoder_signs[motor]))),
    "reversed_wheel": Fault("MOTOR", "The motor and its encoder are reversed.",
        _reversed_wheel),
    "swapped_motors": Fault("MOTOR:MOTOR", "The wires of two motors are swapped.",
        lambda s, motor, other: replace(s, drivers=_swap(s.drivers, motor, other))),
    "swapped_encoders": Fault("MOTOR:MOTOR", "The wires of two encoders are swapped.",
        lambda s, motor, other: replace(s, encoders=_swap(s.encoders, motor, other))),
    "swapped_wheels": Fault("MOTOR:MOTOR", "Two wheels are swapped, motors and encoders.",
        _swapped_wheels),
    "bias": Fault("MOTOR:FACTOR", "The board multiplies the motor's speed and counts by FACTOR.",
        lambda s, motor, factor: replace(s, gains=_put(s.gains, motor, factor))),
    "wrong_baud": Fault("RATE", "The board uses this baud rate.",
        lambda s, rate: replace(s, baud_rate=rate),
        lambda rate: rate in get_args(Baud),
        f"the baud rate must be one of {', '.join(map(str, get_args(Baud)))}"),
    "pushed": Fault("M/S", "A person pushes the robot straight ahead, against the motors.",
        lambda s, speed: replace(s, push=speed)),
    "stalls": Fault("EVERY:SECONDS", "No byte reaches the host for SECONDS, every EVERY seconds.",
        lambda s, every_s, stall_s: replace(s, stall_every_ns=_ns(every_s), stall_ns=_ns(stall_s)),
        lambda every_s, stall_s: every_s > stall_s >= MIN_STALL_S,
        "give the seconds from one stall to the next, then the shorter duration of each stall in "
        f"seconds; both values must be at least {MIN_STALL_S}"),
    "estop_pressed": Fault("START:SECONDS", "The board reports a pressed emergency stop.",
        lambda s, *times: _reporting(s, "estop", "pressed", *times), _is_timed, TIMED_ADVICE),
    "estop_silent": Fault("START:SECONDS", "The board stops reporting its emergency stop.",
        lambda s, *times: _reporting(s, "estop", "silent", *times), _is_timed, TIMED_ADVICE),
    "bumper_pressed": Fault("BUMPER:START:SECONDS", "The board reports a pressed bumper, 1 to 4.",
        _pressed,
        lambda number, *times: number in (1, 2, 3, 4) and _is_timed(*times),
        "the bumpers have the numbers 1 to 4, in the order in which the board reports them; then "
        f"{TIMED_ADVICE}"),
    "bumpers_silent": Fault("START:SECONDS", "The board stops reporting its bumpers.",
        lambda s, *times: _reporting(s, "bumpers", "silent", *times), _is_timed, TIMED_ADVICE),
    "driver_fault": Fault("START:SECONDS", "The board reports a fault of the motor driver.",
        lambda s, *times: _reporting(s, "driver", "fault", *times), _is_timed, TIMED_ADVICE),
    "battery": Fault("PERCENT:MINUTES", "The board reports a battery, charged to PERCENT, that "
        "lasts MINUTES at rest if it is full.",
        _with_battery,
        lambda percent, minutes: 0 <= percent <= 100 and minutes > 0,
        "give the battery's charge at the start, 0 to 100 %, then the minutes that a full battery "
        "lasts"),
    "reset": Fault("SECONDS", "The board restarts every SECONDS.",
        lambda s, period_s: replace(s, clocks=s.clocks | {"reset": BoardClock(_ns(period_s))}),
        lambda period_s: period_s > 0,
        "the seconds between resets must be above 0"),
}
# fmt: on


def form(name: str) -> str:
    """Return a fault as a user writes it, such as `bias=MOTOR:FACTOR`."""
    return "=".join(filter(None, (name, FAULTS[name].arguments)))


def parse(text: str, letters: str) -> Parsed:
    """Return the name and the arguments of a fault such as `stalls=5:0.15`.

    A motor is its place in `letters`. Raises `ValueError` with mistake and fix.
    """
    name, _, arguments = text.partition("=")
    if name not in FAULTS:
        near = nearest(name, FAULTS)
        hint = f"the known faults are {', '.join(map(form, FAULTS))}"
        raise ValueError(f"not a known fault; {f'did you mean {form(near[0])}?' if near else hint}")
    fault = FAULTS[name]
    kinds, words = (list(filter(None, t.split(":"))) for t in (fault.arguments, arguments))
    if len(words) != len(kinds):
        raise ValueError(f"write it as {form(name)}")
    values = [_value(kind, word, letters) for kind, word in zip(kinds, words, strict=True)]
    if not fault.accepts(*values):
        raise ValueError(fault.advice)
    return name, *values


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
        try:
            parse(text, config.mcu.wheels.letters)
        except ValueError as error:
            errors.append(f"sim.faults[{i}] = {show(text)}: {error}")
    return errors


RULES: tuple[Rule, ...] = (_problems,)


def _value(kind: str, word: str, letters: str) -> float:
    if kind == "MOTOR":
        if word not in tuple(letters):
            raise ValueError(f"the motors are {', '.join(letters[:-1])} and {letters[-1]}")
        return letters.index(word)
    try:
        value = float(word)
    except ValueError:
        value = math.nan
    if not abs(value) <= MAX_ARGUMENT:
        raise ValueError(f"write a number like 5 or 0.15, up to {MAX_ARGUMENT:g}")
    return int(value) if value.is_integer() else value

"""Each fault of the fake board changes what it names in its block, and nothing after it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, ExitStack, suppress
from itertools import pairwise
from operator import methodcaller
from typing import Any

from acsard.core.config.named_faults import ARGUMENTS, FAULTS, named
from acsard.core.config.settings import Config, SimConfig
from acsard.core.simulator.fake_mcu import MS, RESET_NS, FakeMcu
from acsard.core.simulator.faults import Faults
from tests.each import each
from tests.unit.test_simulator import (
    LINE,
    SPEEDS,
    TRUE,
    ZERO,
    Heard,
    drive,
    replies,
)

SEALED = LINE[:-2] + b"#07S*EE6B\r\n"


Fault = Callable[[FakeMcu], AbstractContextManager[None]]

NAMED: Mapping[str, Fault] = {name: methodcaller(name) for name in FAULTS} | {
    "bias": methodcaller("bias", 2, 1.5), "stuck_encoder": methodcaller("stuck_encoder", 1),
    "frozen_encoder": methodcaller("frozen_encoder", 2),
}  # fmt: skip


def story(mcu: FakeMcu, start_ns: int) -> tuple[Heard, list[float], list[float]]:
    """Drive for half a second, then send only one invalid line."""
    chunks = drive(mcu, start_ns, 40) + drive(mcu, start_ns + 400 * MS, 10, SEALED)
    chunks += replies(mcu, start_ns + 650 * MS)
    mcu.receive(start_ns + 650 * MS, b"ap0\r\n")
    chunks += replies(mcu, start_ns + 1000 * MS)
    at = [(when - start_ns, data) for when, data in chunks]
    return at, list(mcu.vehicle.angles), list(mcu.vehicle.set_points)


@each("fault", NAMED.values())
def test_a_fault_changes_the_behaviour_and_ends_with_its_block(fault: Fault) -> None:
    faulty, sound, mended = FakeMcu(TRUE), FakeMcu(TRUE), FakeMcu(TRUE)
    with fault(faulty):
        assert story(faulty, 0) != story(FakeMcu(TRUE), 0)
    with suppress(KeyError), fault(mended):
        drive(mended, 0, 4, ZERO)
        replies(mended, 250 * MS)
        raise KeyError
    drive(sound, 0, 4, ZERO)
    replies(sound, 250 * MS)
    assert story(mended, 250 * MS) == story(sound, 250 * MS)


@each(
    ("faults", "reply"),
    [
        ([("spaces",), ("trailing_comma",), ("noise", b"~")],
         b"~ap12.50, bn08.75, cp15.00, dn10.25,\r\n"),
        ([("noise", b"\x00\xff~")], b"\x00\xff~" + LINE),
        ([("partial_line",)], LINE[:16]),
        ([("bias", 0, 0.0), ("bias", 2, 0.5)], b"ap00.00,bn08.75,cp07.50,dn10.25\r\n"),
        ([("stuck_encoder", 1)], b"ap12.50,bp00.00,cp15.00,dn10.25\r\n"),
        ([("swapped_encoders", 0, 1), ("reversed_encoder", 0)],
         b"an08.75,bn12.50,cp15.00,dn10.25\r\n"),
        ([("mute",)], None),
        ([("lost_replies", 1)], None),
    ],
)  # fmt: skip
def test_a_fault_of_the_report_does_not_change_the_motion(
    faults: list[tuple[Any, ...]], reply: bytes | None
) -> None:
    mcu = FakeMcu(TRUE)
    with ExitStack() as on:
        for name, *arguments in faults:
            on.enter_context(getattr(mcu, name)(*arguments))
        chunks = drive(mcu, 0, 6)
    assert [data for _, data in chunks[-1:]] == ([] if reply is None else [reply])
    assert mcu.vehicle.set_points == SPEEDS
    assert mcu.valid_lines == 6


@each(
    ("line", "set_points"),
    [
        (LINE, [12.5, -8.75, 15.0, 0.0]),
        (LINE[:-2] + b",\r\n", SPEEDS),
        (b"ap12.50,bx08.75,cp1?.00,dn10.25,\r\n", [12.5, 0.0, 0.0, -10.25]),
        (b"apnan,bp01.00,cp01.00,dp01.00,\r\n", [0.0, 1.0, 1.0, 1.0]),
    ],
)
def test_a_comma_latched_board_takes_wheels_at_commas(line: bytes, set_points: list[float]) -> None:
    mcu = FakeMcu(TRUE)
    with mcu.comma_latched():
        drive(mcu, 0, 1, line)
        assert mcu.vehicle.set_points == set_points


def test_a_free_running_board_reports_by_its_own_clock_unpadded_and_with_a_comma() -> None:
    mcu = FakeMcu(TRUE)
    with mcu.free_running(0.1):
        chunks = drive(mcu, 0, 40, b"ap02.50,bn08.75,cp15.00,dp00.00\r\n")
        assert {data for _, data in chunks[1:]} == {b"ap2.50,bn8.75,cp15.00,dp0.00,\r\n"}
        assert [b[0] - a[0] for a, b in pairwise(chunks)] == [100 * MS] * 2
        mcu.reset(400 * MS)
        assert b"," not in mcu.advance(400 * MS + RESET_NS)
    with mcu.free_running(0.1):  # entered twice, it is not twice as fast
        assert 9 <= mcu.advance(1400 * MS + RESET_NS).count(b"ap0.00") <= 10


# The switches.


def switches(faults: Faults) -> dict[str, object]:
    return {k: v for k, v in vars(faults).items() if not k.startswith("_")}


def test_a_bit_error_flips_one_bit_and_a_different_one_each_time() -> None:
    faults, data = Faults(), bytes(40)
    with faults.bit_errors(every=1):
        turned = [int.from_bytes(faults._damaged(data), "big") for _ in range(320)]
    assert all(number.bit_count() == 1 for number in turned)
    assert len(set(turned)) == 320
    assert faults._damaged(data) == data


EXAMPLE = {"m": "b", "mm": "b:c", "mn": "b:2", "n": "9600", "nn": "5:0.1", "nnn": "1:5:2"}
EACH = (*FAULTS, *(f"{name}={EXAMPLE[kinds]}" for name, kinds in ARGUMENTS.items()))


def test_each_fault_can_be_turned_on_and_off_and_is_on_at_the_start_if_configured() -> None:
    mcu = FakeMcu(Config())
    before = dict(vars(mcu))
    for text in EACH:
        configured = FakeMcu(Config(sim=SimConfig(faults=(text, "ftdi"))))
        with mcu.switched_on(named(text)):
            assert vars(mcu) != before, text
            for switch in switches(Faults()).keys() - {"latency_ns"}:
                assert getattr(configured, switch) == getattr(mcu, switch), (text, switch)
        assert vars(mcu) == before, text
        assert configured.latency_ns == 16_000_000

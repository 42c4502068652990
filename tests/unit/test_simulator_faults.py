"""Each fault of the fake board changes what it names in its block, and nothing after it."""

from __future__ import annotations

from contextlib import ExitStack, suppress
from itertools import pairwise
from typing import Any

import pytest

from acsard.core.config.settings import Config, SimConfig
from acsard.core.config.simulated_faults import FAULTS, parse
from acsard.core.simulator.fake_mcu import MS, RESET_NS, FakeMcu
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

# Faults that a user writes without arguments, and three others, with their arguments.
CASES: dict[str, tuple[float, ...]] = {
    **{name: () for name, fault in FAULTS.items() if not fault.arguments and name != "last_edge"},
    "bias": (2, 1.5),
    "stuck_encoder": (1,),
    "frozen_encoder": (2,),
}


def story(mcu: FakeMcu, start_ns: int) -> tuple[Heard, list[float], list[float]]:
    """Drive for half a second, then send only one invalid line."""
    chunks = drive(mcu, start_ns, 40)
    mcu.receive(start_ns + 400 * MS, b"bp\r\n")
    chunks += drive(mcu, start_ns + 400 * MS, 10, SEALED)
    chunks += replies(mcu, start_ns + 650 * MS)
    mcu.receive(start_ns + 650 * MS, b"ap0\r\n")
    chunks += replies(mcu, start_ns + 1000 * MS)
    at = [(when - start_ns, data) for when, data in chunks]
    return at, list(mcu.vehicle.angles), list(mcu.vehicle.set_points)


@each("name", CASES)
def test_a_fault_changes_the_behaviour_and_ends_with_its_block(name: str) -> None:
    faulty, sound, mended = FakeMcu(TRUE), FakeMcu(TRUE), FakeMcu(TRUE)
    with faulty.fault(name, *CASES[name]):
        assert story(faulty, 0) != story(FakeMcu(TRUE), 0)
    with suppress(KeyError), mended.fault(name, *CASES[name]):
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
            on.enter_context(mcu.fault(name, *arguments))
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
    with mcu.fault("comma_latched"):
        drive(mcu, 0, 1, line)
        assert mcu.vehicle.set_points == set_points


def test_a_free_running_board_reports_by_its_own_clock_unpadded_and_with_a_comma() -> None:
    mcu = FakeMcu(TRUE)
    with mcu.fault("free_running", 0.1):
        chunks = drive(mcu, 0, 40, b"ap02.50,bn08.75,cp15.00,dp00.00\r\n")
        assert {data for _, data in chunks[1:]} == {b"ap2.50,bn8.75,cp15.00,dp0.00,\r\n"}
        assert [b[0] - a[0] for a, b in pairwise(chunks)] == [100 * MS] * 2
        mcu.reset(400 * MS)
        assert b"," not in mcu.advance(400 * MS + RESET_NS)
    with mcu.fault("free_running", 0.1):  # entered twice, it is not twice as fast
        assert 9 <= mcu.advance(1400 * MS + RESET_NS).count(b"ap0.00") <= 10


@each(("fault", "reported"), [((), 3.0), (("last_edge",), 10.0)])
def test_a_reversal_between_two_reports(fault: tuple[str, ...], reported: float) -> None:
    """The motors turn forward for 65 ms and back for 35 ms. The fault adds both, and says back."""
    mcu, line = FakeMcu(TRUE), b"ap%b,bp00.00,cp00.00,dp00.00\r\n"
    with ExitStack() as on:
        for name in ("free_running", *fault):
            on.enter_context(mcu.fault(name))
        chunks = drive(mcu, 0, 16, line % b"10.00")
        chunks += drive(mcu, 160 * MS, 8, line.replace(b"ap", b"an") % b"10.00")
    text = chunks[-1][1]
    assert len(chunks) == 2
    assert text[1:2] == (b"n" if fault else b"p")
    assert float(text[2:].split(b",")[0]) == pytest.approx(reported, abs=0.9)


def test_a_line_cut_behind_its_sign_reverses_a_toggled_direction_for_good() -> None:
    mcu, line = FakeMcu(TRUE), b"ap10.00,bp10.00,cp00.00,dp00.00\r\n"
    with mcu.fault("toggled_direction"):
        drive(mcu, 0, 2, line)
        assert mcu.vehicle.set_points == [10.0, 10.0, 0.0, 0.0]
        drive(mcu, 20 * MS, 1, b"ap10.00,bn\r\n")
        drive(mcu, 30 * MS, 2, line)
        assert mcu.vehicle.set_points == [10.0, -10.0, 0.0, 0.0]


# The switches.


def test_a_bit_error_flips_one_bit_and_a_different_one_each_time() -> None:
    mcu, data = FakeMcu(TRUE), bytes(40)
    with mcu.fault("bit_errors", 1):
        turned = [int.from_bytes(mcu._damaged(data), "big") for _ in range(320)]
    assert all(number.bit_count() == 1 for number in turned)
    assert len(set(turned)) == 320
    assert mcu._damaged(data) == data


EXAMPLES = {
    "RAD/S": "1.0",
    "MOTOR": "b", "MOTOR:MOTOR": "b:c", "MOTOR:FACTOR": "b:2", "RATE": "9600", "M/S": "1",
    "EVERY:SECONDS": "5:0.1", "START:SECONDS": "5:0.1", "BUMPER:START:SECONDS": "1:5:2",
    "PERCENT:MINUTES": "5:0.1", "SECONDS": "5",
}  # fmt: skip


@each("name", FAULTS)
def test_each_fault_can_be_turned_on_and_off_and_is_on_at_the_start_if_configured(
    name: str,
) -> None:
    arguments = FAULTS[name].arguments
    text = f"{name}={EXAMPLES[arguments]}" if arguments else name
    mcu, configured = FakeMcu(Config()), FakeMcu(Config(sim=SimConfig(faults=(text,))))
    before = dict(vars(mcu))
    with mcu.fault(*parse(text, "abcd")):
        assert mcu.switches != before["switches"]
        assert configured.switches == mcu.switches
    assert vars(mcu) == before


def test_a_board_with_resets_starts_again_and_again() -> None:
    mcu = FakeMcu(Config())
    with mcu.fault("reset", 5):
        boots = [mcu.advance(s * 1000 * MS).count(b"boot") for s in range(1, 22)]
    assert boots == [i % 5 == 1 and i > 1 for i in range(1, 22)]

"""The board's status lines. No damage may make a pressed input look released."""

from __future__ import annotations

import binascii
import random
from collections import Counter
from contextlib import suppress

import pytest

from acsard.core.config.settings import WheelMap
from acsard.core.link.board_status import STATUS, BoardStatus, as_text, decode_status, merged
from acsard.core.link.checked_line import unseal
from acsard.core.link.codec import Codec, FrameError
from acsard.core.simulator import protocol
from tests.each import each
from tests.wheels import MAPS

FULL = b"!status estop=ok bumpers=..X. driver=fault volts=24.31 amps=-1.20 charge=87% temp=-4.5"
OK, PRESSED = b"!status estop=ok", b"!status estop=pressed"
REPLIES = (
    b"ap12.50,bn08.75,cp15.00,dn10.25",
    b"ap1.5, bn8.75, cp15.000, dn10.25,",
    b"ap12.50,bn08.75,cp15.00,dn10.25#07*585F",
    b"ap00.00,bp00.00,cp00.00,dp00.00#07@0102AAAABBBBCCCCDDDD*1234",
    b"lp12.50,rn08.75",
    b"lp00.00,rp00.00#07@0102AAAABBBB*1234",
)


def sealed(line: bytes) -> bytes:
    return line + b"*%04X" % binascii.crc_hqx(line, 0)


def why(line: bytes, check: bool) -> str:
    with pytest.raises(FrameError) as caught:
        decode_status(line, check)
    return caught.value.reason


@each("check", [False, True])
def test_each_field_is_read(check: bool) -> None:
    assert decode_status(sealed(FULL) if check else FULL, check) == BoardStatus(
        estop=False, bumpers=(False, False, True, False), driver_fault=True, volts=24.31,
        amps=-1.2, charge=0.87, temperature=-4.5,
    )  # fmt: skip


@each(
    "line",
    [
        b"!status", b"!status ", b"!statusestop=ok", b"!status  estop=ok", b"!status estop=ok ",
        b"!status estop=ok estop=ok", b"!status estop=ok estop=pressed", b"!status estop=0",
        b"!status estop=OK", b"!status estop=", b"!status estop", b"!status =ok",
        b"!status estop=ok!status estop=pressed", b"!status estop=ok,", b"!status brakes=ok",
        b"!status bumpers=", b"!status bumpers=.....", b"!status bumpers=01",
        b"!status volts=24", b"!status volts=24.3", b"!status volts=24.311",
        b"!status volts=124.31",
        b"!status volts=-1.00", b"!status amps=1.5", b"!status amps=+1.50", b"!status charge=87",
        b"!status charge=101%", b"!status charge=8.7%", b"!status temp=41", b"!status temp=nan",
        b"!status estop=ok ap00.00,bp00.00,cp00.00,dp00.00", b"!status estop=ok\0",
        b"!status\testop=ok", b"!status estop=ok*12", b"!status estop=ok*9c94",
    ],
)  # fmt: skip
def test_a_status_line_of_any_other_form_is_refused_whole(line: bytes) -> None:
    assert why(line, False) == "status_malformed"


def test_a_checksum_must_be_right_and_a_checked_link_needs_it() -> None:
    assert sealed(OK) == b"!status estop=ok*9C94"
    assert decode_status(sealed(OK), True) == decode_status(OK, False)
    assert why(OK, True) == "status_without_crc"
    for check in (False, True):
        assert why(b"!status estop=ok*9C95", check) == "status_crc_error"
        for line in (OK, PRESSED):
            word = {"estop": line.partition(b"=")[2].decode()}
            assert protocol.status(word, check) == (sealed(line) if check else line) + b"\r\n"


def test_a_field_keeps_its_last_value_until_a_newer_line_has_it() -> None:
    status = merged(decode_status(FULL, False), BoardStatus(estop=True, volts=23.9))
    assert (status.estop, status.volts, status.amps) == (True, 23.9, -1.2)
    assert as_text(status) == {
        "emergency_stop": "pressed", "bumpers": "..X.", "motor_driver": "fault",
        "volts": "23.90", "amperes": "-1.20", "charge": "0.87", "temperature_c": "-4.5",
    }  # fmt: skip
    assert as_text(BoardStatus()) == {}


# confusion


@each("wheels", [*MAPS, WheelMap(left="+s", right="-t")])
@each("line", [OK, PRESSED, FULL, sealed(OK), sealed(FULL)])
def test_a_status_line_is_not_a_reply_in_any_dialect(line: bytes, wheels: WheelMap) -> None:
    for comma in (False, True):
        with pytest.raises(FrameError):
            Codec(wheels, comma).decode(line)
    with pytest.raises(FrameError):
        unseal(line, len(wheels.names))
    decoders = protocol.reference, protocol.plain_only, protocol.prefix
    assert [decode(line, wheels.letters) for decode in decoders] == [None] * 3
    assert protocol.latched(line + b",", wheels.letters).values == {}


@each("reply", REPLIES)
def test_no_reply_with_two_wrong_bits_or_a_cut_is_a_status_line(reply: bytes) -> None:
    # At most two bits differ, so at most two bytes of the word.
    for cut in range(len(reply)):
        start = reply[cut : cut + len(STATUS)]
        wrong = sum((a ^ b).bit_count() for a, b in zip(start, STATUS, strict=False))
        assert len(start) < len(STATUS) or wrong > 2


# damage


def damaged(line: bytes, others: tuple[bytes, ...], dice: random.Random) -> bytes:
    """Return the line with one kind of damage by a wire, an adapter or a full buffer.

    `others` are the lines that may follow it.
    """
    data, place = bytearray(line), dice.randrange(len(line))
    match dice.randrange(8):
        case 0:
            data[place] ^= 1 << dice.randrange(8)
        case 1:
            for _ in range(dice.randint(2, 6)):
                data[dice.randrange(len(data))] ^= 1 << dice.randrange(8)
        case 2:
            del data[place:]
        case 3:
            del data[:place]
        case 4:
            del data[place : place + dice.randint(1, 8)]
        case 5:
            data[place:place] = dice.choice(others)[: dice.randint(1, 40)]
        case 6:
            data[place : place + 4] = dice.randbytes(4)
        case _:
            # The end of one line is lost, and the beginning of the next one.
            del data[place:]
            data += dice.choice(others)[dice.randrange(16) :]
    return bytes(data)


COUNTS = [4000, pytest.param(1_000_000, marks=[pytest.mark.soak, pytest.mark.timeout(600)])]


@each("check", [False, True])
@pytest.mark.parametrize("count", COUNTS)
def test_damage_never_changes_the_emergency_stop_or_a_bumper(count: int, check: bool) -> None:
    """Plain lines may lose bumpers: the robot does not use a line with another number of them."""
    dice, tally = random.Random(33), Counter[str]()
    for _ in range(count):
        # A line with another emergency stop would be true, because it is the later one.
        word = dice.choice((PRESSED, OK))
        line = word + dice.choice((b"", b" bumpers=..X.", b" bumpers=..X. volts=24.31 charge=87%"))
        frame = damaged(sealed(line) if check else line, (word, *REPLIES), dice)
        if frame.startswith(STATUS):
            with suppress(FrameError):
                read = decode_status.__wrapped__(frame, check)
                right = read.estop in (None, word == PRESSED)
                if read.bumpers is not None and (check or len(read.bumpers) == 4):
                    right &= read.bumpers == (False, False, True, False)
                    tally["bumpers"] += 1
                tally["right" if right else "wrong"] += 1
    assert check or (tally["right"] > count / 100 and tally["bumpers"] > count / 400)
    assert tally["wrong"] == 0

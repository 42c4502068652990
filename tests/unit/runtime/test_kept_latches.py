"""The content of the latch file: nothing that a damaged disk leaves makes a stop disappear."""

from __future__ import annotations

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from acsard.runtime.kept_latches import MAX_BYTES, LatchFileError, decode, encode, stopped
from acsard.values import Instant, Latch, Latches

NOW = Instant(7_000_000_000, 1_800_000_000_000_000_000)

STOP = Latch(
    1_800_000_000_000, NOW.wall_ns, "joe@laptop (native)", "stopped by joe@laptop (native)"
)
FAULT = Latch(1_800_000_000_001, NOW.wall_ns, "", "front_left turns by itself")
INACTIVE = Latch(1_800_000_000_002, NOW.wall_ns, "page", "switched off by page")
ALL = Latches(STOP, FAULT, INACTIVE, {"limits.linear_speed": 0.4})

texts = st.text(st.characters(codec=None), max_size=600)
latch = st.builds(Latch, st.integers(0, 2**53), st.integers(0, 2**63), texts, texts, st.booleans())
several = st.builds(
    Latches,
    st.none() | latch,
    st.none() | latch,
    st.none() | latch,
    st.dictionaries(texts, st.floats(allow_nan=False, allow_infinity=False)),
)


def test_the_file_is_json_that_a_person_can_read() -> None:
    text = encode("acsar", Latches(stop=STOP)).decode()
    assert '"why": "stopped by joe@laptop (native)"' in text
    assert len(text.splitlines()) > 10


def test_all_latches_come_back_marked_as_kept() -> None:
    assert decode("acsar", encode("acsar", ALL)) == ALL.after_restart()
    assert decode("acsar", encode("acsar", Latches())) == Latches()


@given(several)
def test_no_text_of_a_stranger_loses_a_latch(latches: Latches) -> None:
    data = encode("acsar", Latches(latches.stop, latches.fault, latches.inactive))
    after = decode("acsar", data)
    assert len(data) < MAX_BYTES
    before = latches.stop, latches.fault, latches.inactive
    now = after.stop, after.fault, after.inactive
    assert [one and one.number for one in now] == [one and one.number for one in before]


def test_half_a_file_is_refused_at_every_length() -> None:
    whole = encode("acsar", ALL)
    for length in range(len(whole) - 1):  # the last byte only ends the last line
        for half in (whole[:length], whole[:length].ljust(len(whole), b"\0")):
            with pytest.raises(LatchFileError):
                decode("acsar", half)


def test_one_flipped_bit_never_makes_a_latch_disappear() -> None:
    whole = encode("acsar", ALL)
    for place in range(len(whole) * 8):
        flipped = bytearray(whole)
        flipped[place // 8] ^= 1 << place % 8
        try:
            after = decode("acsar", bytes(flipped))
        except LatchFileError:
            continue
        assert after.stop
        assert after.fault
        assert after.inactive
        assert len(after.lowered) == 1


@given(st.binary(max_size=300))
def test_garbage_is_refused(data: bytes) -> None:
    with pytest.raises(LatchFileError):
        decode("acsar", data)


def test_a_file_without_one_of_its_names_is_refused() -> None:
    raw = msgspec.json.decode(encode("acsar", ALL))
    for name in raw["latches"]:
        less = raw | {
            "latches": {key: raw["latches"][key] for key in raw["latches"] if key != name}
        }
        with pytest.raises(LatchFileError, match="missing"):
            decode("acsar", msgspec.json.encode(less))


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "it is empty"),
        (b"\0" * 512, "it is empty"),
        (b"[" * 5000, "it is damaged"),
        (encode("acsar", ALL).replace(b'"format": 1', b'"format": 2'), "of another version"),
        (b'{"format": 2, "all": "new"}', "of another version"),
        (encode("other", ALL), "belongs to the robot 'other'"),
    ],
)
def test_the_reason_says_how_the_file_is_wrong(data: bytes, reason: str) -> None:
    with pytest.raises(LatchFileError, match=reason):
        decode("acsar", data)


def test_a_stop_by_the_daemon_is_newer_than_the_latches_beside_it() -> None:
    late = replace(FAULT, number=1_900_000_000_000)
    made = stopped(Latches(fault=late), "the file cannot be read", NOW)
    assert made.fault == late
    assert made.stop == Latch(late.number + 1, NOW.wall_ns, "acsard", "the file cannot be read")


def test_the_number_of_a_stop_by_the_daemon_is_the_wall_time_in_ms() -> None:
    made = stopped(Latches(), "the file cannot be read", NOW)
    assert made.stop is not None
    assert made.stop.number == 1_800_000_000_000


def test_a_stop_that_is_latched_already_stays() -> None:
    assert stopped(ALL, "the file cannot be read", NOW) is ALL

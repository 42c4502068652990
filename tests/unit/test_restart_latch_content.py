"""The content of the latch file: damage, other versions, and numbers that are never used twice."""

from __future__ import annotations

from typing import get_args

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from acsard.core.codes import Code
from acsard.core.motion.latches import MAX_CAUSES
from acsard.core.motion.lifecycle import Lifecycle
from acsard.core.values import Cause, CauseKind, Latches
from acsard.daemon.latch_file import (
    FORMAT,
    MAX_NUMBER,
    LatchFileError,
    decode,
    encode,
    new_latches,
    unreadable,
)
from tests.each import each
from tests.unit.test_restart_latch_file import ALL, NOW, RUNAWAY, STOP, kept

texts = st.text(st.characters(codec=None), max_size=600)
cause = st.builds(
    Cause,
    st.integers(1, MAX_NUMBER),
    st.sampled_from(get_args(CauseKind)),
    st.sampled_from(get_args(Code)),
    texts,
    texts,
    texts,
    st.integers(-(2**63) + 1, 2**63 - 1),
)


def test_numbers_grow_over_restarts_and_a_killed_run_s_numbers_are_not_used_again() -> None:
    """The run before may have published numbers that it could not write."""
    data, lasts = encode("acsar", STOP), set()
    for _ in range(100):
        latches = decode("acsar", data)
        assert latches.causes == kept(STOP)
        assert latches.last > STOP.last
        lasts.add(latches.last)
    assert len(lasts) == 100
    lost = [new_latches().last for _ in range(100)]
    lost += [unreadable("FILE", "why", NOW).last for _ in range(100)]
    assert len(set(lost)) == 200
    assert max(lost) < 1 << 49
    assert max(lost) > 1 << 44


@given(st.lists(cause, max_size=MAX_CAUSES))
def test_no_text_of_a_client_loses_a_cause(causes: list[Cause]) -> None:
    data = encode("acsar", Latches(tuple(causes), MAX_NUMBER))
    after = decode("acsar", data).causes
    assert [one.number for one in after] == [one.number for one in causes]


def test_half_a_file_is_refused_at_every_length() -> None:
    whole = encode("acsar", ALL)
    for length in range(len(whole) - 1):  # the last byte only ends the last line
        for half in (whole[:length], whole[:length].ljust(len(whole), b"\0")):
            with pytest.raises(LatchFileError):
                decode("acsar", half)


def test_one_flipped_bit_never_makes_a_cause_disappear() -> None:
    whole = encode("acsar", ALL)
    for bit in range(len(whole) * 8):
        flipped = bytearray(whole)
        flipped[bit // 8] ^= 1 << bit % 8
        try:
            after = decode("acsar", bytes(flipped))
        except LatchFileError:
            continue
        assert [cause.kind for cause in after.causes] == ["stop", "fault", "inactive"]


@each("index", [0, 1, 2])
def test_a_cause_that_a_later_version_added_still_holds_the_robot(index: int) -> None:
    raw = msgspec.json.decode(encode("acsar", ALL))
    raw["causes"][index] |= {"code": "stopped_by_music", "text": "stopped by music"}
    latches = decode("acsar", msgspec.json.encode(raw))
    held = latches.causes[index]
    assert (held.number, held.kind) == (ALL.causes[index].number, ALL.causes[index].kind)
    assert (held.code, held.text) == ("other_version", "stopped by music (stopped_by_music)")
    assert Lifecycle(latches).mode == "fault"
    assert decode("acsar", encode("acsar", latches)).causes == latches.causes


@each(
    "data",
    [
        b"", b"\0" * 512, b"[" * 5000, b"[1, 2]", b'{"format": "3"}', b'{"format": 3}',
        encode("acsar", ALL).replace(b'"format": 3', b'"format": 2'),
        encode("acsar", ALL).replace(b'"format": 3', b'"format": 4'),
        encode("acsar", ALL).replace(b'"causes"', b'"cause"'),
        encode("acsar", ALL).replace(b'"last"', b'"lost"'),
        encode("acsar", ALL).replace(b'"inactive"', b'"parked"'),
        encode("acsar", replace(ALL, last=RUNAWAY.number)),
        encode("acsar", replace(ALL, last=MAX_NUMBER + 1)),
        encode("acsar", ALL).replace(b"5000001", b"0"),
        encode("acsar", ALL).replace(b"5000001", b"1" * 30),
        encode("acsar", ALL).replace(b"1800000000000000000", b"9223372036854775808"),
        encode("other", ALL),
    ],
)  # fmt: skip
def test_a_file_without_latches_of_this_robot_is_refused(data: bytes) -> None:
    with pytest.raises(LatchFileError):
        decode("acsar", data)
    assert FORMAT == 3

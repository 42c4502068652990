"""Tests of the latch file's content: no damage to the file can make a stop disappear."""

from __future__ import annotations

import json
from typing import get_args

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from acsard.core.codes import Code, reason
from acsard.core.motion.lifecycle import NAMELESS, Lifecycle
from acsard.core.values import NS_PER_S, Event, Instant, Latch, Latches
from acsard.daemon.latch_rules import (
    FORMAT,
    MAX_ANSWER_DELAY_NS,
    MAX_BYTES,
    MAX_NUMBER,
    Handover,
    LatchFileError,
    after_failed_write,
    at_start,
    decode,
    encode,
    stopped,
)
from tests.each import each

NOW = Instant(7_000_000_000, 1_800_000_000_000_000_000)

STOP = Latch(
    1_800_000_000_000,
    NOW.wall_ns,
    "joe@laptop (native)",
    "stopped by joe@laptop (native)",
    "stopped",
)
FAULT = Latch(1_800_000_000_001, NOW.wall_ns, "", "front_left turns by itself", "wheel_runaway")
INACTIVE = Latch(1_800_000_000_002, NOW.wall_ns, "page", "switched off by page", "switched_off")
ALL = Latches(STOP, FAULT, INACTIVE)

CANNOT_BE_READ = at_start("the file cannot be read")

texts = st.text(st.characters(codec=None), max_size=600)
latch = st.builds(
    Latch,
    st.integers(0, MAX_NUMBER),
    st.integers(0, 2**63 - 1),
    texts,
    texts,
    st.sampled_from(get_args(Code)),
    texts,
    st.booleans(),
)
several = st.builds(
    Latches,
    st.none() | latch,
    st.none() | latch,
    st.none() | latch,
)


def test_the_file_is_json_that_a_person_can_read() -> None:
    text = encode("acsar", Latches(stop=STOP)).decode()
    assert len(text.splitlines()) > 10
    assert '\n  "latches"' in text
    assert text.endswith("\n}\n")


def test_a_client_s_text_is_stored_up_to_500_characters() -> None:
    for length in (499, 500, 501):
        latches = Latches(stop=replace(STOP, by="j" * length))
        stop = decode("acsar", encode("acsar", latches)).stop
        assert stop
        assert len(stop.by) == min(length, 500)


def test_all_decoded_latches_are_marked_as_kept() -> None:
    assert decode("acsar", encode("acsar", ALL)) == ALL.after_restart()
    assert decode("acsar", encode("acsar", Latches())) == Latches()


@each("depth", [1, 2, 300])
@each("name", ["stop", "fault", "inactive"])
def test_an_earlier_cause_with_earlier_causes_of_its_own_is_refused(name: str, depth: int) -> None:
    cause = json.dumps(json.loads(encode("acsar", Latches(stop=STOP)))["latches"]["stop"])
    nested = cause
    for _ in range(depth):
        nested = f'{cause[:-1]}, "earlier": [{nested}]}}'
    latches = f'{{"stop": null, "fault": null, "inactive": null, "{name}": {nested}}}'
    data = f'{{"format": {FORMAT}, "robot": "acsar", "latches": {latches}}}'.encode()
    if depth == 1:
        assert decode("acsar", data) is not None
        return
    with pytest.raises(LatchFileError, match="causes of its own"):
        decode("acsar", data)


@each("field", ["number", "at_ns"])
@each("value", [-(1 << 64), 1 << 53, 1 << 63, 10**30])
def test_a_number_or_a_time_that_no_message_could_contain_is_refused(
    field: str, value: int
) -> None:
    latches = Latches(stop=replace(STOP, earlier=(STOP,)))
    content = json.loads(encode("acsar", latches))
    if (field, value) == ("at_ns", 1 << 53):
        return  # an ordinary time
    for latch in (content["latches"]["stop"], content["latches"]["stop"]["earlier"][0]):
        before = latch[field]
        latch[field] = value
        with pytest.raises(LatchFileError, match="out of range"):
            decode("acsar", json.dumps(content).encode())
        latch[field] = before
    assert decode("acsar", json.dumps(content).encode()).stop is not None


@given(several)
def test_no_text_of_a_client_loses_a_latch(latches: Latches) -> None:
    data = encode("acsar", Latches(latches.stop, latches.fault, latches.inactive))
    after = decode("acsar", data)
    assert len(data) < MAX_BYTES
    before = latches.stop, latches.fault, latches.inactive
    now = after.stop, after.fault, after.inactive
    assert [entry and entry.number for entry in now] == [entry and entry.number for entry in before]


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


def test_fields_that_a_later_version_added_are_ignored() -> None:
    causes = Latches(replace(STOP, earlier=(replace(STOP, by="anna"),)), FAULT, INACTIVE)
    raw = msgspec.json.decode(encode("acsar", causes))
    for latch in (*raw["latches"].values(), raw["latches"]["stop"]["earlier"][0]):
        latch["later"] = {"deep": [1]}
    raw["latches"]["later"] = None
    raw["later"] = 1
    assert decode("acsar", msgspec.json.encode(raw)) == causes.after_restart()


@each("name", ["stop", "fault", "inactive"])
def test_a_cause_that_a_later_version_added_still_holds_the_robot(name: str) -> None:
    raw = msgspec.json.decode(encode("acsar", ALL))
    latch = raw["latches"][name]
    latch["earlier"] = [latch | {"code": "stopped_by_rain", "why": "stopped by rain"}]
    latch |= {"code": "stopped_by_music", "why": "stopped by music"}
    latches = decode("acsar", msgspec.json.encode(raw))
    life = Lifecycle(latches)
    before = {"stop": STOP, "fault": FAULT, "inactive": INACTIVE}[name]
    held = getattr(latches, name)
    assert held.number == before.number
    assert (held.code, held.why) == ("other_version", "stopped by music (stopped_by_music)")
    assert [cause.why for cause in held.earlier] == ["stopped by rain (stopped_by_rain)"]
    assert len({cause.cause for cause in held.causes}) == 2
    assert life.mode in ("fault", "stopped", "inactive")
    assert decode("acsar", encode("acsar", latches)) == latches


def test_a_kind_of_latch_that_a_later_version_added_makes_the_file_unreadable() -> None:
    raw = msgspec.json.decode(encode("acsar", Latches()))
    raw["latches"]["parked"] = {"number": 7}
    with pytest.raises(LatchFileError, match="another version of acsard has latched 'parked'"):
        decode("acsar", msgspec.json.encode(raw))


@each(
    "data",
    [
        b"",
        b"\0" * 512,
        b"[" * 5000,
        b"[1, 2]",
        b'{"format": "2"}',
        encode("acsar", ALL).replace(b'"format": 2', b'"format": 3'),
        encode("other", ALL),
        encode("acsar", ALL).replace(b"earlier", b"earliex"),
    ],
)
def test_a_file_without_latches_of_this_robot_is_refused(data: bytes) -> None:
    with pytest.raises(LatchFileError):
        decode("acsar", data)


def test_a_stop_by_the_daemon_is_newer_than_the_latches_beside_it() -> None:
    late = replace(FAULT, number=1_900_000_000_000)
    made = stopped(Latches(fault=late), CANNOT_BE_READ, NOW)
    assert made.fault == late
    number = late.number + 1 + NOW.mono_ns // 1_000_000
    assert made.stop == Latch(
        number, NOW.wall_ns, "acsard", CANNOT_BE_READ.text, "stopped_at_start"
    )


def test_the_number_of_a_stop_by_the_daemon_is_the_wall_time_in_ms() -> None:
    made = stopped(Latches(), CANNOT_BE_READ, NOW)
    assert made.stop is not None
    assert made.stop.number == 1_800_000_000_000


@pytest.mark.parametrize("wall_ns", [0, -NS_PER_S])
def test_a_wall_clock_that_was_never_set_gives_a_stop_the_number_0(wall_ns: int) -> None:
    latches = stopped(Latches(), CANNOT_BE_READ, Instant(1, wall_ns))
    assert latches.stop
    assert latches.stop.number == 0


def test_a_stop_by_the_daemon_does_not_replace_a_latched_stop() -> None:
    assert stopped(ALL, CANNOT_BE_READ, NOW) is ALL


def test_each_latch_of_a_file_that_cannot_be_written_takes_a_new_number() -> None:
    made = after_failed_write(ALL, at_start("the file cannot be written"), NOW)
    old = {latch.number for latch in (ALL.stop, ALL.fault, ALL.inactive) if latch}
    new = [latch.number for latch in (made.fault, made.inactive, made.stop) if latch]
    assert len(new) == 3
    assert new == sorted(new)
    assert min(new) > max(old)
    for before, after in ((ALL.stop, made.stop), (ALL.fault, made.fault)):
        assert before
        assert after
        assert replace(after, number=before.number) == before


def test_two_unwritable_starts_with_a_wall_clock_set_back_have_different_numbers() -> None:
    """With equal numbers, a `clear` for the first start's latch could release the second start's.

    The latch at the second start stands for a stop that a crash has lost.
    """
    wall_ns = NOW.wall_ns - 40_828_000_000_000
    starts = [
        after_failed_write(ALL, CANNOT_BE_READ, Instant(mono_ns, wall_ns))
        for mono_ns in (76 * 10**9, 78 * 10**9)
    ]
    numbers = [
        latch.number for made in starts for latch in (made.fault, made.inactive, made.stop) if latch
    ]
    assert len(set(numbers)) == 6
    assert numbers == sorted(numbers)


def test_a_file_without_a_stop_that_cannot_be_written_starts_the_robot_stopped() -> None:
    made = after_failed_write(Latches(), at_start("the file cannot be written"), NOW)
    assert made.stop
    assert made.stop.code == "stopped_at_start"


class Keeper:
    """A store of latches that saves them only when the test tells it to."""

    def __init__(self) -> None:
        self.given: list[Latches] = []
        self.waits: list[tuple[Latches, float]] = []
        self.held: Latches | None = None
        self.trouble = "the disk is full"

    def keep(self, latches: Latches) -> None:
        self.given.append(latches)

    def holds(self, latches: Latches) -> bool:
        return self.held is latches

    def wait(self, latches: Latches, seconds: float) -> None:
        self.waits.append((latches, seconds))

    def take_events(self) -> list[Event]:
        return [Event("latch_file", "the disk is full", "warning")]


def test_only_changed_latches_are_handed_to_the_keeper() -> None:
    keeper, first = Keeper(), Latches()
    handover = Handover(first, keeper)
    handover.take(first)
    assert keeper.given == []
    handover.take(ALL)
    handover.take(ALL)
    assert keeper.given == [ALL]
    assert handover.latches is ALL


def test_latches_are_held_once_the_keeper_holds_them() -> None:
    keeper = Keeper()
    handover = Handover(Latches(), keeper)
    handover.take(ALL)
    assert not handover.is_stored
    keeper.held = ALL
    assert handover.is_stored


def test_each_stop_that_no_step_served_is_latched_with_the_name_of_its_client() -> None:
    keeper = Keeper()
    Handover(Latches(), keeper).take_stops(Latches(), ["joe", "page", "joe"], NOW)
    (latches,) = keeper.given
    assert latches.stop is not None
    assert [cause.by for cause in latches.stop.causes] == ["joe", "page"]


def test_a_stop_that_no_step_served_keeps_the_causes_of_the_stop_before_it() -> None:
    keeper = Keeper()
    life = Lifecycle()
    life.stop("ann", 1, NOW)
    life.press(reason("bumper", bumpers="a bumper is pressed"), NOW)
    Handover(life.latches, keeper).take_stops(life.latches, ["joe"], NOW)
    (latches,) = keeper.given
    assert latches.stop is not None
    assert [(cause.code, cause.by) for cause in latches.stop.causes] == [
        ("stopped", "joe"), ("bumper", ""), ("stopped", "ann"),
    ]  # fmt: skip


def test_every_cause_of_a_stop_is_in_the_file_with_at_most_500_characters() -> None:
    life = Lifecycle()
    life.stop("a" * 600, 1, NOW)
    life.press(reason("bumper", bumpers="a bumper is pressed"), NOW)
    latches = decode("r", encode("r", life.latches))
    assert latches.stop is not None
    first, second = latches.stop.causes
    assert (first.code, first.kept) == ("bumper", True)
    assert (second.by, second.kept) == ("a" * 500, True)
    damaged = encode("r", life.latches).replace(b'"earlier"', b'"earliex"')
    with pytest.raises(LatchFileError, match="the field earlier is missing"):
        decode("r", damaged)


@pytest.mark.parametrize("ahead", [-5, 0, 5])
def test_a_stop_that_no_step_served_is_newer_than_the_stop_before_it(ahead: int) -> None:
    earlier = Latch(NOW.wall_ns // 1_000_000 + ahead, 0, "anna", "stopped by anna", "stopped")
    keeper = Keeper()
    Handover(Latches(), keeper).take_stops(Latches(stop=earlier), ["joe"], NOW)
    (latches,) = keeper.given
    assert latches.stop
    assert latches.stop.number > earlier.number
    assert latches.stop.by == "joe"


def test_a_stop_that_no_step_served_is_newer_than_a_stop_that_was_released() -> None:
    """The wall clock was set back.

    The number of the released stop is one above that of `INACTIVE`.
    """
    keeper, now = Keeper(), Instant(NOW.mono_ns, NOW.wall_ns - 9 * NS_PER_S)
    life = Lifecycle(latches=Latches(inactive=INACTIVE))
    life.stop("joe", 1, Instant(1, now.wall_ns))
    assert life.latches.stop
    number = life.latches.stop.number
    life.clear(number, 2, Instant(2, now.wall_ns))
    Handover(life.latches, keeper).take_stops(life.latches, ["ann"], now)
    (latches,) = keeper.given
    assert latches.stop
    assert latches.stop.number > number


def test_without_an_unserved_stop_the_latches_are_handed_over_unchanged() -> None:
    keeper = Keeper()
    Handover(Latches(), keeper).take_stops(ALL, [], NOW)
    assert keeper.given == [ALL]


def test_a_stop_without_a_name_is_stopped_by_a_request() -> None:
    keeper = Keeper()
    Handover(Latches(), keeper).take_stops(Latches(), [""], NOW)
    assert keeper.given[0].stop
    assert keeper.given[0].stop.why == reason("stopped", by=NAMELESS).text


def test_at_shutdown_the_handover_waits_for_the_keeper_up_to_the_answer_timeout() -> None:
    keeper = Keeper()
    handover = Handover(ALL, keeper)
    handover.wait()
    assert keeper.waits == [(ALL, MAX_ANSWER_DELAY_NS / NS_PER_S)]


def test_the_handover_reports_the_events_and_the_trouble_of_the_keeper() -> None:
    handover = Handover(Latches(), keeper := Keeper())
    assert handover.take_events() == keeper.take_events()
    assert handover.trouble == keeper.trouble


def test_without_a_keeper_the_handover_never_waits_and_reports_no_trouble() -> None:
    handover = Handover(Latches(), None)
    handover.take(ALL)
    handover.wait()
    assert handover.is_stored
    assert handover.take_events() == []
    assert handover.trouble is None

"""acsard reads back a robot that it pickled, and refuses other pickles without any effect."""

from __future__ import annotations

import io
import json
import pickle
import pickletools
import resource
import subprocess
import sys
from collections import Counter, deque

import msgspec
import pytest

from acsard.core.guard import Memory
from acsard.core.motion.modes import Mode
from acsard.core.values import Twist
from acsard.recording.state import DISPATCH_TABLE, Frozen, freeze, part_class, thaw
from acsard.recording.unpickling import (
    MAX_BYTES,
    MAX_DEPTH,
    MAX_KEY,
    MAX_OPCODES,
    MAX_PARTS,
    MAX_TUPLE_KEY,
    unpickle,
)
from tests.each import each
from tests.recordings.__main__ import CHECKED
from tests.scenarios.taped import drive_through_faults, recorded_world
from tests.unit.recording.attacks import ATTACKS, doubled, whole

BYTES = 2 << 30

PROCESSOR_S = 10
"""Limit on the processor time of all attacks together, s. They take about a second. Without the
limit on tuples as keys, one attack alone takes longer than this limit."""


def limits() -> None:
    resource.setrlimit(resource.RLIMIT_AS, (BYTES, BYTES))
    resource.setrlimit(resource.RLIMIT_CPU, (PROCESSOR_S, PROCESSOR_S))


@pytest.fixture(scope="module")
def said() -> dict[str, str]:
    """Return the refusal of each attack.

    The refusal is empty if the attack was read or had an effect.
    """
    done = subprocess.run(
        [sys.executable, "-m", "tests.unit.recording.attacks"],
        capture_output=True, text=True, check=True, preexec_fn=limits,
    )  # fmt: skip
    words: dict[str, str] = json.loads(done.stdout)
    return words


@pytest.mark.slow
@each("name", ATTACKS)
def test_an_attack_is_refused_with_a_message_and_has_no_effect(
    name: str, said: dict[str, str]
) -> None:
    words = said[name]
    assert "the recorded state of the robot" in words
    assert words.isprintable()
    assert len(words) < 300


@each(
    "value",
    [
        None, True, -(1 << 90), 1.5, "text", "t" * 300, b"bytes", b"b" * 300, (), (1,),
        (1, 2, 3, 4), [1, [2, 3]], {"a": 1, 2: (3,), (1, 2): None}, {1, 2},
        frozenset({"a"}), [*range(3000)], Counter(a=2), deque([1, 2], 3), deque(["a"]),
        Mode.DRIVING, Twist(0.5, 1.0),
    ],
)  # fmt: skip
def test_a_value_is_read_back_unchanged(value: object) -> None:
    again = unpickle(pickled(value), part_class)
    assert again == value
    assert type(again) is type(value)
    assert getattr(again, "maxlen", None) == getattr(value, "maxlen", None)


def pickled(value: object) -> bytes:
    class Pickler(pickle.Pickler):
        dispatch_table = DISPATCH_TABLE

    written = io.BytesIO()
    Pickler(written, 5).dump(value)
    return written.getvalue()


def test_a_part_that_occurs_twice_stays_one_object() -> None:
    inner = [1]
    again = unpickle(pickled((inner, [inner])), part_class)
    assert isinstance(again, tuple)
    assert again[0] is again[1][0]


@each("key", [(1, MAX_TUPLE_KEY), (-1, 1), (1, 0.5), (1, (2,)), (1, 2, 3, 4, 5)])
def test_a_tuple_whose_hash_could_be_forged_is_refused_as_a_key(key: object) -> None:
    unpickle(pickled([key]), part_class)
    with pytest.raises(ValueError, match="uses a tuple as a key"):
        unpickle(pickled({key: 1}), part_class)


@each("sign", [1, -1])
def test_a_number_is_refused_as_a_key_if_its_hash_could_be_forged(sign: int) -> None:
    unpickle(pickled({sign * (MAX_KEY - 1): 1}), part_class)
    with pytest.raises(ValueError, match=r"a magnitude of 2\^61 - 1 or more as a key"):
        unpickle(pickled({sign * MAX_KEY: 1}), part_class)


def test_nesting_is_limited_in_depth_and_doubling_in_size() -> None:
    def nested(times: int) -> bytes:
        return whole(pickle.EMPTY_TUPLE + pickle.TUPLE1 * times)

    unpickle(nested(MAX_DEPTH), part_class)
    with pytest.raises(ValueError, match="deep"):
        unpickle(nested(MAX_DEPTH + 1), part_class)
    most = MAX_PARTS.bit_length() - 2
    unpickle(whole(doubled(most)), part_class)
    with pytest.raises(ValueError, match="than the state of any real robot"):
        unpickle(whole(doubled(most + 1)), part_class)


@pytest.mark.slow
def test_the_largest_robot_is_within_the_limits() -> None:
    tape, world = recorded_world(CHECKED, every=100)
    drive_through_faults(world, 1.0)
    for number in range(40):
        world.send(0.1, source=f"somebody-{number}")
        world.run(0.02)
    states = [*tape.states.values(), freeze(world.loop.robot, Memory())]
    for data in states:
        assert 8 * len(data) < MAX_BYTES
        rest = msgspec.msgpack.decode(data, type=Frozen).rest
        assert 8 * sum(1 for _ in pickletools.genops(rest)) < MAX_OPCODES
        state = thaw(data)
        assert freeze(*state) == freeze(*thaw(freeze(*state)))

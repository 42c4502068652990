"""Hostile content for the robot state in a recording.

`python -m tests.unit.recording.attacks` reads each attack and prints the refusals as JSON. The
caller must limit the time and memory of this process. An attack fails the test if it hangs or uses
all of the memory.
"""

from __future__ import annotations

import copyreg
import json
import os
import pickle
import struct
import sys

import msgspec

from acsard.core.config.settings import Config
from acsard.core.guard import Memory
from acsard.core.robot import Robot
from acsard.recording.state import LAYOUT, PICKLE_PROTOCOL, Frozen, StateError, thaw
from acsard.recording.unpickling import MAX_BYTES, MAX_KEY, MAX_OPCODES

EXTENSION = 201


def text(words: str) -> bytes:
    """Return a pickled short string."""
    data = words.encode()
    return pickle.SHORT_BINUNICODE + bytes([len(data)]) + data


def named(module: str, name: str) -> bytes:
    """Return the pickled reference to a class or any other object with that name."""
    return text(module) + text(name) + pickle.STACK_GLOBAL


def whole(body: bytes) -> bytes:
    """Return a complete pickle: this content between the first and the last opcode."""
    return pickle.PROTO + bytes([PICKLE_PROTOCOL]) + body + pickle.STOP


def state_with(rest: bytes) -> bytes:
    """Return the state of a new robot with this pickle of the parts that are not plain data."""
    return msgspec.msgpack.encode(Frozen(Config(), Memory(), {}, rest, LAYOUT))


def doubled(times: int) -> bytes:
    """Return nested tuples in which each level contains the next one twice."""
    levels = [pickle.BINGET + bytes([n]) + b"\x86\x94" for n in range(times)]
    return pickle.EMPTY_TUPLE + pickle.MEMOIZE + b"".join(levels)


def counted_again(keys: int, times: int) -> bytes:
    """Return a large dict, and `times` objects of `Counter` that are made from it."""
    pairs = b"".join(pickle.BININT + struct.pack("<i", key) + ONE for key in range(keys))
    argument = pickle.EMPTY_DICT + pickle.MARK + pairs + pickle.SETITEMS + pickle.TUPLE1
    made = (pickle.BINGET + b"\x00" + pickle.BINGET + b"\x01" + pickle.REDUCE) * times
    return pickle.MARK + COUNTER + pickle.MEMOIZE + argument + pickle.MEMOIZE + made + pickle.TUPLE


def of_one_hash(keys: int) -> bytes:
    """Return a dict whose keys all have one hash.

    Python must compare each key with all others.
    """
    pairs = (pickle.LONG1 + b"\x0c" + (key * MAX_KEY).to_bytes(12, "little") for key in range(keys))
    return pickle.EMPTY_DICT + pickle.MARK + ONE.join(pairs) + ONE + pickle.SETITEMS


def tuples_of_one_hash(keys: int) -> bytes:
    """Return a dict whose keys are pairs of numbers that all have one hash on a 64-bit machine.

    The hash of a tuple is xxHash without a secret key. An attacker can therefore compute the second
    number of a pair from the first number and the wanted hash.
    """
    pairs, first, inverse = bytearray(), 0, pow(XXHASH_PRIME_2, -1, 1 << 64)
    while keys:
        first += 1
        accumulator = _rotated(XXHASH_PRIME_5 + first * XXHASH_PRIME_2) * XXHASH_PRIME_1
        second = (0x2BDC545D6B4B87 - accumulator) * inverse % (1 << 64)
        if second < MAX_KEY:
            numbers = [number.to_bytes(8, "little") for number in (first, second)]
            pairs += b"".join([pickle.LONG1 + b"\x08" + number for number in numbers])
            pairs += pickle.TUPLE2 + pickle.NONE
            keys -= 1
    return pickle.EMPTY_DICT + pickle.MARK + bytes(pairs) + pickle.SETITEMS


XXHASH_PRIME_1, XXHASH_PRIME_2 = 11400714785074694791, 14029467366897019727
XXHASH_PRIME_5 = 2870177450012600261


def _rotated(lane: int) -> int:
    lane %= 1 << 64
    return (lane << 31 | lane >> 33) % (1 << 64)


def attributes(*pairs: tuple[bytes, bytes]) -> bytes:
    """Return the opcodes that set these attributes on the object on top of the pickle's stack."""
    inside = b"".join([key + value for key, value in pairs])
    return pickle.EMPTY_DICT + pickle.MARK + inside + pickle.SETITEMS + pickle.BUILD


NOTHING = pickle.EMPTY_TUPLE
ROBOT = named("acsard.core.robot", "Robot")
BARE = ROBOT + NOTHING + pickle.NEWOBJ
TWIST = named("acsard.core.values", "Twist")
MODE = named("acsard.core.motion.modes", "Mode")
DEQUE, COUNTER = named("collections", "deque"), named("collections", "Counter")
ONE = pickle.BININT1 + b"\x01"
NUMBER = struct.Struct("<Q")

BODIES: dict[str, bytes] = {
    # attacks without an end
    "tuples in tuples": NOTHING + pickle.TUPLE1 * 100_000,
    "lists in lists": pickle.EMPTY_LIST * 50_000 + pickle.APPEND * 49_999,
    "parts in parts": (BARE + pickle.EMPTY_DICT + text("a")) * 2000
    + pickle.NONE + (pickle.SETITEM + pickle.BUILD) * 2000,
    "a list in itself": pickle.EMPTY_LIST + b"\x94\x94" + pickle.BINGET + b"\x00" + pickle.APPEND,
    "a robot in itself": BARE + b"\x94" + attributes((text("session"), pickle.BINGET + b"\x00")),
    "what doubles": doubled(48),
    "a key that doubles": pickle.EMPTY_DICT + doubled(48) + pickle.NONE + pickle.SETITEM,
    "an element that doubles": pickle.EMPTY_SET + b"(" + doubled(48) + pickle.ADDITEMS,
    "elements that double": b"(" + doubled(48) + pickle.FROZENSET,
    "a mode that doubles": MODE + doubled(48) + pickle.TUPLE1 + pickle.REDUCE,
    "parts without end": pickle.NONE * MAX_OPCODES + NOTHING,
    "bytes without end": pickle.BINBYTES + struct.pack("<I", MAX_BYTES) + bytes(MAX_BYTES),
    "a number of 200 bytes": pickle.LONG1 + b"\xc8" + bytes(199) + b"\x7f",
    "a number of 100 000 bytes": pickle.LONG4 + struct.pack("<i", 100_000) + b"\x7f" * 100_000,
    "a number in 4000 figures": pickle.INT + b"9" * 4000 + b"\n",
    "a number in 100 000 figures": pickle.INT + b"9" * 100_000 + b"\n",
    "a long one in figures": pickle.LONG + b"9" * 4000 + b"L\n",
    "a text of an exabyte": pickle.BINUNICODE8 + NUMBER.pack(1 << 60),
    "bytes of an exabyte": pickle.BINBYTES8 + NUMBER.pack(1 << 60),
    "a buffer of an exabyte": pickle.BYTEARRAY8 + NUMBER.pack(1 << 60),
    "a buffer of a gigabyte": pickle.BYTEARRAY8 + NUMBER.pack(1 << 30),
    "a frame of an exabyte": pickle.FRAME + NUMBER.pack(1 << 60) + NOTHING,
    "a billion things to remember": NOTHING + pickle.LONG_BINPUT + struct.pack("<I", 1 << 30),
    "an old text": pickle.STRING + b"x" * 100_000 + b"\n",
    "a deque without room": DEQUE + NOTHING + pickle.LONG1 + b"\x0a" + b"\x7f" * 10 + b"\x86R",
    # attacks that run code
    "a call": named("os", "system") + text("true") + pickle.TUPLE1 + pickle.REDUCE,
    "an old call": b"cos\nsystem\n" + text("true") + pickle.TUPLE1 + pickle.REDUCE,
    "an older call": b"(" + text("true") + b"ios\nsystem\n",
    "the oldest call": b"(" + named("os", "system") + text("true") + pickle.OBJ,
    "a call by number": pickle.EXT1 + bytes([EXTENSION]) + text("true") + b"\x85R",
    "a call by a long number": pickle.EXT4 + struct.pack("<i", EXTENSION) + text("true") + b"\x85R",
    "a builtin": named("builtins", "getattr"),
    "str": named("builtins", "str") + ONE + pickle.TUPLE1 + pickle.REDUCE,
    "object": named("builtins", "object") + NOTHING + pickle.NEWOBJ,
    "what copyreg makes": named("copyreg", "_reconstructor"),
    "a thing by its name": text("acsard.core.robot.Robot") + pickle.PERSID + b"Robot\n",
    "a thing by what says it": text("Robot") + pickle.BINPERSID,
    "a buffer from outside": pickle.NEXT_BUFFER,
    "one that is read only": NOTHING + pickle.READONLY_BUFFER,
    "a method": named("acsard.core.robot", "Robot.hear"),
    "what a room has imported": named("acsard.core.robot", "Counter"),
    "a room's builtins": named("acsard.core.robot", "__builtins__"),
    "a function of a room": named("acsard.core.motion.arbiter_text", "chosen"),
    "another room": named("acsard.host.atomic_file", "replace"),
    "a room that is not loaded": named("acsard.core.link.serial_output", "Port"),
    "a room that is none": named("acsard.core.motion.none", "None"),
    "colours": named("\x1b[31mred", "\x1b]0;title\x07"),
    "an error": named("acsard.core.values", "AcsardError") + NOTHING + pickle.NEWOBJ,
    "an error that is called": named("acsard.core.values", "AcsardError") + NOTHING + pickle.REDUCE,
    # other objects
    "a class that is changed": ROBOT + pickle.NONE
    + pickle.EMPTY_DICT + text("step") + ONE + pickle.SETITEM + pickle.TUPLE2 + pickle.BUILD,
    "a class that gets attributes": ROBOT + attributes((text("step"), ONE)),
    "a class where a value should be": ROBOT + pickle.TUPLE1,
    "a class alone": ROBOT,
    "a robot that is run": ROBOT + ONE + pickle.TUPLE1 + pickle.REDUCE,
    "a robot of something": ROBOT + ONE + pickle.TUPLE1 + pickle.NEWOBJ,
    "a robot by name": ROBOT + NOTHING + pickle.EMPTY_DICT + pickle.NEWOBJ_EX,
    "a struct of nothing": TWIST + NOTHING + pickle.NEWOBJ,
    "a struct of words": TWIST + text("fast") + pickle.TUPLE1 + pickle.REDUCE,
    "a struct of too much": TWIST + ONE + ONE + ONE + pickle.TUPLE3 + pickle.REDUCE,
    "a struct that gets attributes": TWIST + NOTHING + b"R" + attributes((text("x"), ONE)),
    "a mode that there is not": MODE + text("flying") + pickle.TUPLE1 + pickle.REDUCE,
    "a counter of a list": COUNTER + pickle.EMPTY_LIST + pickle.TUPLE1 + pickle.REDUCE,
    "a deque of a text": DEQUE + text("abc") + pickle.TUPLE1 + pickle.REDUCE,
    "a hidden method": BARE + attributes((text("step"), ONE)),
    "another class": BARE + attributes((text("__class__"), ONE)),
    "attributes without a name": BARE + attributes((ONE, ONE)),
    "attributes that are none": BARE + ONE + pickle.BUILD,
    "attributes beside others": BARE + pickle.EMPTY_DICT + pickle.EMPTY_DICT + b"\x86b",
    "a number with attributes": ONE + attributes((text("a"), ONE)),
    "a list as a key": pickle.EMPTY_DICT + pickle.EMPTY_LIST + ONE + pickle.SETITEM,
    "a robot as a key": pickle.EMPTY_DICT + BARE + ONE + pickle.SETITEM,
    "keys in a tuple": NOTHING + ONE + ONE + pickle.SETITEM,
    "a longer tuple": NOTHING + ONE + pickle.APPEND,
    # bytes that are not a pickle
    "nothing on the stack": b"",
    "two on the stack": ONE + ONE,
    "a mark that stays": pickle.MARK + ONE,
    "no mark": ONE + pickle.TUPLE,
    "an empty stack": pickle.TUPLE2,
    "nothing to remember": pickle.MEMOIZE,
    "nothing remembered": pickle.BINGET + b"\x09",
    "a key too much": pickle.EMPTY_DICT + pickle.MARK + ONE + pickle.SETITEMS,
    "a text that is none": pickle.SHORT_BINUNICODE + b"\x01\xff",
    "an opcode that there is not": b"\xff",
    "another one behind its end": ONE + pickle.STOP + ONE,
    # values
    "a number": ONE,
    "two numbers": ONE + ONE + pickle.TUPLE2,
    "a robot and no line": BARE + ONE + pickle.TUPLE2,
}  # fmt: skip

ATTACKS = {name: whole(body) for name, body in BODIES.items()} | {
    "one dict copied again and again": whole(counted_again(18_000, 28_000)),
    "keys of one hash": whole(of_one_hash(40_000)),
    "pairs of one hash": whole(tuples_of_one_hash(30_000)),
    "nothing": b"",
    "the first half": pickle.dumps(list(range(50)), PICKLE_PROTOCOL)[:60],
}


def main() -> None:
    copyreg.add_extension("os", "system", EXTENSION)
    errors, hear, modules = {}, Robot.hear, set(sys.modules)
    ran: list[str] = []
    os.system = ran.append  # type: ignore[assignment]
    for name, data in ATTACKS.items():
        try:
            thaw(state_with(data))
            errors[name] = ""
        except StateError as error:
            errors[name] = str(error)
        if ran or Robot.hear is not hear or set(sys.modules) - modules:
            errors[name], modules = "", set(sys.modules)
            ran.clear()
    print(json.dumps(errors))


if __name__ == "__main__":
    main()

"""Rebuilds a pickled `Robot` safely, even if an attacker forged the bytes.

Python's unpickler calls functions, imports modules, changes classes and nests without limit. A list
of allowed classes in `find_class` is not enough: forged bytes then took 3 s (nested tuples, equal
hashes, copies of a dict) or 2 GB, or changed the robot's class. This executes only opcodes that
occur, constructs only plain data and Structs of the declared types, gives other objects attributes
that hide none of the class, and limits depth and size. A part that is referred to no longer grows,
so none contains itself.
"""

from __future__ import annotations

import pickletools
from collections import Counter, deque
from collections.abc import Callable, Sequence
from enum import Enum
from typing import Any

import msgspec
from msgspec import Struct

MAX_BYTES = 1 << 20  # usually 12 000 to 40 000, more with many senders

MAX_OPCODES = 1 << 17

MAX_PARTS = 1 << 19  # values, each time that they occur

# In total, or a few bytes could copy a large value again and again.
MAX_COPIED_PARTS = 4 * MAX_PARTS

# Bound of an integer as a key: smaller ones but -1 are their own hash, so no keys have forged equal
# ones.
MAX_KEY = 2**61 - 1

MAX_DEPTH = 50

MAX_INT_BITS = 128  # sums of times in ns have more than 64

MAX_KEY_PARTS = 4  # elements of a tuple as a key

# Python hashes tuples of integers without a secret. Below this there are 2^32 of four, and almost
# none with equal hashes.
MAX_TUPLE_KEY = 256

FindClass = Callable[[str, str], type]  # by module and name; raises `ValueError`

# Types of dict keys and set elements, beside members of an Enum and short tuples.
KEY_TYPES = (str, int, float, bool, bytes, type(None))


def unpickle(data: bytes, find: FindClass) -> object:
    """Return the object that a pickle describes; its bytes may be forged. Raises `ValueError`."""
    if len(data) > MAX_BYTES:
        raise _forged(f"the robot state has {len(data)} bytes, more than any real robot needs")
    machine = _Machine(find)
    at = -1
    try:
        for count, (opcode, argument, place) in enumerate(pickletools.genops(data)):
            if count >= MAX_OPCODES:
                raise _forged(
                    "the robot state has more instructions than the state of any real robot"
                )
            machine.do(opcode.name, argument)
            at = place or 0
    except (LookupError, TypeError, ArithmeticError, msgspec.MsgspecError) as error:
        raise ValueError(f"the robot state is damaged: {error}") from None
    if at + 1 != len(data):
        raise ValueError("there is data after the end of the robot state")
    return machine.result()


def _forged(what: str) -> ValueError:
    return ValueError(f"{what}: the file is damaged or forged")


class _Entry:
    # A value on the stack, with its depth and its number of values.
    __slots__ = ("closed", "depth", "size", "value")

    def __init__(self, value: Any) -> None:
        self.value = value
        self.depth = 0
        self.size = 1
        self.closed = False  # fetched from the memo, so it must not grow

    def holds(self, parts: Sequence[_Entry]) -> None:
        """Update depth and size for `parts` to be added. Raises `ValueError`."""
        if self.closed:
            raise _forged("a part of the robot state contains itself, or grows after it was used")
        for part in parts:
            if isinstance(part.value, type):
                raise _forged("the robot state has a class where a value should be")
            self.depth = max(self.depth, 1 + part.depth)
            self.size += part.size
        if self.depth > MAX_DEPTH:
            raise ValueError(
                "the file is damaged or forged: the robot state has values that are nested deeper "
                f"than {MAX_DEPTH}"
            )
        if self.size > MAX_PARTS:
            raise _forged("the robot state has more values than the state of any real robot")


class _Machine:
    def __init__(self, find: FindClass) -> None:
        self._find = find
        self._stack: list[_Entry] = []
        self._marks: list[int] = []  # height of the stack at each open `MARK`
        self._memo: list[_Entry] = []
        self._copied = 0  # values so far

    def result(self) -> object:
        if len(self._stack) != 1 or self._marks:
            raise ValueError("the robot state is damaged: its data ends too early")
        return self._stack[0].value

    def do(self, name: str, argument: Any) -> None:
        """Execute an opcode; damaged operands may raise what `unpickle` converts."""
        match name:  # the most frequent opcodes come first
            case "MEMOIZE":
                self._memo.append(self._stack[-1])
            case "BINGET" | "LONG_BINGET":
                entry = self._memo[argument]
                entry.closed = True
                self._stack.append(entry)
            case (
                "BININT" | "BININT1" | "BININT2" | "LONG1" | "BINFLOAT" | "SHORT_BINUNICODE"
                | "BINUNICODE" | "SHORT_BINBYTES" | "BINBYTES"
            ):  # fmt: skip
                if type(argument) is int and argument.bit_length() > MAX_INT_BITS:
                    raise _forged(
                        f"the robot state has a number of {argument.bit_length()} bits, too large "
                        "for a real robot"
                    )
                self._push(argument)
            case "NONE":
                self._push(None)
            case "NEWTRUE" | "NEWFALSE":
                self._push(name == "NEWTRUE")
            case "EMPTY_TUPLE":
                self._push(())
            case "EMPTY_LIST":
                self._push([])
            case "EMPTY_DICT":
                self._push({})
            case "EMPTY_SET":
                self._push(set())
            case "TUPLE1" | "TUPLE2" | "TUPLE3":
                self._push_of(tuple, self._top(int(name[-1])))
            case "MARK":
                self._marks.append(len(self._stack))
            case "TUPLE":
                self._push_of(tuple, self._marked())
            case "FROZENSET":
                parts = self._marked()
                _keys(parts)
                self._push_of(frozenset, parts)
            case "APPEND":
                self._append(self._top(1))
            case "APPENDS":
                self._append(self._marked())
            case "SETITEM":
                self._set_items(self._top(2))
            case "SETITEMS":
                self._set_items(self._marked())
            case "ADDITEMS":
                self._add_to_set(self._marked())
            case "STACK_GLOBAL":
                self._find_class()
            case "REDUCE":
                self._construct()
            case "NEWOBJ":
                self._make_bare()
            case "BUILD":
                self._set_attributes()
            case "PROTO" | "FRAME" | "STOP":
                pass
            case _:
                raise _forged(
                    f"the robot state has the pickle opcode {name}, which this acsard never writes"
                )

    def _push(self, value: object) -> None:
        self._stack.append(_Entry(value))

    def _push_of(self, kind: type, parts: list[_Entry]) -> None:
        entry = _Entry(None)
        entry.holds(parts)
        entry.value = kind([part.value for part in parts])
        self._stack.append(entry)

    def _top(self, count: int) -> list[_Entry]:
        if len(self._stack) < count:
            raise IndexError("an instruction takes more values than there are on the stack")
        entries = self._stack[-count:]
        del self._stack[-count:]
        return entries

    def _marked(self) -> list[_Entry]:
        mark = self._marks.pop()
        entries = self._stack[mark:]
        del self._stack[mark:]
        return entries

    def _copies(self, entry: _Entry) -> None:
        self._copied += entry.size
        if self._copied > MAX_COPIED_PARTS:
            raise _forged("the robot state copies more values than the state of any real robot")

    def _append(self, parts: list[_Entry]) -> None:
        whole = self._stack[-1]
        if type(whole.value) not in (list, deque):
            raise TypeError("an instruction appends to an object that is not a list")
        whole.holds(parts)
        whole.value.extend([part.value for part in parts])

    def _set_items(self, parts: list[_Entry]) -> None:
        whole, keys, values = self._stack[-1], parts[::2], parts[1::2]
        if type(whole.value) is not dict:
            raise TypeError("an instruction sets keys of an object that is not a dict")
        _keys(keys)
        whole.holds(parts)
        pairs = zip(keys, values, strict=True)
        whole.value.update({key.value: value.value for key, value in pairs})

    def _add_to_set(self, parts: list[_Entry]) -> None:
        whole = self._stack[-1]
        if not isinstance(whole.value, set):
            raise TypeError("an instruction adds elements to an object that is not a set")
        _keys(parts)
        whole.holds(parts)
        whole.value.update([part.value for part in parts])

    def _find_class(self) -> None:
        module, name = [entry.value for entry in self._top(2)]
        if not isinstance(module, str) or not isinstance(name, str):
            raise TypeError("an instruction names a class with a value that is not a text")
        self._push(self._find(module, name))

    def _construct(self) -> None:
        kind, arguments = self._top(2)
        if not isinstance(kind.value, type) or not isinstance(arguments.value, tuple):
            raise TypeError(
                "an instruction calls an object that is not a class, or calls a class without a "
                "tuple of arguments"
            )
        entry = _Entry(None)
        entry.holds([arguments])
        self._copies(arguments)
        entry.value = _construct(kind.value, arguments.value)
        self._stack.append(entry)

    def _make_bare(self) -> None:
        kind, arguments = self._top(2)
        if not isinstance(kind.value, type) or arguments.value != ():
            raise TypeError(
                "an instruction makes an object of a value that is not a class, or makes an object "
                "with arguments, which acsard never writes"
            )
        if not _is_part(kind.value):
            raise ValueError(f"{kind.value.__name__} cannot be constructed without values")
        self._push(object.__new__(kind.value))

    def _set_attributes(self) -> None:
        # The object is one that `_make_bare` has made.
        (state,) = self._top(1)
        whole, named = self._stack[-1], state.value
        if not _is_part(type(whole.value)) or not isinstance(named, dict):
            raise _forged(
                f"the robot state sets attributes of a {type(whole.value).__name__}, which this "
                "acsard never writes"
            )
        for name in named:
            if not isinstance(name, str) or hasattr(type(whole.value), name):
                raise ValueError(
                    f"the robot state replaces the attribute {name!r:.50} of the class "
                    f"{type(whole.value).__name__}"
                )
        whole.holds([state])
        self._copies(state)
        vars(whole.value).update(named)


def _keys(entries: Sequence[_Entry]) -> None:
    # Raises `ValueError` for keys that are not hashable, slow to hash, or of forgeable equal
    # hashes.
    for entry in entries:
        value = entry.value
        if type(value) is tuple:
            if len(value) > MAX_KEY_PARTS or not all(map(_is_tuple_key_part, value)):
                raise ValueError(
                    "the robot state uses a tuple as a key, and the tuple has more than "
                    f"{MAX_KEY_PARTS} parts, or a part that is neither a text nor a small number; "
                    "acsard never writes such a key"
                )
        elif type(value) not in KEY_TYPES and not isinstance(value, Enum):
            raise ValueError(
                f"the robot state uses a {type(value).__name__} as a key of a dictionary or as an "
                "element of a set, which this version of acsard never writes"
            )
        elif type(value) is int and abs(value) >= MAX_KEY:
            raise ValueError(
                "the robot state uses a number with a magnitude of 2^61 - 1 or more as a key, "
                "which acsard never writes"
            )


def _is_tuple_key_part(part: object) -> bool:
    return type(part) is str or (type(part) is int and 0 <= part < MAX_TUPLE_KEY)


def _is_part(kind: Any) -> bool:
    # From attributes alone, without any method.
    plain = kind.__new__ is object.__new__ and kind.__reduce_ex__ is object.__reduce_ex__
    return plain and kind.__module__ != "builtins" and not hasattr(kind, "__setstate__")


def _construct(kind: type, arguments: tuple[Any, ...]) -> object:
    # Raises `ValueError`, or what the class raises.
    match arguments:
        case (dict(),) if kind is Counter:
            return Counter(*arguments)
        case () | ((), None | int()) if kind is deque:
            return deque(*arguments)
        case (str() | int() as value,) if issubclass(kind, Enum):
            return kind(value)
        case _ if issubclass(kind, Struct):
            made = kind(*arguments)
            # A constructor of a Struct does not check the types of its arguments. `convert` does.
            msgspec.convert({name: getattr(made, name) for name in kind.__struct_fields__}, kind)
            return made
    raise ValueError(f"{kind.__name__} cannot be constructed from these values")

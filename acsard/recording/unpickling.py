"""Rebuilds a pickled robot, and nothing else, even if a stranger wrote the bytes.

A recording may come from a stranger, and Python's own unpickler obeys its bytes: it calls
functions, imports modules, changes classes and nests without bound. This reader knows only the
opcodes that a pickled robot consists of. It calls only constructors of plain data, and checks each
part when it is made:

    a number, text, bytes    a number has at most 128 bits
    a list, a tuple ...      depth and size are bounded; a part that occurs twice counts twice
    a Struct                 each field has the type that the Struct declares
    another part             made without a call of its code, then given attributes; none of them
                             hides an attribute of its class

A list of allowed classes in `Unpickler.find_class` is not enough. With the list of `state`, nested
tuples as keys, keys of one hash and copies of one dict ran past 3 s of processor time, a few bytes
asked for more than 2 GB, and an attack changed the class of the robot for the whole process. The
commands that read a recording are such processes, and not bounded children.

A part that has been referred to cannot grow any more. Therefore, no part contains itself, and the
depth and the size are exact.
"""

from __future__ import annotations

import pickletools
from collections import Counter, deque
from collections.abc import Callable, Sequence
from enum import Enum
from typing import Any

import msgspec
from msgspec import Struct

MOST_BYTES = 1 << 20
"""Largest size of a pickled robot. One takes 12 000 to 40 000 bytes, and a few times as much
with many command senders.
"""

MOST_OPCODES = 1 << 17

MOST_PARTS = 1 << 19
"""Largest number of values in a robot. A value that occurs several times counts each time."""

MOST_COPIED = 4 * MOST_PARTS
"""Largest number of values copied while parts are made. A few bytes can ask for copies of the
same part again and again.
"""

HASHED = 2**61 - 1
"""Bound of the integers used as keys. Below it, Python gives each integer a hash of its own, so
forged keys cannot collide.
"""

DEEPEST = 50
"""Largest nesting depth."""

LONGEST = 128
"""Largest number of bits of an integer. Sums over times in ns have more than 64."""

MOST_IN_KEY = 4

Find = Callable[[str, str], type]
"""Function that returns the class of a module and a name. It raises `ValueError` for a class
that a robot does not consist of.
"""

ARGUMENTS = {
    "BININT", "BININT1", "BININT2", "LONG1", "BINFLOAT", "SHORT_BINUNICODE", "BINUNICODE",
    "SHORT_BINBYTES", "BINBYTES",
}  # fmt: skip
"""Opcodes that push their argument."""

VALUES = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False, "EMPTY_TUPLE": ()}

CONTAINERS: dict[str, type] = {"EMPTY_LIST": list, "EMPTY_DICT": dict, "EMPTY_SET": set}

TUPLES = {"TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}

SIMPLE = (str, int, float, bool, bytes, type(None))


def unpickled(data: bytes, find: Find) -> object:
    """Return the object that the bytes describe.

    Raises `ValueError` with a reason if it is not a robot's.
    """
    if len(data) > MOST_BYTES:
        raise ValueError(f"it has {len(data)} bytes, more than any robot")
    machine = _Machine(find)
    at = -1
    try:
        for count, (opcode, argument, place) in enumerate(pickletools.genops(data)):
            if count >= MOST_OPCODES:
                raise ValueError("it has more parts than any robot")
            machine.do(opcode.name, argument)
            at = place or 0
    except (LookupError, TypeError, ArithmeticError, msgspec.MsgspecError) as error:
        raise ValueError(f"it is damaged: {error}") from None
    if at + 1 != len(data):
        raise ValueError("there is data after its end")
    return machine.result()


class _Entry:
    """A value on the stack, with its depth and its size."""

    __slots__ = ("closed", "depth", "size", "value")

    def __init__(self, value: Any) -> None:
        self.value = value
        self.depth = 0
        self.size = 1
        self.closed = False
        """True once the value has been referred to. It cannot grow any more."""

    def holds(self, parts: Sequence[_Entry]) -> None:
        """Add the depth and size of new parts to the container.

        Raises `ValueError` if a bound is exceeded.
        """
        if self.closed:
            raise ValueError("a part of it contains itself, or grows while it is built")
        for part in parts:
            if isinstance(part.value, type):
                raise ValueError("it has a class where a value should be")
            self.depth = max(self.depth, 1 + part.depth)
            self.size += part.size
        if self.depth > DEEPEST:
            raise ValueError(f"its parts are nested deeper than {DEEPEST}")
        if self.size > MOST_PARTS:
            raise ValueError("it has more parts than any robot")


class _Machine:
    """Pickle's virtual machine: the stack, its marks, and the memo."""

    def __init__(self, find: Find) -> None:
        self._find = find
        self._stack: list[_Entry] = []
        self._marks: list[int] = []
        self._memo: list[_Entry] = []
        self._copied = 0

    def result(self) -> object:
        """Return the only value that is left on the stack."""
        if len(self._stack) != 1 or self._marks:
            raise ValueError("it is damaged: it ends in the middle")
        return self._stack[0].value

    def do(self, name: str, argument: Any) -> None:
        """Execute one opcode; raise `ValueError`, or an exception that its operands cause."""
        if name in ARGUMENTS:
            if type(argument) is int and argument.bit_length() > LONGEST:
                raise ValueError(f"it has a number of {argument.bit_length()} bits")
            self._push(argument)
        elif name in VALUES:
            self._push(VALUES[name])
        elif name in CONTAINERS:
            self._push(CONTAINERS[name]())
        elif name in TUPLES:
            self._push_of(tuple, self._top(TUPLES[name]))
        elif name in DOES:
            DOES[name](self)
        elif name in ("BINGET", "LONG_BINGET"):
            entry = self._memo[argument]
            entry.closed = True
            self._stack.append(entry)
        else:
            raise ValueError(f"it has the opcode {name}, which the state of a robot never contains")

    def _push(self, value: object) -> _Entry:
        entry = _Entry(value)
        self._stack.append(entry)
        return entry

    def _push_of(self, kind: type, parts: list[_Entry]) -> None:
        """Push a container that is made at once."""
        entry = _Entry(None)
        entry.holds(parts)
        entry.value = kind([part.value for part in parts])
        self._stack.append(entry)

    def _top(self, count: int) -> list[_Entry]:
        """Pop the last `count` values."""
        if len(self._stack) < count:
            raise IndexError("its stack is empty")
        taken = self._stack[-count:]
        del self._stack[-count:]
        return taken

    def _marked(self) -> list[_Entry]:
        """Pop all values behind the last mark."""
        mark = self._marks.pop()
        taken = self._stack[mark:]
        del self._stack[mark:]
        return taken

    def _copies(self, entry: _Entry) -> None:
        """Count the values that are copied to make a part."""
        self._copied += entry.size
        if self._copied > MOST_COPIED:
            raise ValueError("it has more parts than any robot")

    # The opcodes

    def proceed(self) -> None:
        """Ignore an opcode that does not touch values."""

    def mark(self) -> None:
        self._marks.append(len(self._stack))

    def memoize(self) -> None:
        self._memo.append(self._stack[-1])

    def many(self) -> None:
        self._push_of(tuple, self._marked())

    def frozen(self) -> None:
        parts = self._marked()
        _keys(parts)
        self._push_of(frozenset, parts)

    def append(self) -> None:
        self._extend(self._top(1))

    def appends(self) -> None:
        self._extend(self._marked())

    def _extend(self, parts: list[_Entry]) -> None:
        whole = self._stack[-1]
        if type(whole.value) not in (list, deque):
            raise TypeError("it appends to an object that is not a list")
        whole.holds(parts)
        whole.value.extend([part.value for part in parts])

    def item(self) -> None:
        self._update(self._top(2))

    def items(self) -> None:
        self._update(self._marked())

    def _update(self, parts: list[_Entry]) -> None:
        whole, keys, values = self._stack[-1], parts[::2], parts[1::2]
        if type(whole.value) is not dict:
            raise TypeError("it sets keys of an object that is not a dict")
        _keys(keys)
        whole.holds(parts)
        whole.value.update({key.value: one.value for key, one in zip(keys, values, strict=True)})

    def added(self) -> None:
        parts = self._marked()
        whole = self._stack[-1]
        if not isinstance(whole.value, set):
            raise TypeError("it adds elements to an object that is not a set")
        _keys(parts)
        whole.holds(parts)
        whole.value.update([part.value for part in parts])

    def found(self) -> None:
        module, name = [entry.value for entry in self._top(2)]
        if not isinstance(module, str) or not isinstance(name, str):
            raise TypeError("the name of a class is not a text")
        self._push(self._find(module, name))

    def reduced(self) -> None:
        """Make a value of a class from constructor arguments."""
        kind, given = self._top(2)
        if not isinstance(kind.value, type) or not isinstance(given.value, tuple):
            raise TypeError("it calls an object that is not a class")
        entry = _Entry(None)
        entry.holds([given])
        self._copies(given)
        entry.value = _made(kind.value, given.value)
        self._stack.append(entry)

    def bare(self) -> None:
        """Make a part without attributes, and without a call of its constructor."""
        kind, given = self._top(2)
        if not isinstance(kind.value, type) or given.value != ():
            raise TypeError(
                "it constructs an object that is not a class, or a class that needs values"
            )
        if not _is_part(kind.value):
            raise ValueError(f"{kind.value.__name__} cannot be constructed without values")
        self._push(object.__new__(kind.value))

    def built(self) -> None:
        """Set the attributes of a part."""
        (state,) = self._top(1)
        whole, named = self._stack[-1], state.value
        if not _is_part(type(whole.value)) or not isinstance(named, dict):
            raise ValueError(f"it sets attributes of a {type(whole.value).__name__}")
        for name in named:
            if not isinstance(name, str) or hasattr(type(whole.value), name):
                raise ValueError(
                    f"it sets the attribute {name!r:.50} of a {type(whole.value).__name__}"
                )
        whole.holds([state])
        self._copies(state)
        vars(whole.value).update(named)


DOES: dict[str, Callable[[_Machine], None]] = {
    "PROTO": _Machine.proceed,
    "FRAME": _Machine.proceed,
    "STOP": _Machine.proceed,
    "MARK": _Machine.mark,
    "MEMOIZE": _Machine.memoize,
    "TUPLE": _Machine.many,
    "FROZENSET": _Machine.frozen,
    "APPEND": _Machine.append,
    "APPENDS": _Machine.appends,
    "SETITEM": _Machine.item,
    "SETITEMS": _Machine.items,
    "ADDITEMS": _Machine.added,
    "STACK_GLOBAL": _Machine.found,
    "REDUCE": _Machine.reduced,
    "NEWOBJ": _Machine.bare,
    "BUILD": _Machine.built,
}


def _keys(entries: Sequence[_Entry]) -> None:
    """Refuse keys that are slow to hash, or cannot be hashed."""
    for entry in entries:
        value = entry.value
        parts = value if type(value) is tuple and len(value) <= MOST_IN_KEY else (value,)
        if not all(type(part) in SIMPLE or isinstance(part, Enum) for part in parts):
            raise ValueError(f"it uses a {type(value).__name__} as a key")
        if any(type(part) is int and abs(part) >= HASHED for part in parts):
            raise ValueError("it uses a number of more than 60 bits as a key")


def _is_part(kind: Any) -> bool:
    """Return whether an instance is its attributes alone, and is made without code of its class."""
    plain = kind.__new__ is object.__new__ and kind.__reduce_ex__ is object.__reduce_ex__
    return plain and kind.__module__ != "builtins" and not hasattr(kind, "__setstate__")


def _made(kind: type, given: tuple[Any, ...]) -> object:
    """Make a value of this class.

    Raises `ValueError` or `TypeError` if the arguments do not suit it.
    """
    match given:
        case (dict(),) if kind is Counter:
            return Counter(*given)
        case () | ((), None | int()) if kind is deque:
            return deque(*given)
        case (str() | int() as value,) if issubclass(kind, Enum):
            return kind(value)
        case _ if issubclass(kind, Struct):
            made = kind(*given)
            msgspec.convert({name: getattr(made, name) for name in kind.__struct_fields__}, kind)
            return made
    raise ValueError(f"{kind.__name__} cannot be constructed from these values")

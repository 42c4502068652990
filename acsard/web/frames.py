"""What a page or a program says on `/ws`: text -> one frame, or the reason it is refused; pure.

One JSON object a message; what it is for is told by its first field (`subscribe`, `cmd`, `call`,
...). A message that is none of these, or holds what is not meant, is refused whole.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta, Struct

from acsard.messages.signature import MOST
from acsard.values import AcsardError

MAX_BYTES = 65536
"""Of one message; a command has a hundred."""

MAX_RATE, USUAL_RATE = 50.0, 10.0
"""Messages of one key a second."""

LATEST_STAMP_MS = MOST // 1_000_000 - 86_400_000.0
"""ms since 1970: what a signature holds in ns, but for a day, since the zero of who lets go has a
later stamp than his last command."""

Short = Annotated[str, Meta(max_length=80)]
Device = Annotated[str, Meta(max_length=200)]


class FrameError(AcsardError):
    """No frame of ours; `about` is what it was meant for, as far as that can be told."""

    def __init__(self, about: str, text: str) -> None:
        super().__init__(text)
        self.about = about


class _Frame(Struct, frozen=True, forbid_unknown_fields=True):
    """Base of all."""


class Subscribe(_Frame, frozen=True):
    """Send the messages of a key from now on, at most `rate` a second."""

    subscribe: Short
    rate: float = USUAL_RATE
    robot: Short = ""


class Unsubscribe(_Frame, frozen=True):
    """No more of them."""

    unsubscribe: Short
    robot: Short = ""


class Wish(_Frame, frozen=True):
    """A twist: m/s and rad/s."""

    linear_x: float
    angular_z: float


class Command(_Frame, frozen=True):
    """Drive so; `stamp` is when that was meant, in ms by the sender's own clock."""

    cmd: Wish
    stamp: float
    steady: bool = False
    """Nobody adjusts the clock of `stamp`, as the browser's `performance.now()`."""

    @property
    def stamp_ns(self) -> int:
        """The same in ns."""
        return int(self.stamp * 1e6)

    @property
    def moves(self) -> bool:
        """It is no zero."""
        return self.cmd.linear_x != 0.0 or self.cmd.angular_z != 0.0


class Call(_Frame, frozen=True):
    """Call a service of the robot; the answer carries `id`."""

    call: Short
    id: int | Short = 0
    payload: dict[str, Any] = {}
    robot: Short = ""


class Ping(_Frame, frozen=True):
    """Answered with the same number."""

    ping: float


class Begin(_Frame, frozen=True):
    """Check the board at `port`, or calibrate by a `way`, "" for the usual one."""

    begin: Literal["check", "calibrate"]
    port: Device = ""
    way: Short = ""
    positions: Short = ""
    """The key they come on, with that way."""


class Reply(_Frame, frozen=True):
    """The answer to the question of this number, of what was begun; none is what is usual."""

    reply: Annotated[int, Meta(ge=0, le=1 << 31)]
    value: float | Short | None = None


class Press(_Frame, frozen=True):
    """A key at the terminal of what was begun, or Ctrl-C."""

    press: Literal["key", "leave"]


Frame = Subscribe | Unsubscribe | Command | Call | Ping | Begin | Reply | Press

KINDS: dict[str, type[Frame]] = {
    "subscribe": Subscribe,
    "unsubscribe": Unsubscribe,
    "cmd": Command,
    "call": Call,
    "ping": Ping,
    "begin": Begin,
    "reply": Reply,
    "press": Press,
}
"""What a message is by the field it has."""

_heads = msgspec.json.Decoder(dict[str, msgspec.Raw])
_decoders: dict[str, msgspec.json.Decoder[Frame]] = {
    name: msgspec.json.Decoder(kind) for name, kind in KINDS.items()
}


def decode(text: str) -> Frame:
    """The frame in a message; raises `FrameError`."""
    about = "message"
    try:
        meant = [name for name in _heads.decode(text) if name in KINDS]
        if len(meant) != 1:
            raise FrameError(about, f"needs one of {', '.join(KINDS)}")
        about = meant[0]
        frame = _decoders[about].decode(text)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise FrameError(about, str(error)) from None
    _require(frame)
    return frame


def _require(frame: Frame) -> None:
    """Raises `FrameError` for numbers that cannot be meant."""
    if isinstance(frame, Command):
        if not (math.isfinite(frame.cmd.linear_x) and math.isfinite(frame.cmd.angular_z)):
            raise FrameError("cmd", "linear_x and angular_z must be finite")
        if not 0.0 < frame.stamp < LATEST_STAMP_MS:
            raise FrameError("cmd", "stamp is ms since 1970 by your own clock")
    elif isinstance(frame, Subscribe) and not 0.0 < frame.rate <= MAX_RATE:
        raise FrameError("subscribe", f"rate is above 0 and at most {MAX_RATE:g} a second")

"""The messages of `/ws`, in both directions. This module is pure.

Each message is one JSON object. One from a client, a frame, has exactly one of the fields in
`MESSAGE_TYPES`, which gives its kind; the server refuses any other, and unknown fields. The first
field of a message to a client gives its kind. The messages with the values of subscribed keys are
built in `socket_sender.py`, because these values are JSON already.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, ClassVar, get_args

import msgspec
from msgspec import Meta, Struct

from acsard.core.messages.permissions import COMMAND_ROLE
from acsard.core.messages.schema import Beat
from acsard.core.values import AcsardError, Role

# At which the values of a key are sent: the maximum, and the default.
MAX_RATE, USUAL_RATE = 50.0, 10.0

# Months before the largest stamp that the daemon accepts, because the zero for a client that
# disconnects has a later stamp than its last command.
MAX_STAMP_MS = 9.2e12

# Of a command that names none. The page in the browser names `teleop`.
DEFAULT_SOURCE = "app"

Short = Annotated[str, Meta(max_length=80)]


class FrameError(AcsardError):
    """A message of a client is not valid.

    `about` is the kind of the message (see `MESSAGE_TYPES`), or "message" if the kind is unclear.
    """

    def __init__(self, about: str, text: str) -> None:
        super().__init__(text)
        self.about = about


class _Frame(Struct, frozen=True, forbid_unknown_fields=True):
    least: ClassVar[Role] = "viewer"  # A `Call` also requires the role of its service.

    @property
    def kind(self) -> str:
        return self.__struct_fields__[0]


class Subscribe(_Frame, frozen=True):
    """Subscribe to a key of the robot.

    The server then sends each new value of this key, but at most `rate` values per second.
    """

    subscribe: Short
    rate: Annotated[float, Meta(gt=0, le=MAX_RATE)] = USUAL_RATE


class Unsubscribe(_Frame, frozen=True):
    """End the subscription to a key of the robot."""

    unsubscribe: Short


class Wish(_Frame, frozen=True):
    """A requested velocity: `linear_x` in m/s, `angular_z` in rad/s."""

    linear_x: float
    angular_z: float


class Command(_Frame, frozen=True):
    """Drive at the velocity `cmd`."""

    least: ClassVar[Role] = COMMAND_ROLE
    cmd: Wish
    stamp: Annotated[float, Meta(gt=0, lt=MAX_STAMP_MS)] | None = None
    """The time of the command on the sender's own clock, ms since 1970, for one without `echo`."""
    source: Short = DEFAULT_SOURCE
    """Name of one of the robot's command sources."""
    echo: Beat | None = None
    """The value of the key `beat` that the client received last."""

    @property
    def stamp_ns(self) -> int | None:
        """The stamp in ns since 1970."""
        return None if self.stamp is None else int(self.stamp * 1e6)

    @property
    def moves(self) -> bool:
        """Whether the linear or the angular velocity of the command is not zero."""
        return self.cmd.linear_x != 0.0 or self.cmd.angular_z != 0.0


class Call(_Frame, frozen=True):
    """Call a service of the robot. The server's answer contains the `id` of the call."""

    call: Short
    id: int | Short = 0
    payload: dict[str, Any] = {}


class Ping(_Frame, frozen=True):
    """Request a pong, which contains the number `ping` and the time of the server."""

    ping: float


Frame = Subscribe | Unsubscribe | Command | Call | Ping

# By kind, the name of the first field.
MESSAGE_TYPES: dict[str, type[Frame]] = {
    kind.__struct_fields__[0]: kind for kind in get_args(Frame)
}

_heads = msgspec.json.Decoder(dict[str, msgspec.Raw])
_decoders: dict[str, msgspec.json.Decoder[Frame]] = {
    name: msgspec.json.Decoder(kind) for name, kind in MESSAGE_TYPES.items()
}


def decode(text: str) -> Frame:
    """Decode a message of a client from JSON. Raises `FrameError` if it is not valid."""
    about = "message"
    try:
        fields = [name for name in _heads.decode(text) if name in MESSAGE_TYPES]
        if len(fields) != 1:
            raise FrameError(
                about, f"a message needs exactly one of the fields {', '.join(MESSAGE_TYPES)}"
            )
        about = fields[0]
        return _decoders[about].decode(text)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise FrameError(about, str(error)) from None


def asks_to_stop(text: str) -> bool:
    """Return whether a message asks the robot to stop, even if it is not valid.

    The message must be a JSON object with `call` = "stop". Every other defect is ignored.
    """
    try:
        # Decode only the field that matters, because any other field may be invalid.
        return bytes(_heads.decode(text).get("call", b"")) == b'"stop"'
    except (msgspec.MsgspecError, ValueError, RecursionError):
        return False


# The messages that the server sends.

Point = tuple[float, float]


class Limits(Struct, frozen=True):
    """The robot's highest speeds: `linear` in m/s, `angular` in rad/s."""

    linear: float
    angular: float


class Greeting(Struct, frozen=True):
    """Identity of the robot and of this viewer."""

    robot: str
    version: str
    role: Role
    sender: str
    """Public name of this viewer. While the viewer drives, `state.sender` has this value."""
    limits: Limits
    simulated: bool
    state_rate: float
    """Rate of the key `state`, Hz."""
    barred: Mapping[str, str]
    """The actions that the client's role does not allow, each with the reason in words. An action
    is the name of a service, "drive" or "recordings"."""
    camera: bool
    """True if a camera is configured. The path `/api/camera` then returns its pictures."""


class Hello(Struct, frozen=True):
    """The first message to a client. The server sends it again whenever its content changes."""

    hello: Greeting


class DrivenPath(Struct, frozen=True):
    """Points (x, y) of the robot's path in the last ten minutes: m, odom frame, oldest first."""

    path: Sequence[Point]


class Answer(Struct, frozen=True):
    """Answer to a call. `answer` is the id of the call, and `ok` is true if the call succeeded."""

    answer: int | str
    ok: bool
    text: str


class Pong(Struct, frozen=True):
    """Answer to a ping: the number of the ping, and the server's time `now` in ms since 1970."""

    pong: float
    now: float


class Refused(Struct, frozen=True):
    """Report of a refused message: the kind of the message (`refused`), and the reason."""

    refused: str
    reason: str


class DaemonUnreachable(Struct, frozen=True):
    """Report that the daemon is not reachable. `gone` is the reason."""

    gone: str

"""Formats messages as lines of JSON, and calls a service of several robots at the same time."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor

import msgspec

from acsard.bus.robot_discovery import ALL_ROBOTS, count_text, running_robots
from acsard.client import Client
from acsard.core import formatting
from acsard.core.formatting import printable
from acsard.core.messages.encodings import DecodeError, detect, encode
from acsard.core.messages.schema import ServiceReply
from acsard.core.values import AcsardError
from acsard.host.errors import Exit


def of_robot(whose: str, line: str) -> str:
    """Return a line of JSON that contains a message and the id of its robot.

    The line has the form `{"robot": "robot1", "message": ...}`. `whose` is the id, and `line` is
    the message as JSON.
    """
    record = {"robot": whose, "message": msgspec.Raw(line.encode())}
    return formatting.json_line(msgspec.json.encode(record).decode())


def json_line(encoding: str, payload: bytes) -> str:
    """Return the payload of a message as a line of JSON.

    `encoding` is the Zenoh encoding of the message. If the payload cannot be decoded, or if it is
    CDR, return `{"undecodable": ...}` with the payload as text.
    """
    try:
        form = detect(encoding, payload)
        if form == "cdr":
            raise DecodeError("unknown_encoding", "a CDR message does not contain its type")
        codec = msgspec.json if form == "json" else msgspec.msgpack
        return msgspec.json.encode(codec.decode(payload)).decode()
    except (DecodeError, msgspec.MsgspecError, ValueError, TypeError, RecursionError):
        return msgspec.json.encode({"undecodable": repr(payload)}).decode()


Replies = Mapping[str, ServiceReply | AcsardError]
"""Maps the id of each robot to its reply, or to the error that explains why a reply is missing."""


def present_ids(robot: Client, ids: Sequence[str]) -> Sequence[str]:
    """Return `ids`, or the ids of all robots that are present if `ids` contains "*".

    `robot` is a client of any robot on the bus. Raises `NoAnswerError` if `ids` contains "*" and no
    robot is present.
    """
    if ALL_ROBOTS in ids:
        return running_robots(robot.session, ids, robot.where.endpoint)
    return ids


def of_each(
    robot: Client, ids: Sequence[str], call: Callable[[Client], ServiceReply]
) -> dict[str, ServiceReply | AcsardError]:
    """Call a service of several robots at the same time, and return the replies by robot id.

    `robot` and `ids` are those of `present_ids`. `call` gets a client of one robot, and calls the
    service of this robot. If a robot does not reply, its entry is the error.
    """
    wanted = present_ids(robot, ids)

    def called(robot_id: str) -> ServiceReply | AcsardError:
        try:
            return call(robot.sibling(robot_id))
        except AcsardError as error:  # the robot did not answer, or its answer cannot be decoded
            return error

    with ThreadPoolExecutor(min(len(wanted), 32)) as calls:
        return dict(zip(wanted, calls.map(called, wanted), strict=True))


def print_each(
    replies: Replies, robot: Client, ids: Sequence[str], silence: str, *, as_json: bool
) -> int:
    """Print one line for the reply of each robot, and return the exit code.

    The exit code is `OK` if all robots did as asked. It is `UNREACHABLE` if any robot did not
    answer, and otherwise `FAILURE` if any robot refused.

    `ids` are the ids that the operator typed. If they contain "*", the number of robots is printed.
    `silence` is the text for a robot that did not answer. `{error}` in it stands for the reason.
    """
    for robot_id, reply in replies.items():
        if isinstance(reply, AcsardError):
            reply = ServiceReply(False, silence.format(error=reply))
        line = encode(reply, "json").decode()
        print(of_robot(robot_id, line) if as_json else printable(f"{robot_id}: {reply.message}"))
    if ALL_ROBOTS in ids:
        print(f"acsard: {count_text(robot.where.endpoint, len(replies))}", file=sys.stderr)
    if any(isinstance(reply, AcsardError) for reply in replies.values()):
        return Exit.UNREACHABLE
    done = [isinstance(reply, ServiceReply) and reply.success for reply in replies.values()]
    return Exit.OK if all(done) else Exit.FAILURE

"""Formats messages as lines of JSON, and calls a service of several robots at the same time."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence

import msgspec

from acsard.bus.robot_discovery import ALL_ROBOTS, count_text, running_robots
from acsard.client.connection import Connection
from acsard.core import formatting
from acsard.core.formatting import printable
from acsard.core.messages.encodings import DecodeError, encode, to_json
from acsard.core.messages.schema import ServiceReply
from acsard.core.values import AcsardError
from acsard.host.errors import Exit, NotPermittedError


def of_robot(whose: str, line: str) -> str:
    """Return the JSON line `{"robot": "robot1", "message": ...}`."""
    record = {"robot": whose, "message": msgspec.Raw(line.encode())}
    return formatting.json_line(msgspec.json.encode(record).decode())


def json_line(encoding: str, payload: bytes) -> str:
    """Return a payload as a line of JSON, or `{"undecodable": ...}` for CDR and damage."""
    try:
        return to_json(encoding, payload).decode()
    except DecodeError:
        return msgspec.json.encode({"undecodable": repr(payload)}).decode()


BARRED = "NOT ALLOWED: {error}"

# Replies by robot id; an error says why there is no reply.
Replies = Mapping[str, ServiceReply | AcsardError]


def present_ids(robot: Connection, ids: Sequence[str]) -> Sequence[str]:
    """Return the named robots, for "*" also the present ones. Raises `NoAnswerError` if none is."""
    if ALL_ROBOTS not in ids:
        return ids
    present = running_robots(robot.session, ids, robot.where.endpoint)
    return sorted({*present, *ids} - {ALL_ROBOTS})


def of_each(
    robot: Connection, ids: Sequence[str], call: Callable[[Connection], ServiceReply]
) -> dict[str, ServiceReply | AcsardError]:
    """Call a service of several robots at once, and return replies or errors by robot id."""
    from concurrent.futures import ThreadPoolExecutor  # slow, and one robot does not need it

    wanted = present_ids(robot, ids)

    def called(robot_id: str) -> ServiceReply | AcsardError:
        try:
            return call(robot.sibling(robot_id))
        except AcsardError as error:  # the robot did not answer, or its answer cannot be decoded
            return error

    with ThreadPoolExecutor(min(len(wanted), 32)) as calls:
        return dict(zip(wanted, calls.map(called, wanted), strict=True))


def print_each(
    replies: Replies, robot: Connection, ids: Sequence[str], silence: str, *, as_json: bool
) -> int:
    """Print a line for each reply, and return the exit code.

    It is `UNREACHABLE` if a robot did not answer, otherwise `NO_PERMISSION` if this client may not
    call one, otherwise `FAILURE` if one refused. `silence` is the text for a robot without an
    answer. Each cause of a silence is printed once, below.
    """
    for robot_id, reply in replies.items():
        if isinstance(reply, AcsardError):
            barred = isinstance(reply, NotPermittedError)
            reply = ServiceReply(False, BARRED.format(error=reply) if barred else silence)
        line = encode(reply, "json").decode()
        text = printable(f"{robot_id}: {reply.message}")
        print(of_robot(robot_id, line) if as_json else text)
    failed = {name: reply for name, reply in replies.items() if isinstance(reply, AcsardError)}
    silent = [name for name, error in failed.items() if not isinstance(error, NotPermittedError)]
    # The texts of two robots with the same cause differ only in the id.
    causes = dict[str, str]()
    for name in silent:
        causes.setdefault(str(failed[name]).replace(name, ""), f"{name}: {failed[name]}")
    for cause in causes.values():
        print(f"acsard: {printable(cause)}", file=sys.stderr)
    if ALL_ROBOTS in ids:
        answered = count_text(robot.where.endpoint, len(replies) - len(silent))
        without = f"; without an answer: {', '.join(silent)}" if silent else ""
        print(f"acsard: {printable(answered + without)}", file=sys.stderr)
    if silent:
        return Exit.UNREACHABLE
    if failed:
        return Exit.NO_PERMISSION
    done = [isinstance(reply, ServiceReply) and reply.success for reply in replies.values()]
    return Exit.OK if all(done) else Exit.FAILURE

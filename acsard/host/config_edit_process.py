"""Computes the changed text of an `acsard.toml` for the daemon, in a separate process.

The library tomlkit needs 0.1 s for a change, and holds the interpreter lock for half a millisecond
at a time. In a test with tomlkit in a thread of the daemon, the control loop was up to 12 ms late,
and missed 3 of 559 periods.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Mapping
from contextlib import suppress

import msgspec
from msgspec import Struct

from acsard.core.config.parsing import ConfigError
from acsard.core.config.toml_editing import edited
from acsard.host.child import environment
from acsard.host.errors import MendableError
from acsard.host.extras import install

EDIT_TIMEOUT_S = 2.0
"""Time limit for the process that computes the change, s. On an idle computer, the process takes
0.2 s."""


class Task(Struct, frozen=True):
    """Input of the process: the text of an `acsard.toml`, and the new values.

    `keys` maps dotted keys, such as "mcu.port", to their new values.
    """

    text: str
    keys: dict[str, object]


class Result(Struct, frozen=True):
    """Output of the process: the new text, or in `error` the reason why the change failed."""

    text: str = ""
    error: str = ""
    mendable: bool = False
    """Whether the text `error` also says how to remove the cause."""


def edited_in_process(text: str, keys: Mapping[str, object]) -> str:
    """Return the configuration `text` with new values, computed in a separate process.

    `keys` maps dotted keys, such as "mcu.port", to their new values. Raises `MendableError` or
    `ValueError` if the text cannot be changed, and `OSError` if the process cannot be started.
    Raises `MendableError` if the process takes longer than `EDIT_TIMEOUT_S`.
    """
    task = msgspec.json.encode(Task(text, dict(keys)))
    # With -P Python ignores the working directory, so it runs the installed package.
    words = [sys.executable, "-P", "-m", "acsard.host.config_edit_process"]
    try:
        done = subprocess.run(
            words, input=task, capture_output=True, env=environment(), timeout=EDIT_TIMEOUT_S
        )
    except subprocess.TimeoutExpired:
        text = (
            f"the robot's computer was too busy to make the change within {EDIT_TIMEOUT_S:g} s: "
            "type the command again"
        )
        raise MendableError(text) from None
    try:
        result = msgspec.json.decode(done.stdout, type=Result)
    except msgspec.DecodeError:
        last_line = done.stderr.decode(errors="replace").strip().rpartition("\n")[2]
        raise ValueError(f"the process that changes the file failed: {last_line}") from None
    if result.error:
        raise (MendableError if result.mendable else ValueError)(result.error)
    return result.text


def main() -> None:
    """Read a `Task` from standard input, and write a `Result` to standard output."""
    # Lower the priority of this process below that of the robot's other processes. The systemd unit
    # does not permit this call.
    with suppress(OSError):
        os.nice(10)
    task = msgspec.json.decode(sys.stdin.buffer.read(), type=Task)
    try:
        result = Result(edited(task.text, task.keys))
    except ImportError:
        result = Result(
            error="the robot needs the library tomlkit; run this command on the robot: "
            f"{install('write')}",
            mendable=True,
        )
    except (ValueError, ConfigError) as error:
        result = Result(error=str(error), mendable=isinstance(error, ConfigError))
    sys.stdout.buffer.write(msgspec.json.encode(result))


if __name__ == "__main__":
    main()

"""What the tools print beside a running robot, as approved in `words/cli.txt`.

`pytest --approve` writes the file anew. `tests/unit/words/transcripts` has what needs no robot.
"""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.system.harness import Bus, Daemon, free_endpoint, until
from tests.system.typed import typed

WORDS = Path(__file__).with_name("words") / "cli.txt"

COMMANDS = """
get inof
get nonsense
get srv/stop
get info --id acsar,other
echo oddom
call stpo
call set_pose
call set_pose 1 2
call set_pose 1 2 east
call set_pose 1e7 0 0
call stop 1
call stop --id other
call set_pose -1.5 -2 -.5E+0
get state
call reset_odometry
call stop
call activate
move forward 1
drive
call clear 1.5
call clear 1
call clear
call clear
call clear --json
set linear_speed 0.5
set limits.linear_speed 20
set limits.linear_speed
set mcu.port /dev/x
set commands.sources.nav.timeout 0.5 --keep
set limits.linear_sped 1 --keep
set rates.telemetry 5 log.level debug
set rates.telemetry 0 log.level info
set
topics
fleet --json --id nobody
echo odom --connect NOWHERE
top --connect NOWHERE
call stop --connect NOWHERE
"""

MOST = 6
"""The longest output, in lines, that is shown whole."""

VARYING = (
    (r"\S+@[^\s/]+( [^\s/]+)?/[0-9a-f]{16}", "SENDER"),
    (r"\d+\.\d+\.\d+\S*?(?=,? robot)", "VERSION"),
    (r"/dev/pts/\d+", "PTY"),
    (r"\d{4}-\d\d-\d\d [\d:]+ UTC", "TIME"),
    (r"\(\d{9,}\)", "(NUMBER)"),
    (r'"version":.*', "..."),
)


def read(text: str, daemon: Daemon, nowhere: str) -> str:
    """Return an output without what differs from run to run."""
    for value, name in ((daemon.endpoint, "ENDPOINT"), (nowhere, "NOWHERE")):
        text = text.replace(value, name)
    text = text.replace(str(daemon.config), "FILE")
    for pattern, name in VARYING:
        text = re.sub(pattern, name, text)
    return text


@pytest.mark.slow
def test_what_the_tools_print_is_approved(
    shared: Daemon, bus: Bus, approved: Callable[[Path, str], None]
) -> None:
    nowhere, before, page = free_endpoint(), bus.get("config"), list[str]()
    until(lambda: len(shared.out) >= 8, 5.0, "the whole banner")
    page += ["the banner", *shared.out, ""]
    for line in filter(None, COMMANDS.splitlines()):
        words = shlex.split(line.replace("NOWHERE", nowhere))
        done = typed(*words, "--config", str(shared.config))
        printed = f"{done.out}\n{done.err}".strip("\n")
        if words == ["get", "state"]:
            state = json.loads(printed)
            printed = str([round(state[part], 3) for part in ("x", "y", "yaw")])
        lines = printed.splitlines()
        lines[MOST:] = ["..."] if len(lines) > MOST else []
        page += [f"$ acsard {line}", *lines, f"exit {done.code}", ""]
        if words[:2] == ["call", "activate"]:
            assert bus.state()["mode"] == "stopped"
    assert bus.get("config") == before
    approved(WORDS, read("\n".join(page), shared, nowhere))

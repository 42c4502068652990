"""Many robots behind one router are listed, followed, and all stopped at once."""

from __future__ import annotations

import json
import re
import signal
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path

import pytest
import zenoh

from acsard import __version__
from acsard.bus.robot_discovery import ALL_ROBOTS, stop
from tests.pages import blocks
from tests.system.harness import (
    Bus,
    Daemon,
    Finished,
    Program,
    Tables,
    acsard,
    client_config,
    free_endpoint,
    until,
)
from tests.system.terminals import SCREEN, at_terminal, screens
from tests.system.typed import typed

pytestmark = pytest.mark.slow  # each starts two robots and a router

ONE, TWO = "robot1", "robot2"


class Robots:
    """Two robots, and the address of their router."""

    def __init__(self, where: Path, endpoint: str, daemons: dict[str, Daemon]) -> None:
        self.where, self.endpoint, self.daemons = where, endpoint, daemons

    def command_line(self, *words: str, who: str = "*") -> list[str]:
        return acsard(*words, "--connect", self.endpoint, "--id", who)

    def tool(self, *words: str, who: str = "*") -> Finished:
        return typed(*words, "--connect", self.endpoint, "--id", who)


@pytest.fixture(scope="module")
def robots(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Robots]:
    where, endpoint = tmp_path_factory.mktemp("many"), free_endpoint()
    with ExitStack() as stack:
        stack.enter_context(zenoh.open(client_config(endpoint, "router")))
        daemons = {}
        for name in (ONE, TWO):
            here = free_endpoint()
            own: Tables = {
                "robot": {"id": name},
                "bus": {"listen": [here], "connect": [endpoint]},
                "ros": {"namespace": name},
            }
            daemons[name] = stack.enter_context(Daemon(where, config=own, name=name))
            with Bus(here, robot_id=name) as bus:
                bus.linked()
        yield Robots(where, endpoint, daemons)


WORDS = Path(__file__).with_name("words") / "fleet.txt"

COMMANDS = (
    "fleet --once", "fleet --once --id robot1,robot9", "fleet --once --id robot8,robot9",
    "get schema/Twist --id robot2,robot1", "get schema/Twist --id robot1,robot9",
    "call stop --id robot1,robot9", "call stop", "fleet --once", "call clear --id robot2,robot1",
    "call clear --id robot1", "call clear --id robot2",
    "set rates.telemetry 7.5 --id robot2,robot1", "set rates.telemetry 0 --json",
    "set rates.telemetry 0 --id robot1,robot9",
)  # fmt: skip

VARYING = (
    (rf"{re.escape(__version__)}(\+\S+)?", "VERSION"),
    (r"\S+@[^\s/]+( [^\s/]+)?/[0-9a-f]{16}", "SENDER"),
    (r"\d{4}-\d\d-\d\d [\d:]+ UTC", "TIME"),
    (r"\d+\.\d s ", "N s "),
    (r" {2,}", "  "),
    (r"(\"message\":\{\"\$\w+\").*", r"\1..."),
)


def test_what_the_tools_print_about_several_robots_is_approved(
    robots: Robots, approved: Callable[[Path, str], None]
) -> None:
    page = []
    for line in COMMANDS:
        who = () if "--id" in line or line.startswith("fleet") else ("--id", "*")
        done = typed(*line.split(), *who, "--connect", robots.endpoint)
        page += [f"$ acsard {' '.join((line, *who))}", done.out, done.err, f"exit {done.code}", ""]
    text = "\n".join(filter(None, page)).replace(robots.endpoint, "ROUTER")
    for pattern, name in VARYING:
        text = re.sub(pattern, name, text)
    approved(WORDS, text + "\n")


HOSTILE = "[2J\x1b]0;x\x07"
"""Characters that a terminal would obey."""


@contextmanager
def fake(robots: Robots, answer: bytes | None) -> Iterator[None]:
    """Run a client of the router that pretends to be a robot.

    It sends `answer` to every query, or no answer if it is None.
    """
    prefix = "acsard/fake"

    def reply(query: zenoh.Query) -> None:
        if answer is None:
            queries.append(query)
        else:
            query.reply(query.key_expr, answer, encoding="application/json")

    queries: list[zenoh.Query] = []
    with zenoh.open(client_config(robots.endpoint)) as session:
        token = session.liveliness().declare_token(f"{prefix}/alive")
        asked = session.declare_queryable(f"{prefix}/**", reply)
        yield
        asked.undeclare()
        token.undeclare()
        queries.clear()


@pytest.mark.parametrize("answer", [b'["x"]', json.dumps({"success": False, "message": HOSTILE})])
def test_a_stranger_s_answer_hides_no_robot_and_sends_no_control_codes_to_the_terminal(
    robots: Robots, answer: str | bytes
) -> None:
    with fake(robots, answer if isinstance(answer, bytes) else answer.encode()):
        ended = robots.tool("call", "stop")
    assert ended.code in (1, 69)
    replies = dict(line.split(": ", 1) for line in ended.out.splitlines())
    assert replies.keys() == {ONE, TWO, "fake"}
    assert replies[ONE].startswith("stopped and latched")
    assert all(line.isprintable() for line in ended.out.splitlines())
    robots.tool("call", "clear", who=ONE)
    robots.tool("call", "clear", who=TWO)


def test_a_stop_to_all_reaches_each_robot_without_discovery(robots: Robots) -> None:
    with zenoh.open(client_config(robots.endpoint)) as session:
        stop(session, [ALL_ROBOTS], "me")
        for name in (ONE, TWO):
            with Bus(robots.endpoint, robot_id=name) as bus:
                until(lambda: bus.state()["mode"] == "stopped", 5.0, "stopped")
    for name in (ONE, TWO):
        robots.tool("call", "clear", who=name)


@pytest.mark.slow
def test_fleet_at_a_terminal_is_live_and_says_which_robot_has_gone(robots: Robots) -> None:
    third: Tables = {
        "robot": {"id": "robot3"},
        "ros": {"namespace": "robot3"},
        "bus": {"listen": [free_endpoint()], "connect": [robots.endpoint]},
    }
    words = ("fleet", "--connect", robots.endpoint)
    with at_terminal(robots.where, *words, term=SCREEN, columns=100, piped="stderr") as (
        terminal,
        program,
    ):

        def line(of: str, pattern: str) -> bool:
            rows = screens(terminal)[-1:]
            return any(re.search(rf"{of} .*{pattern}", row) for row in "".join(rows).splitlines())

        waits = "waiting for a command"
        until(lambda: line(ONE, waits) and line(TWO, waits), 10.0, "both")
        with Daemon(robots.where, config=third, name="third") as daemon:
            until(lambda: line("robot3", "ready"), 10.0, "the third, that came later")
            daemon.signal(signal.SIGKILL)
            until(lambda: line("robot3", "GONE, was: "), 10.0, "that it has gone")
        terminal.press("q")
        assert program.ended(3.0) == 0
    assert "Traceback" not in terminal.screen + program.stderr


def stopped_state(bus: Bus) -> bool:
    return bool(bus.state()["mode"] == "stopped")


@pytest.mark.slow
def test_an_expected_robot_that_hangs_or_is_gone_is_shown_and_ends_with_69(
    robots: Robots, tmp_path: Path
) -> None:
    config = tmp_path / "fleet.toml"
    config.write_text('[fleet]\nrobots = ["robot1", "robot2", "robot9"]\n')

    def tool(*words: str) -> Finished:
        return typed(*words, "--connect", robots.endpoint, "--config", str(config))

    robots.daemons[TWO].signal(signal.SIGSTOP)
    try:
        ended = tool("fleet", "--once")
        rows = {line.split()[0]: line for line in ended.out.splitlines()}
        assert " ready " in rows[ONE]
        assert rows[TWO].endswith("SILENT: its daemon is there and does not answer")
        assert rows["robot9"].endswith("not there")
        assert ended.code == 69
        assert "acsard: gone or silent: robot2, robot9" in ended.err
        assert json.loads(tool("fleet", "--json").out)[0]["robot_id"] == ONE
        stopped = tool("call", "stop", "--id", "*")
    finally:
        robots.daemons[TWO].signal(signal.SIGCONT)
    assert stopped.code == 69
    assert re.search(rf"^{ONE}: stopped", stopped.out, re.M)
    assert re.search(rf"^{TWO}: NO ANSWER", stopped.out, re.M)
    assert re.search(r"^robot9: NO ANSWER", stopped.out, re.M)
    counted, last = stopped.err.splitlines()[-2:]
    assert counted.endswith("1 robot; without an answer: robot2, robot9")
    assert last.startswith("acsard: NOT STOPPED: robot2, robot9: go to them; repeat the stop")
    for name in (ONE, TWO):
        with Bus(robots.endpoint, robot_id=name) as bus:
            until(partial(stopped_state, bus), 10.0, "the stop has arrived")
        assert robots.tool("call", "clear", who=name).code == 0


@pytest.mark.nightly
@pytest.mark.slow
def test_the_two_robots_of_the_fleet_page_are_in_one_view(tmp_path: Path) -> None:
    (block,) = [
        candidate for candidate in blocks("json5") if "tcp/127.0.0.1:7447" in candidate.text
    ]
    endpoint = free_endpoint()
    (tmp_path / "two.json5").write_text(block.text.replace("tcp/127.0.0.1:7447", endpoint))
    with ExitStack() as stack:
        stack.enter_context(Program(acsard("router", "two.json5"), tmp_path))
        for name in (ONE, TWO):
            own = ("--id", name, "--namespace", name)
            join = (*own, "--listen", free_endpoint(), "--connect", endpoint)
            stack.enter_context(Program(acsard("run", *join), tmp_path))
        view = Robots(tmp_path, endpoint, {})

        def both() -> bool:
            table = view.tool("fleet", "--once").out
            return all(re.search(rf"^{name} +ready", table, re.M) for name in (ONE, TWO))

        until(both, 60.0, "both in one view")
        stopped = view.tool("call", "stop")
        assert stopped.code == 0
        assert {line.split(":")[0] for line in stopped.out.splitlines()} == {ONE, TWO}


@pytest.mark.slow
def test_an_empty_network_is_reported_with_69(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    with zenoh.open(client_config(endpoint, "router")):
        nobody = Robots(tmp_path, endpoint, {})
        for words in (("fleet", "--once"), ("call", "stop"), ("get", "info")):
            ended = nobody.tool(*words)
            assert (ended.code, ended.out) == (69, "")
            assert "no robot is visible" in ended.err

"""`acsard.client` and the README's examples, against a running daemon."""

from __future__ import annotations

import asyncio
import json
import math
import re
import signal
import socket
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import zenoh

from acsard.bus.subscription import Subscription
from acsard.client import asynchronous, connect, connect_async, connection
from acsard.client.connection import Connection
from acsard.client.ride import GRACE_S, OPEN_TIMEOUT_S
from acsard.core.messages import schema
from acsard.core.messages.refusals import BUSY_ENCODING
from acsard.host.errors import (
    NoAnswerError,
    NotDrivenError,
    ReplyError,
    UnreachableError,
    UsageError,
)
from tests.each import each
from tests.system.bystander import lost
from tests.system.harness import (
    ROOT,
    Bus,
    Daemon,
    Finished,
    Program,
    Tables,
    client_config,
    finish,
    free_endpoint,
    kept_waiting,
    silences,
    until,
)
from tests.system.strangers import command_line

DEFAULT = "tcp/127.0.0.1:7448"


# the README


class Outcome(NamedTuple):
    """An example's exit, the robot's final state, and the time lost to other programs, s."""

    ended: Finished
    state: Any
    late: float


def code_blocks() -> list[str]:
    """Return the Python code blocks of the README."""
    return re.findall(r"^```python\n(.*?)^```", (ROOT / "README.md").read_text(), re.S | re.M)


def kind(code: str) -> str:
    """Return the name of the example that has this code."""
    if "connect_async" in code:
        return "async"
    return "first" if "acsard.client" in code else "plain zenoh"


def default_is_free() -> bool:
    """Return whether no program uses the daemon's default endpoint."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", 7448))
        except OSError:
            return False
    return True


def at_endpoint(code: str, endpoint: str) -> str:
    """Return the example with this daemon's endpoint instead of the default one."""
    if endpoint == DEFAULT:
        return code
    changed = re.sub(r"(connect|connect_async)\(\)", rf'\1("{endpoint}")', code)
    return changed.replace(DEFAULT, endpoint)


@pytest.fixture(scope="module")
def examples(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Outcome]:
    """Run all examples at the same time, each with its own robot, as each takes two seconds."""
    where = tmp_path_factory.mktemp("examples")
    codes = {kind(code): code for code in code_blocks()}
    endpoints = {name: free_endpoint() for name in codes}
    if default_is_free():
        endpoints["first"] = DEFAULT
    outcomes = {}
    with ExitStack() as stack:
        buses = {}
        for number, (name, endpoint) in enumerate(endpoints.items()):
            stack.enter_context(Daemon(where, endpoint=endpoint, name=f"daemon{number}"))
            buses[name] = stack.enter_context(Bus(endpoint))
        before = {}
        for name, bus in buses.items():
            bus.linked()
            before[name] = kept_waiting(bus.get("info")["pid"])
        samples = {name: stack.enter_context(bus.follow("cmd/app")) for name, bus in buses.items()}
        running = {
            name: stack.enter_context(
                Program(command_line(at_endpoint(code, endpoints[name])), where)
            )
            for name, code in codes.items()
        }
        for name, program in running.items():
            code = program.ended(20.0)
            took = time.monotonic() - program.started
            ended = Finished(code, program.stdout, program.stderr, took)
            state = buses[name].at_rest()
            print(
                f"{name}: exit {code}, x {state['x']:.4f} y {state['y']:.4f} yaw {state['yaw']:.4f}"
            )
            waited_s = kept_waiting(buses[name].get("info")["pid"]) - before[name]
            silent_s = silences([entry.at for entry in samples[name].seen])
            late = lost(program.started) + waited_s + silent_s
            outcomes[name] = Outcome(ended, state, late)
    return outcomes


def test_the_readme_has_the_three_examples() -> None:
    assert sorted(map(kind, code_blocks())) == ["async", "first", "plain zenoh"]


@pytest.mark.slow
def test_the_first_example_of_the_readme_drives_one_metre_turns_and_prints_the_pose(
    examples: dict[str, Outcome],
) -> None:
    ended, state, late = examples["first"]
    assert (ended.code, ended.err) == (0, "")
    assert ended.out.startswith("Pose(x=")
    # If a message comes late, the robot drives on meanwhile, at 0.02 m/s near the end.
    assert state["x"] == pytest.approx(1.0, abs=0.005 + 0.02 * late)
    assert state["yaw"] == pytest.approx(math.radians(90.0), abs=math.radians(0.5 + 3.0 * late))
    # The example prints where the robot came to a stand, not where it still rolled.
    printed = re.match(r"Pose\(x=([\d.]+),", ended.out)
    assert printed
    assert float(printed[1]) == pytest.approx(state["x"], abs=0.01)
    assert state["y"] == pytest.approx(0.0, abs=0.01)


@pytest.mark.slow
def test_the_async_example_of_the_readme_follows_the_robot_while_it_drives(
    examples: dict[str, Outcome],
) -> None:
    ended, state, late = examples["async"]
    assert (ended.code, ended.err) == (0, "")
    assert len(ended.out.splitlines()) > 100
    assert state["yaw"] == pytest.approx(0.4, abs=0.02 + 0.2 * late)
    assert state["x"] == pytest.approx(0.97, abs=0.05 + 0.5 * late)


@pytest.mark.slow
def test_the_plain_zenoh_example_of_the_readme_drives_one_metre_and_follows_the_odometry(
    examples: dict[str, Outcome],
) -> None:
    ended, state, late = examples["plain zenoh"]
    assert (ended.code, ended.err) == (0, "")
    odometry = [json.loads(line) for line in ended.out.splitlines()]
    assert len(odometry) > 10
    assert {odom["child_frame_id"] for odom in odometry} == {"base_link"}
    first, last = (
        message["pose"]["pose"]["position"]["x"] for message in (odometry[0], odometry[-1])
    )
    assert first < 0.5 * state["x"] < last
    # The example's own sleeps add up to a little more than 2 s.
    assert state["x"] == pytest.approx(1.03, abs=0.05 + 0.5 * late), state["counters"]


# the client


@pytest.fixture
def fresh(shared: Daemon, bus: Bus) -> Iterator[Bus]:
    """Provide the shared robot at the origin and at rest. Wait for rest at the end, too."""
    bus.at_rest()
    bus.get("srv/reset_odometry")
    yield bus
    bus.at_rest()


def test_typed_messages_of_every_published_key(shared: Daemon, fresh: Bus) -> None:
    with connect(shared.endpoint) as robot:
        reads: list[tuple[Any, type]] = [
            ("odom", schema.Odometry),
            ("tf", schema.TFMessage),
            ("tf_static", schema.TFMessage),
            ("wheel_states", schema.JointState),
            ("cmd_vel_out", schema.TwistStamped),
            ("state", schema.RobotState),
            ("diagnostics", schema.DiagnosticArray),
        ]
        for name, cls in reads:
            assert isinstance(robot.get(name), cls), name
        assert isinstance(next(robot.messages("odom", timeout=2.0)), schema.Odometry)


def test_get_config_gives_a_dictionary(shared: Daemon, fresh: Bus) -> None:
    with connect(shared.endpoint) as robot:
        assert robot.get("config") == fresh.get("config")
        assert robot.get("info").pid == shared.pid


def test_a_key_that_does_not_exist_raises_an_error_with_the_near_name(shared: Daemon) -> None:
    wrong: Any = "odmo"
    with connect(shared.endpoint) as robot:
        for read in (robot.get, robot.messages):
            with pytest.raises(
                UsageError, match=r"'odmo' is not a key.*did you mean odom"
            ) as error:
                read(wrong)
            assert isinstance(error.value, ValueError)
        query: Any = "info"
        with pytest.raises(UsageError, match="nothing is published on the key info: use get"):
            robot.messages(query)


def test_messages_of_tf_static_yields_the_latched_message_and_ends_after_its_timeout(
    shared: Daemon, fresh: Bus
) -> None:
    with connect(shared.endpoint) as robot:
        start = time.monotonic()
        messages = robot.messages("tf_static", timeout=0.5)
        message = next(messages)
        assert message.transforms[0].child_frame_id == "lidar_link"
        assert time.monotonic() - start < 0.5 + lost(start)
        # There is at most one more, if the message of every 5 s falls into that time.
        assert len(list(messages)) <= 1
        assert time.monotonic() - start < 2.0 + lost(start)


def test_samples_of_a_silent_key_end_after_the_timeout(shared: Daemon) -> None:
    with connect(shared.endpoint) as robot:
        start = time.monotonic()
        assert list(robot._connection.samples("cmd/nobody", timeout=0.3)) == []
        assert 0.25 < time.monotonic() - start < 1.5 + lost(start)


def test_connect_without_arguments_uses_the_file_that_the_environment_names(
    shared: Daemon, fresh: Bus, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def pid() -> Any:
        async with connect_async() as robot:
            return (await robot.get("info")).pid

    monkeypatch.setenv("ACSARD_CONFIG", str(shared.config))
    with connect() as robot:
        assert robot.get("info").pid == asyncio.run(pid()) == shared.pid


def test_connecting_without_a_daemon_raises_a_connection_error_with_the_remedy() -> None:
    endpoint = free_endpoint()
    with pytest.raises(UnreachableError) as error, connect(endpoint):
        pass
    assert isinstance(error.value, ConnectionError)
    assert endpoint in str(error.value)
    assert "acsard run" in str(error.value)


_ONLY_ITS_LIBRARIES = """\
import asyncio, importlib, pkgutil, sys

class Finder:
    others = set()

    def find_spec(self, name, path=None, target=None):
        library = name.partition(".")[0]
        if library not in {"acsard", "msgspec", "xxhash", "zenoh", *sys.stdlib_module_names}:
            self.others.add(library)
            raise ModuleNotFoundError(f"{name} is not for client programs")

sys.meta_path.insert(0, Finder())
import acsard.client

for module in pkgutil.iter_modules(acsard.client.__path__):
    importlib.import_module(f"acsard.client.{module.name}")

async def state(endpoint):
    async with acsard.client.connect_async(endpoint) as robot:
        return await anext(robot.messages("state"))

with acsard.client.connect(sys.argv[1]) as robot:
    robot.drive(0.1, 0.0, seconds=0.1)
    robot.call("stop")
    robot.call("clear")
    print(robot.pose().x > 0.0, asyncio.run(state(sys.argv[1])).link)
# msgspec does not need the first, and `copy` looks for Jython.
print("others:", *Finder.others - {"typing_extensions", "org"})
"""


def test_a_client_program_needs_no_library_but_zenoh_msgspec_and_xxhash(
    shared: Daemon, fresh: Bus
) -> None:
    done = finish([sys.executable, "-c", _ONLY_ITS_LIBRARIES, shared.endpoint], ROOT)
    assert done.code == 0, done.err
    assert done.out.splitlines() == ["True up", "others:"]


async def test_connecting_async_without_a_daemon_raises_the_same_error() -> None:
    with pytest.raises(UnreachableError):
        async with connect_async(free_endpoint()):
            pass


@pytest.mark.parametrize("robot_id", ["a/b*", "", "robot 1"])
def test_an_invalid_robot_id_raises_a_usage_error(robot_id: str) -> None:
    with (
        pytest.raises(UsageError, match="is not a robot's id"),
        connect(free_endpoint(), robot_id=robot_id),
    ):
        pass


def test_a_call_that_is_not_answered_in_time_raises_no_answer(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(connection, "REPLY_TIMEOUT_S", 0.3)
    endpoint = free_endpoint()
    unanswered: list[zenoh.Query] = []
    settings = zenoh.Config()
    settings.insert_json5("listen/endpoints", json.dumps([endpoint]))
    settings.insert_json5("scouting/multicast/enabled", "false")
    with zenoh.open(settings) as stuck:
        stuck.declare_queryable("acsard/acsar/srv/*", unanswered.append)
        with connect(endpoint) as robot, pytest.raises(NoAnswerError, match=r"within 0.3 s"):
            robot.call("deactivate")
        assert unanswered
        unanswered.clear()


@pytest.mark.parametrize("endpoint", ["127.0.0.1:7448", "", "tcp/127.0.0.1", "tcp/[::1]"])
def test_an_invalid_endpoint_raises_a_value_error(endpoint: str) -> None:
    with pytest.raises(UsageError, match="write it like") as error, connect(endpoint):
        pass
    assert isinstance(error.value, ValueError)


def test_an_invalid_key_raises_a_usage_error_that_names_the_topics_verb(shared: Daemon) -> None:
    with connect(shared.endpoint) as robot:
        uses: list[Any] = [robot.get, robot._connection.subscribe, robot.messages]
        for use in uses:
            with pytest.raises(UsageError, match="acsard topics"):
                use("xyz//x")


def test_a_query_that_the_daemon_refuses_raises_the_daemon_s_reason(shared: Daemon) -> None:
    with connect(shared.endpoint) as robot, pytest.raises(ReplyError, match="fmt=json"):
        robot._connection.reply("odom?fmt=xml")


def test_a_put_on_a_wildcard_is_not_taken_for_a_message_of_the_robot(
    shared: Daemon, fresh: Bus
) -> None:
    with connect(shared.endpoint) as client:
        robot = client._connection
        states = robot.subscribe("state")
        raw = robot.samples("state", timeout=5.0)
        next(raw)
        # A key expression that also matches `stop` would stop the robot.
        robot.session.put("acsard/acsar/stat$*", b"{}", encoding="application/json")
        keys = iter(str(sample.key_expr) for sample in raw)
        until(lambda: next(keys) == "acsard/acsar/stat$*", 5.0, "the stranger's")
        until(lambda: next(keys) == "acsard/acsar/state", 5.0, "one of the robot's after it")
        names = []
        while (sample := states.try_recv()) is not None:
            names.append(str(sample.key_expr))
    assert set(names) == {"acsard/acsar/state"}


def test_services_answer_with_success_and_a_message(shared: Daemon, fresh: Bus) -> None:
    with connect(shared.endpoint) as robot:
        assert robot.call("stop").success
        refused = robot.call("activate")
        assert (refused.success, "srv/clear" in refused.message) == (False, True)
        assert robot.call("clear").success
        assert robot.call("set_pose", x=1.0, y=2.0, yaw=0.5).success
        pose = robot.pose()
        assert (pose.x, pose.y, pose.yaw) == pytest.approx((1.0, 2.0, 0.5))


@pytest.mark.slow
def test_a_drive_of_a_stopped_robot_raises_the_daemon_s_reason(shared: Daemon, fresh: Bus) -> None:
    with connect(shared.endpoint) as robot:
        robot.call("stop")
        with pytest.raises(NotDrivenError, match=f"stopped by {robot.name}"):
            robot.drive(0.5, seconds=0.2)
        numbers = [cause.number for cause in robot.get("state").causes]
        robot.call("stop")
        assert not robot.call("clear", numbers=numbers).success
        assert robot.call("clear").success
        robot.call("deactivate")
        with pytest.raises(NotDrivenError, match="srv/activate"):
            robot.drive(0.5, seconds=0.2)
        robot.call("activate")
        robot.drive(0.5, seconds=0.2)
        assert robot.pose().x > 0.02


def test_a_drive_that_is_stopped_on_its_way_raises_and_does_not_go_on(
    shared: Daemon, fresh: Bus
) -> None:
    with connect(shared.endpoint) as robot:

        def stop() -> None:
            until(lambda: (fresh.state()["linear"] or 0.0) > 0.1, 5.0, "driving")
            fresh.session.put("acsard/acsar/stop", b"")

        with ThreadPoolExecutor(1) as other:
            stopping = other.submit(stop)
            with pytest.raises(NotDrivenError, match="stopped"):
                robot.drive(0.3, seconds=30.0)
            stopping.result()
        assert robot.call("clear").success


@pytest.mark.slow
def test_move_and_turn_end_within_five_millimetres_and_half_a_degree(
    shared: Daemon, fresh: Bus
) -> None:
    with connect(shared.endpoint) as robot:
        begun = time.monotonic()
        robot.move(0.5)
        robot.turn(-90)
        robot.move(-0.3)
        robot.turn(450)
        late = lost(begun)
        pose = robot.pose()
    # A late message lets the robot go on, at 0.02 m/s and 3 degrees a second near the end.
    assert pose.x == pytest.approx(0.5, abs=0.005 + 0.02 * late)
    assert pose.y == pytest.approx(0.3, abs=0.005 + 0.02 * late)
    assert math.degrees(pose.yaw) == pytest.approx(0.0, abs=1.0 + 3.0 * late)


def test_a_stop_ends_a_move_with_the_reason(shared: Daemon, fresh: Bus) -> None:
    with connect(shared.endpoint) as robot, ThreadPoolExecutor(1) as other:

        def stop() -> None:
            until(lambda: (fresh.state()["linear"] or 0.0) > 0.1, 5.0, "driving")
            robot.stop()

        stopping = other.submit(stop)
        with pytest.raises(NotDrivenError, match="stopped by"):
            robot.move(30.0)
        stopping.result()
        assert robot.pose().x < 3.0
        assert robot.clear().success


async def test_an_asyncio_program_moves_stops_and_clears(shared: Daemon, fresh: Bus) -> None:
    async with connect_async(shared.endpoint) as robot:
        await robot.move(0.05)
        assert (await robot.pose()).x == pytest.approx(0.05, abs=0.01)
        assert (await robot.stop()).success
        with pytest.raises(NotDrivenError, match="stopped by"):
            await robot.turn(90)
        assert (await robot.clear()).success


@pytest.mark.slow
def test_a_move_of_a_robot_that_comes_no_nearer_raises(shared: Daemon, fresh: Bus) -> None:
    with connect(shared.endpoint) as robot:
        robot.set({"limits.linear_speed": 0.0})
        try:
            with pytest.raises(
                NotDrivenError, match=r"came no nearer for 3 s, and 0\.100 m is left"
            ):
                robot.move(0.1)
        finally:
            robot.set({"limits.linear_speed": 1.0})


@pytest.mark.slow
def test_a_drive_raises_and_names_the_sender_while_another_commander_drives(
    shared: Daemon, fresh: Bus
) -> None:
    with (
        connect(shared.endpoint) as first,
        connect(shared.endpoint) as robot,
        ThreadPoolExecutor(1) as other,
    ):
        # The second would drive if the first ended within this time.
        driving = other.submit(lambda: first.drive(0.1, seconds=OPEN_TIMEOUT_S + 3.0))
        until(lambda: (fresh.state()["linear"] or 0.0) > 0.05, 5.0, "the first drives")
        with pytest.raises(NotDrivenError, match=re.escape(first._connection.sender)):
            robot.drive(0.5, seconds=0.2)
        driving.result()


@pytest.mark.slow
def test_a_drive_of_a_robot_that_dies_behind_a_router_with_storages_raises(tmp_path: Path) -> None:
    endpoint, last = free_endpoint(), list[zenoh.Sample]()

    def answer(query: zenoh.Query) -> None:
        answered.append(True)
        for item in last[-1:]:
            query.reply(
                item.key_expr, item.payload, encoding=item.encoding, timestamp=item.timestamp
            )

    answered: list[bool] = []
    with ExitStack() as stack:
        router = stack.enter_context(zenoh.open(client_config(endpoint, "router")))
        handles: list[Any] = [
            router.declare_subscriber("acsard/acsar/state", last.append),
            router.declare_queryable("acsard/acsar/state", answer),
        ]
        listen: Tables = {"bus": {"listen": [free_endpoint()], "connect": [endpoint]}}
        daemon = stack.enter_context(Daemon(tmp_path, config=listen))
        until(lambda: bool(last), 10.0, "connected")
        robot, bus = stack.enter_context(connect(endpoint)), stack.enter_context(Bus(endpoint))

        def kill() -> None:
            until(lambda: (bus.state()["linear"] or 0.0) > 0.1, 10.0, "driving")
            daemon.signal(signal.SIGKILL)

        killing = stack.enter_context(ThreadPoolExecutor(1)).submit(kill)
        with pytest.raises(NoAnswerError, match="nothing received from the daemon"):
            robot.drive(0.3, seconds=4.0)
        killing.result()
        assert answered
        for item in handles:
            item.undeclare()


def test_a_reader_sleeps_between_messages(shared: Daemon, fresh: Bus) -> None:
    with connect(shared.endpoint) as robot:
        looks = 0
        look = Subscription.try_recv

        def counted(subscription: Subscription) -> Any:
            nonlocal looks
            looks += 1
            return look(subscription)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(Subscription, "try_recv", counted)
            states = robot.messages("state", timeout=5.0)
            for _ in range(5):
                next(states)
    # Polling once a millisecond would take hundreds of calls per half second.
    assert looks <= 20


@pytest.mark.slow
def test_a_drive_begins_and_ends_with_a_zero(shared: Daemon, fresh: Bus) -> None:
    with connect(shared.endpoint) as robot, fresh.follow("cmd/app") as commands:
        begun = time.monotonic()
        robot.drive(0.3, 0.1, seconds=0.2)
        missed = lost(begun) / 0.05  # it sends at 20 Hz
        commands.find(lambda value: value["linear"]["x"] == 0.3, 2.0, "the command")
        speeds = until(
            lambda: _ended([entry.value["linear"]["x"] for entry in commands.seen]),
            2.0,
            "the last zero",
        )
        assert speeds[0] == 0.0
        assert 3 - missed <= speeds.count(0.3) <= 6
        assert commands.seen[0].encoding == "application/msgpack;acsard.Twist.v1"


def _ended(speeds: list[float]) -> list[float]:
    return speeds if len(speeds) > 2 and speeds[-1] == 0.0 else []


def test_a_drive_that_is_interrupted_sends_a_zero(shared: Daemon, fresh: Bus) -> None:
    class InterruptionError(Exception):
        pass

    def drive_and_fail(robot: Any) -> None:
        for count, _ in enumerate(robot.messages("odom", timeout=2.0)):
            robot.send(0.3)
            if count > 20:
                raise InterruptionError

    with fresh.follow("cmd/app") as commands:
        with pytest.raises(InterruptionError), connect(shared.endpoint) as robot:
            drive_and_fail(robot)
        # A source may have a timeout of several seconds, so the robot must not wait for it.
        until(
            lambda: _ended([entry.value["linear"]["x"] for entry in commands.seen]),
            1.0,
            "the last zero",
        )
    until(lambda: fresh.state()["mode"] == "ready", 1.0, "the source is gone")


# asyncio


@pytest.mark.slow
async def test_an_async_drive_runs_while_odometry_is_followed(shared: Daemon, fresh: Bus) -> None:
    begun, messages = time.monotonic(), []
    async with connect_async(shared.endpoint) as robot:
        driving = asyncio.create_task(robot.drive(0.5, seconds=0.6))
        async for odom in robot.messages("odom"):
            messages.append(odom)
            if driving.done() and odom.twist.twist.linear.x == 0.0:
                break
    late = lost(begun)
    assert len(messages) > 60 - 100 * late
    assert max(odom.twist.twist.linear.x for odom in messages) > 0.4
    assert messages[-1].pose.pose.position.x == pytest.approx(0.3, abs=0.03 + 0.5 * late)


@pytest.mark.slow
async def test_a_connection_that_does_not_close_keeps_the_error_of_the_program(
    shared: Daemon, fresh: Bus, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(asynchronous, "CLOSE_TIMEOUT_S", 0.0)
    with pytest.raises(NotDrivenError, match="no reason"):
        async with connect_async(shared.endpoint):
            raise NotDrivenError("no reason")
    with pytest.raises(NoAnswerError, match="could not be closed"):
        async with connect_async(shared.endpoint):
            pass


@pytest.mark.slow
async def test_cancelling_an_async_drive_sends_the_zero_immediately(
    shared: Daemon, fresh: Bus
) -> None:
    with fresh.follow("cmd/app") as commands:
        async with connect_async(shared.endpoint) as robot:
            driving = asyncio.create_task(robot.drive(0.5, seconds=60.0))
            async for odom in robot.messages("odom"):
                if odom.twist.twist.linear.x > 0.2:
                    break
            cancelled = time.monotonic()
            driving.cancel()
            with pytest.raises(asyncio.CancelledError):
                await driving
            state = await robot.get("state")
            assert isinstance(state, schema.RobotState)
        zero = commands.find(
            lambda value: value["linear"]["x"] == 0.0, 2.0, "a zero", after=cancelled
        )
    print(f"cancel -> zero on the bus: {zero.at - cancelled:.4f} s")
    assert zero.at - cancelled < 0.2 + lost(cancelled, zero.at)
    assert not [
        entry for entry in commands.seen if entry.at > zero.at and entry.value["linear"]["x"] != 0.0
    ]


@pytest.mark.slow
async def test_an_async_drive_does_not_go_on_after_its_event_loop_was_blocked(
    shared: Daemon, fresh: Bus
) -> None:
    with fresh.follow("cmd/app") as commands:
        async with connect_async(shared.endpoint) as robot:
            driving = asyncio.create_task(robot.drive(0.3, seconds=60.0))
            async for odom in robot.messages("odom"):
                if odom.twist.twist.linear.x > 0.2:
                    break
            asyncio.get_running_loop().call_soon(time.sleep, 2 * GRACE_S)
            await asyncio.sleep(0.0)
            awake = time.monotonic()
            with pytest.raises(NotDrivenError, match="sent no command for"):
                await driving
        commands.find(lambda value: value["linear"]["x"] == 0.0, 2.0, "a zero", after=awake)
    speeds = [sample.value["linear"]["x"] for sample in commands.seen if sample.at > awake]
    assert set(speeds) == {0.0}


async def test_a_zero_sent_right_after_a_command_is_not_lost(shared: Daemon, fresh: Bus) -> None:
    # A drive may be cancelled just after it sent a command. The bus drops commands of one key that
    # come faster than 1000 Hz, also because the receiver was busy and handles them in a row. Then
    # the robot would drive on for its timeout, so the zero is repeated.
    sent: list[float] = []
    original = Connection._put

    def put(self: Connection, linear: float, angular: float, echo: schema.Beat) -> None:
        original(self, linear, angular, echo)
        sent.append(linear)

    with pytest.MonkeyPatch.context() as patch, fresh.follow("cmd/app") as commands:
        patch.setattr(Connection, "_put", put)
        async with connect_async(shared.endpoint) as robot:
            driving = asyncio.create_task(robot.drive(0.2, seconds=60.0))
            # Send the opening zero, the pause, and the first command, in one step of the loop.
            await asyncio.sleep(0)
            while 0.2 not in sent:
                await asyncio.sleep(0)
            driving.cancel()
            with pytest.raises(asyncio.CancelledError):
                await driving
            zeros = sent[::-1].index(0.2)
            assert zeros >= 2
            await robot.get("info")
        fresh.get("info")  # after everything that was sent: the command itself may be dropped
        until(lambda: commands.seen[-1].value["linear"]["x"] == 0.0, 1.0, "a last zero")


async def test_an_async_call_and_pose_leave_the_loop_running(shared: Daemon, fresh: Bus) -> None:
    async with connect_async(shared.endpoint) as robot:
        assert (await robot.call("set_pose", x=4.0, y=0.0, yaw=0.0)).success
        # Compare to a tenth of a millimetre, because wheels that come to rest creep.
        assert (await robot.pose()).x == pytest.approx(4.0, abs=1e-4)


def test_the_client_repeats_a_query_to_a_busy_daemon_and_never_a_service_call() -> None:
    endpoint, asked = free_endpoint(), list[str]()

    def answer(query: zenoh.Query) -> None:
        asked.append(str(query.key_expr))
        if len(asked) < 4:
            query.reply_err("another text", encoding=BUSY_ENCODING)
        else:
            query.reply(query.key_expr, "{}")

    config = zenoh.Config()
    config.insert_json5("listen/endpoints", json.dumps([endpoint]))
    config.insert_json5("scouting/multicast/enabled", "false")
    with zenoh.open(config) as busy:
        queryables = [
            busy.declare_queryable(f"acsard/acsar/{key}", answer) for key in ("config", "srv/*")
        ]
        with connect(endpoint) as robot:
            assert robot._connection.reply("config")[1] == b"{}"
            assert asked == ["acsard/acsar/config"] * 4
            asked.clear()
            # Another client may have pressed stop since.
            with pytest.raises(ReplyError, match="another text"):
                robot.call("deactivate")
            assert asked == ["acsard/acsar/srv/deactivate"]
        assert queryables


def test_no_client_request_raised_an_exception_in_the_daemon(shared: Daemon) -> None:
    assert "Traceback" not in shared.stderr
    assert shared.process.poll() is None


@each("use", ["robot.messages('odom')", "robot.send(0.3)"])
def test_a_program_that_never_closes_its_connection_ends(
    shared: Daemon, tmp_path: Path, use: str
) -> None:
    script = f"""
from acsard.client import connect
opened = connect({shared.endpoint!r})
robot = opened.__enter__()
kept = {use}
if hasattr(kept, "__next__"): next(kept)
"""
    assert finish([sys.executable, "-c", script], tmp_path, 10.0).code == 0

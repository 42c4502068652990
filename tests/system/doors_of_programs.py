"""The doors of tools and programs: the page, Foxglove, the command line, the clients, examples."""

from __future__ import annotations

import asyncio
import json
import secrets
import signal
import socket
import ssl
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, ClassVar
from urllib.parse import urlsplit

import pytest
from websockets.sync.client import connect as connect_socket

from acsard.client import connect, connect_async
from acsard.host.errors import NotPermittedError, ReplyError
from acsard.machine.authority import Authority
from tests.system.browser import NAME, Page
from tests.system.builds import CLIENTS, copied, node_program, program, run
from tests.system.doors import (
    LATE_S,
    CycloneDds,
    Door,
    EmulatedBridge,
    FastDds,
    Gateway,
    Json,
    Msgpack,
    Rmw,
    Router,
    Send,
    Stage,
)
from tests.system.harness import (
    Program,
    acsard,
    environment,
    finish,
    free_endpoint,
    repeated,
    until,
)
from tests.system.terminals import SCREEN, at_terminal, key_held
from tests.system.typed import typed
from tests.system.viewer import Viewer


def done(call: Callable[[], object]) -> bool:
    """Return whether the robot did not refuse the call."""
    try:
        call()
    except ReplyError:
        return False
    return True


class OfClient(Door):
    """A door by the Python client, which takes the certificate of a role."""

    zeroes = True
    lacks: ClassVar = {
        "late": "it echoes the newest beat: `test_lateness_echo.py` delays it in a queue",
        "bad": "its arguments are checked before it sends",
    }

    def for_viewer(self) -> Stage:
        stage: Stage = self.robot.request.getfixturevalue("stages")("gateway")
        return stage

    def over_tls(self) -> tuple[str, str]:
        """Return the address of the gateway, and the directory of a viewer's certificate."""
        stage = self.for_viewer()
        assert stage.own is not None
        link = stage.endpoint, str(stage.own("viewer"))
        # A busy machine may let the first connection wait for longer than a client does.
        asked = ("get", "info", "--connect", link[0], "--tls", link[1])
        until(lambda: typed(*asked).code == 0, 10.0, "the viewer is let in")
        return link


class Sync(OfClient):
    name, marks = "Python client", pytest.mark.slow

    def open(self) -> None:
        self._client = self.stack.enter_context(connect(self.robot.endpoint))

    @contextmanager
    def drive(self) -> Iterator[None]:
        with (
            connect(self.robot.endpoint) as robot,
            repeated(lambda: robot.send(*self.speeds)) as self._silence,
        ):
            yield

    def stop(self) -> None:
        self._client.stop()

    def clear(self, numbers: Sequence[int] | None = None) -> bool:
        if numbers is None:
            return done(self._client.clear)
        return done(lambda: self._client.call("clear", numbers=list(numbers)))

    def set(self, key: str, value: float) -> bool:
        return done(lambda: self._client.set({key: value}))

    def state(self) -> str:
        state = next(self._client.messages("state", timeout=5.0))
        return f"{state.mode}: {state.reason}"

    def viewer(self) -> bool:
        tls, own = self.over_tls()
        with connect(tls, tls=own) as client:
            try:
                client.drive(0.3, seconds=0.5)
            except NotPermittedError as error:
                return done(client.stop) and "viewer" in str(error)
        return False


class Async(OfClient):
    """The client for asyncio, in an event loop of its own."""

    name, marks = "Python client for asyncio", pytest.mark.slow

    def open(self) -> None:
        self._loop = asyncio.new_event_loop()
        thread = threading.Thread(target=self._loop.run_forever)
        thread.start()
        self.stack.callback(thread.join)
        self.stack.callback(self._loop.call_soon_threadsafe, self._loop.stop)
        opened = connect_async(self.robot.endpoint)
        self._client = self.run(opened.__aenter__())
        self.stack.callback(lambda: self.run(opened.__aexit__(None, None, None)))

    def run(self, work: Any) -> Any:
        return asyncio.run_coroutine_threadsafe(work, self._loop).result(20.0)

    @contextmanager
    def drive(self) -> Iterator[None]:
        driving = self._client.drive(*self.speeds, seconds=60.0)
        task = asyncio.run_coroutine_threadsafe(driving, self._loop)
        self._resumes = threading.Event()
        try:
            yield
        finally:
            self._resumes.set()
            task.cancel()
            self.run(asyncio.sleep(0.2))  # in which it sends its zeros

    def silence(self) -> None:
        hangs = threading.Event()

        def hang() -> None:
            hangs.set()
            self._resumes.wait(20.0)

        self._loop.call_soon_threadsafe(hang)
        assert hangs.wait(20.0)

    def stop(self) -> None:
        self.run(self._client.stop())

    def clear(self, numbers: Sequence[int] | None = None) -> bool:
        named = {} if numbers is None else {"numbers": list(numbers)}
        return done(lambda: self.run(self._client.call("clear", **named)))

    def set(self, key: str, value: float) -> bool:
        return done(lambda: self.run(self._client.set({key: value})))

    def state(self) -> str:
        state = self.run(anext(self._client.messages("state")))
        return f"{state.mode}: {state.reason}"

    def viewer(self) -> bool:
        tls, own = self.over_tls()

        async def story() -> bool:
            async with connect_async(tls, tls=own) as client:
                try:
                    await client.drive(0.3, seconds=0.5)
                except NotPermittedError as error:
                    return (await client.stop()).success and "viewer" in str(error)
            return False

        return bool(self.run(story()))


class CommandLine(OfClient):
    name, marks, speeds, source = "command line", pytest.mark.slow, (0.2, 0.0), "teleop"

    def tool(self, *words: str) -> bool:
        done = typed(*words, "--config", str(self.robot.daemon.config))
        self.out = done.out
        return done.code == 0

    @contextmanager
    def drive(self) -> Iterator[None]:
        words = ("drive", "--linear", "0.2", "--config", str(self.robot.daemon.config))
        with at_terminal(self.robot.where, *words, term=SCREEN) as (terminal, drive):
            until(lambda: "as teleop" in terminal.screen, 10.0, "the screen")
            with key_held(terminal, "i", lambda: (self.bus.state()["linear"] or 0.0) > 0.0):
                self._program = drive
                yield
            drive.signal(signal.SIGCONT)
            terminal.press("\x03")
            assert drive.ended(5.0) == 0

    def silence(self) -> None:
        self._program.signal(signal.SIGSTOP)

    def stop(self) -> None:
        assert self.tool("call", "stop")

    def clear(self, numbers: Sequence[int] | None = None) -> bool:
        return self.tool("call", "clear", *map(str, numbers or ()))

    def set(self, key: str, value: float) -> bool:
        return self.tool("set", key, str(value))

    def state(self) -> str:
        assert self.tool("echo", "state", "--short", "-n", "1")
        return self.out

    def viewer(self) -> bool:
        tls, own = self.over_tls()
        link = ("--connect", tls, "--tls", own)
        with at_terminal(self.robot.where, "drive", *link, term=SCREEN) as (_, drive):
            refused = drive.ended(10.0) == NotPermittedError.code
        return typed("call", "stop", *link).code == 0 and refused


class WebSocket(Door):
    """The page's interface for programs, `/ws`, used on the robot and by an invited viewer."""

    name = "`/ws` of the page"
    marks: Any = pytest.mark.network

    def open(self) -> None:
        where = self.robot.where
        Authority.make(where / "tls", "test", 1, [NAME]).issue(where / "tls", "robot", [NAME], 1)
        self.page = self.stack.enter_context(Page(self.robot.daemon, where))
        self._talk = self.stack.enter_context(self.opened())

    @contextmanager
    def opened(self, token: str = "") -> Iterator[Talk]:
        place = urlsplit(self.page.away if token else self.page.here)
        how: dict[str, Any] = {"close_timeout": 1.0}
        if token:
            how["ssl"] = ssl.create_default_context(cafile=str(self.page.tls / "ca.pem"))
            how["additional_headers"] = {"Authorization": f"Bearer {token}"}
        link = socket.create_connection(("127.0.0.1", place.port or 0))
        address = f"{'wss' if token else 'ws'}://{place.netloc}/ws"
        with connect_socket(address, sock=link, **how) as opened:
            talk = Talk(opened)
            talk.find(lambda frame: "hello" in frame)
            yield talk

    def send(self, linear: float, angular: float = 0.0) -> None:
        self._talk.drive(linear, angular)

    @contextmanager
    def drive(self) -> Iterator[None]:
        usual = self._talk
        with self.opened() as self._talk:
            try:
                with super().drive():
                    yield
            finally:
                own, self._talk = self._talk, usual
                own.socket.close()

    def stop(self) -> None:
        assert self._talk.call("stop")

    def clear(self, numbers: Sequence[int] | None = None) -> bool:
        causes = self._talk.state()["causes"]
        named = [cause["number"] for cause in causes] if numbers is None else list(numbers)
        return self._talk.call("clear", numbers=named)

    def late(self) -> tuple[str, Send]:
        beat = self.bus.get("beat")
        self.arm()
        heard = time.monotonic()
        until(lambda: time.monotonic() > heard + LATE_S, 2.0, "its age")
        return "too_old", lambda: self._talk.say(cmd=wish(0.5, 0.0), echo=beat)

    def bad(self) -> dict[str, Send]:
        return {"malformed": lambda: self._talk.say(cmd={"linear_x": "fast", "angular_z": 0.0})}

    def counted(self, code: str) -> int:
        return super().counted(code) + int(self.page.refused().get(code, 0))

    def set(self, key: str, value: float) -> bool:
        return self._talk.call("set", settings={key: value})

    def state(self) -> str:
        state = self._talk.state()
        return f"{state['mode']}: {state['reason']}"

    def viewer(self) -> bool:
        with self.opened(self.page.invite("viewer", "wall")) as talk:
            talk.say(cmd=wish(0.3, 0.0))
            talk.find(lambda frame: frame.get("refused") == "cmd")
            return talk.call("stop")


def wish(linear: float, angular: float) -> dict[str, float]:
    return {"linear_x": linear, "angular_z": angular}


class Talk:
    """One connection to `/ws`."""

    def __init__(self, opened: Any) -> None:
        self.socket, self._stamp = opened, 0.0

    def say(self, **message: object) -> None:
        self.socket.send(json.dumps(message))

    def drive(self, linear: float, angular: float) -> None:
        self._stamp = max(self._stamp + 0.001, time.time() * 1e3)
        self.say(cmd=wish(linear, angular), stamp=self._stamp)

    def find(self, look: Callable[[Any], Any]) -> Any:
        """Return the first message that `look` accepts."""
        end = time.monotonic() + 15.0
        while not look(frame := json.loads(self.socket.recv(end - time.monotonic()))):
            pass
        return frame

    def call(self, name: str, **payload: object) -> bool:
        """Call a service, and return its success."""
        self.say(call=name, id=(asked := secrets.token_hex(4)), payload=payload)
        return bool(self.find(lambda frame: frame.get("answer") == asked)["ok"])

    def state(self) -> Any:
        self.say(subscribe="state", rate=50)
        state = self.find(lambda frame: frame.get("key") == "state")["value"]
        self.say(unsubscribe="state")
        return state


class Foxglove(Door):
    name, marks = "Foxglove", pytest.mark.slow
    lacks: ClassVar = dict.fromkeys(
        ("units", "zero", "clear", "silence", "late", "bad", "set", "role", "end"),
        "it shows and stops, and does nothing else",
    )

    def open(self) -> None:
        port = int(free_endpoint().rpartition(":")[2])
        words = ("--config", str(self.robot.daemon.config), "--address", f"127.0.0.1:{port}")
        shows = Program(acsard("foxglove", *words), self.robot.where)
        self.stack.enter_context(shows).says("ws://")
        self._viewer = self.stack.enter_context(Viewer(port))

    def stop(self) -> None:
        assert self._viewer.call("/acsard/stop", {})["success"]

    def state(self) -> str:
        topic = self._viewer.show("/state")
        message = topic.read(topic.first(2)[-1].payload)
        topic.hide()
        return f"{message.mode}: {message.reason}"


class Curl(WebSocket):
    """The program for curl of `deploy/clients`."""

    name, marks, numbers = "curl", pytest.mark.slow, None
    lacks: ClassVar = dict.fromkeys(
        ("units", "zero", "silence", "late", "bad", "set", "end"), "no such verb"
    )

    def asks(self, verb: str, **more: str) -> str:
        """Run the program. Return its output, or "" if it fails."""
        program("curl", "the program calls it")
        env = environment(**({"ADDRESS": self.page.here} | more))
        words = ["sh", str(CLIENTS / "curl/robot.sh"), verb]
        done = finish(words, self.robot.where, env=env)
        return "" if done.code else done.out

    def stop(self) -> None:
        assert json.loads(self.asks("stop"))["success"]

    def clear(self, numbers: Sequence[int] | None = None) -> bool:
        return bool(json.loads(self.asks("clear"))["success"])

    def state(self) -> str:
        state = json.loads(self.asks("state"))
        return f"{state['mode']}: {state['reason']}"

    def viewer(self) -> bool:
        away = {"ADDRESS": self.page.away, "CURL_CA_BUNDLE": str(self.page.tls / "ca.pem")}
        away["TOKEN"] = self.page.invite("viewer", "curl")
        self.bus.get("srv/stop")
        refused = self.asks("clear", **away) == ""
        assert self.bus.get("srv/clear")["success"]
        return bool(self.asks("stop", **away)) and refused


class Example(WebSocket):
    """A program of `deploy/clients` that drives for two seconds through the page.

    It only drives; `/ws`, which it uses, is a door of its own that stops.
    """

    zeroes, speeds = True, (0.2, 0.0)
    lacks: ClassVar = dict.fromkeys(
        ("stop", "clear", "silence", "late", "bad", "set", "state", "role"), "it only drives"
    )

    def words(self) -> list[str]:
        raise NotImplementedError

    @contextmanager
    def drive(self) -> Iterator[None]:
        with Program([*self.words(), f"{self.page.here}/"], self.robot.where) as example:
            yield
            assert example.ended(20.0) == 0, example


class Node(Example):
    name, marks = "Node", (pytest.mark.slow, pytest.mark.nightly)

    def words(self) -> list[str]:
        return node_program(self.robot.where)


class Java(Example):
    name, marks = "Java", (pytest.mark.slow, pytest.mark.nightly)

    def words(self) -> list[str]:
        return [program("java", "it runs the program"), str(CLIENTS / "java/Drive.java")]


class Go(Example):
    name, marks = "Go", (pytest.mark.languages, pytest.mark.timeout(300))

    def words(self) -> list[str]:
        here = copied("go", self.robot.request.getfixturevalue("kept"))
        run([program("go", "it builds the program"), "build", "-o", "drive", "."], here)
        return [str(here / "drive")]


DOORS: tuple[type[Door], ...] = (
    Json, Msgpack, Rmw, EmulatedBridge, CycloneDds, FastDds, WebSocket, Foxglove, CommandLine,
    Sync, Async, Curl, Node, Java, Go, Gateway, Router,
)  # fmt: skip

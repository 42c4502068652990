"""No command of our client is obeyed that waited in a queue, even if there always was a queue."""

from __future__ import annotations

import queue
import socket
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from acsard.client import connect
from tests.system.harness import Bus, Daemon, Program, until
from tests.system.test_bus_faults import port_of

pytestmark = pytest.mark.network

QUEUE_S = 3.0

# A dead-man joystick: arguments are the endpoint, and for how many s it sends and is held.
JOYSTICK = """
import sys, time
from pathlib import Path
from acsard.client import connect

with connect(sys.argv[1]) as robot:
    while robot._connection._beats.newest() is None:
        time.sleep(0.01)
    print("connected", flush=True)
    while not Path("begin").exists():
        time.sleep(0.01)
    for number in range(int(sys.argv[2]) * 20):
        robot.send(0.5 if number < int(sys.argv[3]) * 20 else 0.0)
        time.sleep(0.05)
"""


class Delay:
    """A TCP relay to the daemon, in which the bytes of a client wait for `seconds`."""

    def __init__(self, endpoint: str) -> None:
        self._target, self.seconds = port_of(endpoint), 0.0
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.endpoint = f"tcp/127.0.0.1:{self._listener.getsockname()[1]}"
        self._sockets = [self._listener]

    def __enter__(self) -> Delay:
        threading.Thread(target=self._accept, daemon=True).start()
        return self

    def __exit__(self, *error: object) -> None:
        for sock in self._sockets:
            try:
                sock.shutdown(socket.SHUT_RDWR)
            except OSError:
                pass  # closed by the other side
            sock.close()

    def _accept(self) -> None:
        while True:
            try:
                client, _ = self._listener.accept()
            except OSError:
                return
            daemon = socket.create_connection(("127.0.0.1", self._target))
            self._sockets += [client, daemon]
            waiting: queue.SimpleQueue[tuple[float, bytes]] = queue.SimpleQueue()
            for work, words in (
                (self._take, (client, waiting)),
                (self._give, (waiting, daemon)),
                (self._pass, (daemon, client)),
            ):
                threading.Thread(target=work, args=words, daemon=True).start()

    def _take(self, source: socket.socket, waiting: queue.SimpleQueue[tuple[float, bytes]]) -> None:
        for data in received(source):
            waiting.put((time.monotonic() + self.seconds, data))

    def _give(self, waiting: queue.SimpleQueue[tuple[float, bytes]], sink: socket.socket) -> None:
        data = b"-"
        while data:
            due, data = waiting.get()
            time.sleep(max(0.0, due - time.monotonic()))
            try:
                sink.sendall(data)
            except OSError:
                return

    def _pass(self, source: socket.socket, sink: socket.socket) -> None:
        for data in received(source):
            try:
                sink.sendall(data)
            except OSError:
                return


def received(source: socket.socket) -> Iterator[bytes]:
    """Yield what arrives, and at the end b""."""
    data = b"-"
    while data:
        try:
            data = source.recv(65536)
        except OSError:
            data = b""
        yield data


@pytest.fixture
def delay(shared: Daemon) -> Iterator[Delay]:
    with Delay(shared.endpoint) as delay:
        yield delay


def joystick(delay: Delay, where: Path, seconds: int, held: int) -> Program:
    words = [sys.executable, "-c", JOYSTICK, delay.endpoint, str(seconds), str(held)]
    return Program(words, where)


def test_a_new_client_drives_within_0_3_s_of_its_zero(
    shared: Daemon, bus: Bus, tmp_path: Path
) -> None:
    drive = "import sys\nfrom acsard.client import connect\n"
    drive += "with connect(sys.argv[1]) as robot:\n    robot.drive(0.3, seconds=0.5)\n"
    bus.at_rest()
    with bus.follow("cmd/app") as sent, bus.follow("cmd_vel_out") as applied:
        with Program([sys.executable, "-c", drive, shared.endpoint], tmp_path) as client:
            assert client.ended(20.0) == 0, client
        began = next(entry.at for entry in sent.seen if entry.value["linear"]["x"] == 0.0)
        moved = next(
            entry.at for entry in applied.seen if entry.value["twist"]["linear"]["x"] > 0.0
        )
    print(f"drives {moved - began:.3f} s after its zero")
    assert moved - began < 0.3
    bus.at_rest()


def test_a_clear_does_not_release_a_stop_that_came_after_it(
    shared: Daemon, bus: Bus, delay: Delay
) -> None:
    """The client's calls need 2.8 s to the daemon. Meanwhile another person stops the robot."""
    with connect(shared.endpoint) as other, connect(delay.endpoint) as robot:
        other.name = "first"
        other.stop()
        time.sleep(0.2)  # the state shows it
        delay.seconds = 2.8
        with ThreadPoolExecutor(1) as thread:
            clearing = thread.submit(robot.clear)
            time.sleep(0.5)
            later = bus.get("srv/stop")["data"]["numbers"]
            reply = clearing.result()
        delay.seconds = 0.0
        time.sleep(2.8)
    assert reply.success, reply
    state = bus.state()
    assert (state["mode"], [cause["number"] for cause in state["causes"]]) == ("stopped", later)
    bus.get("srv/clear")


def test_a_joystick_behind_a_queue_of_3_s_from_its_first_command_on_moves_nothing(
    shared: Daemon, bus: Bus, delay: Delay, tmp_path: Path
) -> None:
    begun = bus.at_rest()
    with joystick(delay, tmp_path, 6, 4) as program:
        program.says("connected", 20.0)
        delay.seconds = QUEUE_S
        (tmp_path / "begin").touch()
        time.sleep(QUEUE_S + 3.5)
        state = bus.state()
        assert program.ended(20.0) == 0, program
    time.sleep(QUEUE_S)
    ended = bus.at_rest()
    assert state["counters"]["command_too_old"] > 0
    (waits,) = [entry["wait"] for entry in state["sources"] if entry["name"] == "app"]
    assert waits == "round_trip"
    assert abs(ended["x"] - begun["x"]) < 1e-3


def test_a_robot_whose_client_falls_behind_a_queue_stops_in_time(
    shared: Daemon, bus: Bus, delay: Delay, tmp_path: Path
) -> None:
    bus.at_rest()
    (tmp_path / "begin").touch()
    with bus.follow("cmd_vel_out") as applied, joystick(delay, tmp_path, 8, 6) as program:
        until(lambda: (bus.state()["linear"] or 0.0) > 0.49, 20.0, f"it drives\n{program}")
        delay.seconds, queued = QUEUE_S, time.monotonic()
        time.sleep(1.0)
        stopped = next(
            entry.at
            for entry in applied.seen
            if entry.at > queued and entry.value["twist"]["linear"]["x"] < 0.49
        )
        assert program.ended(20.0) == 0, program
        time.sleep(QUEUE_S)
        late = [entry.value["twist"]["linear"]["x"] for entry in applied.seen]
    print(f"slower {stopped - queued:.3f} s after the queue began")
    assert stopped - queued < 0.25 + 0.1
    rest = late.index(0.0, next(n for n, speed in enumerate(late) if speed > 0.4))
    assert not any(late[rest:])

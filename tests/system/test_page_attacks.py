"""The page refuses and counts each forbidden request, and the robot does not move.

With `-s` pytest prints the results as a table.
"""

from __future__ import annotations

import asyncio
import math
import os
import socket
import ssl
import time
import urllib.request
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import aiohttp
import pytest
from yarl import URL

from acsard.web.access import REQUEST_RATE
from acsard.web.app import BODY_TIMEOUT_S
from acsard.web.connections import IDLE_S, MAX_LOCAL, UNREAD_S
from tests.system.browser import NAME, Hands, Page, hands
from tests.system.bystander import lost
from tests.system.harness import (
    PATIENCE_S,
    Bus,
    Daemon,
    Periods,
    Program,
    resident_kb,
    until,
)
from tests.system.strangers import command_line

pytestmark = pytest.mark.network

MOVED_M = 0.005
"""Movement below which the robot counts as standing, m or rad."""


class Table:
    """The table of attacks and their results. Each attack checks that the robot stood still."""

    def __init__(self, page: Page, daemon: Daemon) -> None:
        self.page, self.daemon = page, daemon
        self.rows: list[str] = []

    @contextmanager
    def attack(
        self,
        what: str,
        answer: str,
        reason: str,
        times: int = 1,
        by: str = "page",
        *,
        stands: bool = True,
    ) -> Iterator[None]:
        """Run the attack in the body of the `with`, and add a row to the table.

        The page or the robot (`by`) must refuse it at least `times` times and count `reason`. The
        robot must not move, unless `stands` is false because another client may drive it.
        """
        with Bus(self.daemon.endpoint) as bus:
            before, counted = bus.comes_to("ready"), self._refused(bus, reason, by)
            yield
            after, more = bus.comes_to("ready"), self._refused(bus, reason, by) - counted
        assert more >= times
        moved = math.hypot(after["x"] - before["x"], after["y"] - before["y"])
        turned = abs(math.remainder(after["yaw"] - before["yaw"], math.tau))
        assert max(moved, turned) < MOVED_M or not stands
        refusals = f"{more:.0f} x {reason}"
        missed = Periods.between(before, after).missed
        self.rows.append(
            f"{what:44} {answer:22} {refusals:28} "
            f"{f'{1000 * moved:.0f} mm' if stands else 'driven':>6} {missed:6}"
        )

    def _refused(self, bus: Bus, reason: str, by: str) -> float:
        if by == "page":
            return self.page.refused().get(reason, 0)
        return float(bus.count(reason))


@pytest.fixture(scope="module")
def table(page: Page, daemon: Daemon) -> Iterator[Table]:
    pid, kb = page.pid, resident_kb(page.pid)
    table = Table(page, daemon)
    yield table
    print(f"\n\n{'who tries what':44} {'answer':22} {'counted as':28}  moved missed periods")
    print("\n".join(table.rows))
    assert page.process.poll() is None
    print(f"the page's process {pid} goes on, {(resident_kb(pid) - kb) / 1000:+.1f} MB")


@pytest.fixture(scope="module")
def tokens(page: Page) -> dict[str, str]:
    """Return tokens of five kinds: empty, wrong, expired, revoked, and a viewer's."""
    revoked = page.invite("maintainer", "revoked")
    page.tokens("revoke", "revoked")
    vault = page.vault
    return {
        "": "",
        "wrong": "x" * 43,
        "expired": vault.invite("maintainer", "expired", 0)[0],
        "revoked": revoked,
        "viewer": page.invite("viewer", "tv"),
    }


@pytest.fixture
def bus(standing: Bus) -> Bus:
    return standing


EVIL = {"Origin": "https://evil.example"}
UPGRADE = {
    "Connection": "Upgrade", "Upgrade": "websocket", "Sec-WebSocket-Version": "13",
    "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
}  # fmt: skip

ASKS: dict[str, tuple[str, str, dict[str, Any], int, str]] = {
    "no token": ("away", "/api/state", {}, 401, "no_token"),
    "no token on the socket": ("away", "/ws", {"headers": UPGRADE}, 401, "no_token"),
    "a wrong token": ("away", "/api/state", {"token": "wrong"}, 401, "bad_token"),
    "an expired token": ("away", "/api/state", {"token": "expired"}, 401, "bad_token"),
    "an expired token on the socket": (
        "away", "/ws", {"token": "expired", "headers": UPGRADE}, 401, "bad_token"),
    "a revoked token": ("away", "/api/srv/clear", {"token": "revoked", "method": "POST"},
        401, "bad_token"),
    "a viewer who clears": (
        "away", "/api/srv/clear", {"token": "viewer", "method": "POST"}, 403, "role"),
    "a viewer at the settings": ("away", "/api/config", {"token": "viewer"}, 403, "role"),
    "a viewer at a recording": (
        "away", "/api/recordings/1-x.rec.zst", {"token": "viewer"}, 403, "role"),
    "another page's socket": ("here", "/ws", {"headers": UPGRADE | EVIL}, 403, "origin"),
    "another page's socket, with a token": (
        "away", "/ws", {"token": "viewer", "headers": UPGRADE | EVIL}, 403, "origin"),
    "another page's post": (
        "here", "/api/srv/stop", {"method": "POST", "headers": EVIL}, 403, "origin"),
    "another page's look": (
        "here", "/api/state", {"headers": {"Sec-Fetch-Site": "cross-site"}}, 403, "origin"),
    "a name pointed at 127.0.0.1": (
        "here", "/", {"headers": {"Host": "evil.example:8080"}}, 403, "host"),
    "a name that is none of the robot's": (
        "away", "/", {"headers": {"Host": "evil.example"}}, 403, "host"),
    "localhost from elsewhere, without a token": (
        "away", "/api/state", {"headers": {"Host": NAME}}, 401, "no_token"),
    "through a proxy that says so": (
        "here", "/api/state", {"headers": {"X-Forwarded-For": "203.0.113.5"}}, 403, "proxy"),
    "through a proxy that says so otherwise": (
        "here", "/", {"headers": {"Forwarded": "for=203.0.113.5"}}, 403, "proxy"),
    "through a proxy, to the socket": (
        "here", "/ws", {"headers": UPGRADE | {"Via": "1.1 proxy"}}, 403, "proxy"),
    "a token as a form": (
        "away", "/token", {"method": "POST", "data": b"token=x",
        "headers": {"Content-Type": "application/x-www-form-urlencoded"}}, 400, "malformed"),
    "a token in JSON that is none": (
        "away", "/token", {"method": "POST", "data": b"{\xff",
        "headers": {"Content-Type": "application/json"}}, 400, "malformed"),
    "a path upwards": ("here", "/page/../app.py", {}, 404, "path"),
    "a path upwards, encoded": ("here", "/page/%2e%2e%2fapp.py", {}, 404, "path"),
    "a recording upwards": ("here", "/api/recordings/..%2f..%2fetc%2fpasswd", {}, 404, "path"),
    "a key with a wildcard": ("here", "/api/**", {}, 404, "path"),
    "a service that is none": ("here", "/api/srv/**", {"method": "POST"}, 404, "path"),
    "a body that is no JSON": (
        "here", "/api/srv/set", {"method": "POST", "data": b"\xff{"}, 400, "malformed"),
    "a body of 10 MB": (
        "here", "/api/srv/set", {"method": "POST", "data": bytes(10_000_000)}, 413, "too_big"),
}  # fmt: skip
"""A forbidden request: endpoint, path, arguments, and the expected status and reason."""


@pytest.mark.parametrize("what", ASKS)
async def test_a_request_for_a_forbidden_resource_is_refused(
    table: Table, bus: Bus, tokens: dict[str, str], what: str
) -> None:
    where, path, how, status, reason = ASKS[what]
    with table.attack(what, str(status), reason):
        method, data = how.get("method", "GET"), how.get("data")
        async with table.page.client(tokens[how.get("token", "")]) as session:
            url = URL(f"{getattr(table.page, where)}{path}", encoded=True)
            headers = how.get("headers", {})
            async with session.request(method, url, headers=headers, data=data) as answer:
                assert answer.status == status


async def test_a_flood_of_a_viewer_ends_its_connections_and_delays_no_stop_of_another(
    table: Table, bus: Bus, tokens: dict[str, str]
) -> None:
    page, url = table.page, table.page.away
    with table.attack("a viewer that floods", "its connections end", "too_fast", 8):
        phone = page.client(page.invite("operator", f"phone-{time.time_ns()}"))
        flooding = page.client(tokens["viewer"])
        async with phone, flooding, hands(page, tokens["viewer"]) as theirs:
            statuses = Counter[int]()

            async def asks() -> None:
                while True:
                    with suppress(aiohttp.ClientError):
                        async with flooding.get(f"{url}/api/state") as answer:
                            statuses[answer.status] += 1

            async with phone.get(f"{url}/api/whoami") as answer:
                assert answer.status == 200  # the server knows the token
            ending = asyncio.create_task(_drained(theirs))
            floods = [asyncio.create_task(asks()) for _ in range(7)]
            took = list[float]()
            for _ in range(20):
                begun = time.monotonic()
                async with phone.post(f"{url}/api/srv/stop") as answer:
                    assert answer.status == 200
                ended = time.monotonic()
                took.append(ended - begun - 4 * lost(begun, ended))
                await asyncio.sleep(0.1)
            for flood in floods:
                flood.cancel()
            # The one that floods may stop the robot too, and learns why its pages are closed.
            async with flooding.post(f"{url}/api/srv/stop") as answer:
                assert answer.status == 200
            await asyncio.wait_for(ending, PATIENCE_S)
            assert theirs.socket.close_code == 1008
        assert bus.get("srv/clear")["success"]
    print(f"\na stop of another token takes {1000 * max(took):.0f} ms, {statuses}")
    assert {200, 429} <= set(statuses)
    assert max(took) < 0.5


FLOOD = """\
import asyncio, aiohttp, os, ssl, sys
from contextlib import suppress
os.nice(19)
url, token, message = sys.argv[1:]

async def flood(session):
    while True:
        with suppress(aiohttp.ClientError, ConnectionError):
            async with session.ws_connect(url + "/ws", ssl=False) as socket:
                for number in range(2000):
                    await socket.send_str(message)
                async for _ in socket:
                    pass

async def main():
    headers = {"Authorization": "Bearer " + token}
    async with aiohttp.ClientSession(headers=headers) as session:
        floods = [asyncio.create_task(flood(session)) for _ in range(8)]
        await asyncio.sleep(1.0)
        print("floods", flush=True)
        await asyncio.wait(floods)

asyncio.run(main())
"""
"""Sends this message without end over eight WebSockets, each of which it opens again and again."""


@pytest.mark.parametrize("message", ['{"ping":1}', '{"call":"stop"}'], ids=["pings", "stops"])
async def test_floods_on_all_sockets_of_a_viewer_delay_no_stop_of_another(
    table: Table, bus: Bus, tokens: dict[str, str], message: str
) -> None:
    page, url = table.page, table.page.away
    with table.attack(f"floods of {message}", "its connections end", "too_fast", 8):
        phone = page.client(page.invite("operator", f"phone-{time.time_ns()}"))
        async with phone, phone.ws_connect(f"{url}/ws") as opened:
            ours = Hands(opened)

            words = command_line(FLOOD, url, tokens["viewer"], message)
            with Program(words, page.tls) as program:
                await asyncio.to_thread(program.says, "floods", PATIENCE_S)
                took = list[float]()
                for _ in range(20):
                    begun = time.monotonic()
                    assert (await ours.call("stop"))["ok"]
                    ended = time.monotonic()
                    took.append(ended - begun - 4 * lost(begun, ended))
                    await asyncio.sleep(0.1)
        await asyncio.sleep(1.5)  # the last connections end
        assert bus.get("srv/clear")["success"]
    print(f"\na stop of another token takes {1000 * max(took):.0f} ms")
    assert max(took) < 0.5


STOP = "POST /api/srv/stop HTTP/1.1\r\nHost: 127.0.0.1\r\n"

RAW: dict[str, str] = {
    "no Host": "GET /api/state HTTP/1.1\r\n\r\n",
    "two Hosts": "GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nHost: evil.example\r\n\r\n",
    "two lengths of a body": f"{STOP}Content-Length: 2\r\nContent-Length: 50\r\n\r\n{{}}",
    "a length, and pieces": (
        f"{STOP}Content-Length: 4\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\n{STOP}\r\n"),
    "pieces, with a blank before the colon": (
        f"{STOP}Transfer-Encoding : chunked\r\n\r\n0\r\n\r\n"),
    "a header folded over two lines": f"{STOP}X-A: b\r\n Content-Length: 4\r\n\r\n",
    "a head of 100 kB": f"{STOP}X: {'x' * 100_000}\r\n\r\n",
    "no HTTP": "\x16\x03\x01\x02\r\n\r\n",
}  # fmt: skip
"""Bytes on a connection that are not a request, or that another server would read as two."""


@pytest.mark.parametrize("what", RAW)
def test_a_malformed_request_is_refused_as_a_whole(table: Table, bus: Bus, what: str) -> None:
    # The robot is ready at the end: no second request, for a stop, was found in the first.
    reason = "host" if what == "no Host" else "malformed"
    with table.attack(what, "400", reason), _opened(table.page) as opened:
        opened.sendall(RAW[what].encode("latin-1"))
        answer = opened.recv(4096)
        assert answer.split()[1] == b"400", answer
        assert b"application/json" in answer
        assert b"nosniff" in answer


def _opened(page: Page) -> socket.socket:
    return socket.create_connection(("127.0.0.1", int(page.here.rpartition(":")[2])), 30.0)


async def test_a_viewer_moves_nothing_with_any_message(
    table: Table, bus: Bus, tokens: dict[str, str]
) -> None:
    commands = bus.count("commands")
    with table.attack("a viewer who drives", "told that he may not", "role", 21):
        async with hands(table.page, tokens["viewer"]) as theirs:
            for _ in range(20):
                await theirs.drive(0.5)
                await asyncio.sleep(0.02)
            refused = await theirs.find(lambda frame: frame.get("refused") == "cmd")
            assert "viewer" in refused["reason"]
            assert not (await theirs.call("set", settings={"limits.linear_speed": 9.0}))["ok"]
    assert bus.count("commands") == commands


async def _introduce_sender(ours: Hands, bus: Bus) -> None:
    """Drive briefly, so that the robot knows this sender and its clock. Then stop."""
    await ours.say(subscribe="state", rate=50)
    await ours.until_driving(0.3)
    await ours.drive(0.0)
    bus.at_rest()


@pytest.mark.parametrize(
    ("what", "late_s", "reason"),
    [
        ("100 stamps from before", 5.0, "command_stale"),
        # Early stamps that went on for the source's timeout, 0.25 s, would be a clock that was set.
        ("8 stamps of tomorrow", -86400.0, "command_early"),
    ],
)
async def test_a_command_with_a_stale_or_future_stamp_is_not_obeyed(
    table: Table, bus: Bus, what: str, late_s: float, reason: str
) -> None:
    number = int(what.split()[0])
    async with hands(table.page) as ours:
        await _introduce_sender(ours, bus)
        # Of commands that wait at the page, only the newest is sent.
        with table.attack(what, "not obeyed", reason, number // 2, "robot"):
            for _ in range(number):
                await ours.drive(0.5, late_ms=1000 * late_s)
                await asyncio.sleep(0.01)
            await asyncio.sleep(0.3)


@pytest.mark.parametrize("size", [100_000, 10_000_000])
async def test_a_message_that_is_too_big_ends_its_connection_and_no_other(
    table: Table, bus: Bus, size: int
) -> None:
    page = table.page
    with table.attack(f"a message of {size / 1e6:g} MB", "its connection ends", "too_big"):
        async with hands(page) as ours, hands(page) as theirs:
            before = resident_kb(page.pid)
            with suppress(ConnectionError):  # closed while it is still being sent
                await theirs.socket.send_str("x" * size)
            async with asyncio.timeout(PATIENCE_S):
                while (await theirs.socket.receive()).type == aiohttp.WSMsgType.TEXT:
                    pass
            await ours.say(ping=1)
            await ours.find(lambda frame: "pong" in frame)
            assert resident_kb(page.pid) < before + 5_000


async def test_a_frame_that_is_not_a_message_is_reported_once_a_second_and_a_flood_ends(
    table: Table, bus: Bus
) -> None:
    most = int(REQUEST_RATE.burst)
    with table.attack("many messages that are none", "its connection ends", "malformed", most):
        async with hands(table.page) as ours:
            for _ in range(4 * most):
                await ours.socket.send_str("{}")
            async with asyncio.timeout(PATIENCE_S):
                frames = []
                while (message := await ours.socket.receive()).type == aiohttp.WSMsgType.TEXT:
                    frames.append(message.data)
            assert ours.socket.close_code == 1008
            assert (
                0 < sum("refused" in entry for entry in frames) < most // 2
            )  # limited by the rate


async def test_a_thousand_connections_do_not_disconnect_the_page_that_drives(
    table: Table, bus: Bus
) -> None:
    page = table.page
    place = page.here.removeprefix("http://").split(":")
    async with hands(page) as ours:
        await ours.say(subscribe="state", rate=50)
        few = 1000 - MAX_LOCAL
        with table.attack("1000 connections", "64 have places", "crowded", few, stands=False):
            await ours.until_driving(0.3)
            holding = asyncio.create_task(ours.hold(0.3, PATIENCE_S))
            idle = await _idle(place[0], int(place[1]), 1000)
            await ours.say(ping=7)
            await ours.find(lambda frame: frame.get("pong") == 7)
            await ours.state(lambda s: s["mode"] == "driving")
            async with asyncio.timeout(PATIENCE_S):
                while sum(map(_waits, idle)) >= MAX_LOCAL:  # one place is that of the page
                    await asyncio.sleep(0.01)
            holding.cancel()
            for idle_socket in idle:
                idle_socket.close()
            await ours.drive(0.0)
            bus.at_rest()


async def _idle(host: str, port: int, number: int) -> list[socket.socket]:
    """Open `number` connections that send nothing, and return their sockets."""
    idle: list[socket.socket] = []
    for _ in range(number):
        connection = socket.socket()
        connection.setblocking(False)
        await asyncio.get_running_loop().sock_connect(connection, (host, port))
        idle.append(connection)
    return idle


def _waits(sock: socket.socket) -> bool:
    """Return whether the server still keeps this connection open."""
    try:
        return sock.recv(1) != b""
    except BlockingIOError:
        return True
    except ConnectionError:
        return False


def test_a_browser_with_many_cookies_of_other_ports_gets_the_page(table: Table) -> None:
    asked = urllib.request.Request(table.page.here, headers={"Cookie": "other=" + "x" * 7000})
    with urllib.request.urlopen(asked, timeout=PATIENCE_S) as answer:
        assert answer.status == 200


@pytest.mark.parametrize("before", [b"", b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"])
def test_a_head_without_an_end_is_cut_off(table: Table, bus: Bus, before: bytes) -> None:
    """Send endless headers, in the first request of a connection or in the second.

    Otherwise clients without a token could fill the memory.
    """
    sent = 0
    with (
        table.attack("headers without an end", "cut off", "malformed"),
        _opened(table.page) as greedy, suppress(ConnectionError),
    ):  # fmt: skip
        greedy.sendall(before)
        if before:
            assert greedy.recv(100).startswith(b"HTTP/1.1 200")
        greedy.sendall(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n")
        for number in range(200):
            greedy.sendall(b"X-%d: " % number + b"x" * 3000 + b"\r\n")
            sent += 3000
            time.sleep(0.005)
    assert sent < 300_000


@pytest.mark.parametrize("headers", [0, 28])
@pytest.mark.nightly
def test_answers_that_no_client_reads_cost_little_memory(
    table: Table, bus: Bus, headers: int
) -> None:
    """Sixty clients without a token send requests all the time, and read no answer."""
    page, place = table.page, URL(table.page.away)
    trusting = ssl._create_unverified_context()
    request = f"GET /x HTTP/1.1\r\nHost: {place.host}:{place.port}\r\n" + "".join(
        f"X-{n}: {'x' * 200}\r\n" for n in range(headers)
    )
    payload = (request + "\r\n").encode() * 20
    with ExitStack() as stack:
        greedy = []
        for _ in range(60):
            client = socket.socket()
            client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            client.connect(("127.0.0.1", place.port))
            greedy.append(stack.enter_context(trusting.wrap_socket(client)))
            greedy[-1].setblocking(False)
        before, most, end = resident_kb(page.pid), 0, time.monotonic() + UNREAD_S - 1.0
        while time.monotonic() < end:
            for client in greedy:
                with suppress(OSError):
                    client.send(payload)
            most = max(most, resident_kb(page.pid) - before)
            time.sleep(0.01)
    print(f"\n60 clients that read no answers, {headers} more headers: {most / 1000:+.1f} MB")
    assert most < 36_000


async def test_a_viewer_that_floods_with_pings_is_cut_off(
    table: Table, bus: Bus, tokens: dict[str, str]
) -> None:
    with table.attack("a flood of pings", "cut off", "too_fast"):
        async with hands(table.page, tokens["viewer"]) as theirs:
            with suppress(ConnectionError):
                for _ in range(30_000):
                    await theirs.socket.ping()
            await asyncio.wait_for(_drained(theirs), PATIENCE_S)
            assert theirs.socket.closed


@pytest.mark.nightly
def test_a_slow_or_silent_client_is_disconnected(table: Table, bus: Bus) -> None:
    """One client sends a byte a second, one sends nothing, one announces a body and sends none."""
    begun = time.monotonic()
    with (
        table.attack("a slow loris, and who says nothing", "cut off", "malformed"),
        _opened(table.page) as drips, _opened(table.page) as says_nothing,
        _opened(table.page) as keeps,
    ):  # fmt: skip
        keeps.sendall(b"POST /api/srv/clear HTTP/1.1\r\nHost: 127.0.0.1\r\n")
        keeps.sendall(b"Content-Length: 100\r\n\r\n")
        drips.settimeout(1.0)
        with suppress(ConnectionError):
            for byte in b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX-Slow: very":
                drips.sendall(bytes([byte]))
                with suppress(TimeoutError):
                    assert drips.recv(4096) == b""
                    break
            else:
                raise AssertionError("the server did not cut it off")
        with suppress(ConnectionError):
            assert says_nothing.recv(4096) == b""
        answer = keeps.recv(4096)
    assert answer.startswith(b"HTTP/1.1 408"), answer
    assert time.monotonic() - begun < max(BODY_TIMEOUT_S, IDLE_S) + PATIENCE_S


def test_a_client_that_does_not_read_its_answers_is_disconnected_soon(
    table: Table, bus: Bus
) -> None:
    place = Path(f"/proc/{table.page.pid}/fd")
    with socket.socket() as greedy:
        greedy.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        greedy.connect(("127.0.0.1", int(table.page.here.rpartition(":")[2])))
        ours = f":{greedy.getsockname()[1]:04X} "

        def held() -> bool:
            """Return whether the server still has the connection."""
            lines = Path("/proc/net/tcp").read_text().splitlines()
            (inode,) = [line.split()[9] for line in lines if ours in line.split()[2] + " "] or ["0"]
            with suppress(FileNotFoundError):  # the server closes another file meanwhile
                return any(os.readlink(link) == f"socket:[{inode}]" for link in place.iterdir())
            return True

        greedy.setblocking(False)
        with suppress(BlockingIOError):
            for _ in range(100_000):
                greedy.send(b"GET /page/main.js HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        until(held, PATIENCE_S, "it is accepted")
        until(lambda: not held(), UNREAD_S + PATIENCE_S / 3, "it is disconnected")
    assert "Traceback" not in table.page.stderr


async def _drained(ours: Hands) -> None:
    async for _ in ours.socket:
        pass

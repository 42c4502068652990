"""One WebSocket: a page in a browser, or a program; a commander of its own.

What comes is taken at once and never waits for what goes out: a client that does not read still
drives and stops. What goes out is the newest, as often as was asked for, and is left out while the
client has not read what went before.
"""

from __future__ import annotations

import asyncio
import secrets
from collections import deque
from collections.abc import Coroutine
from typing import Any

import aiohttp
import msgspec
from aiohttp import web

from acsard.bus.access import MAY
from acsard.bus.address import require_id
from acsard.host import clock
from acsard.host.errors import UsageError
from acsard.values import NS_PER_S
from acsard.web.calls import Calls, RefusedError
from acsard.web.counts import Counts
from acsard.web.fleet import Fleet
from acsard.web.frames import (
    Call,
    Command,
    Frame,
    FrameError,
    Ping,
    Subscribe,
    Unsubscribe,
    decode,
)
from acsard.web.hand import Hand, Order
from acsard.web.limits import MESSAGES_AT_ONCE, MESSAGES_HZ, OVERRUNS, Bucket
from acsard.web.robots import Robots
from acsard.web.streams import KEYS, Stream
from acsard.web.who import Reason, Who

HEARTBEAT_S = 10.0
"""A client that has not answered for half of this is gone."""

UNREAD_BYTES = 32768
"""More than this not yet read by the client: it gets nothing new until it has."""

UNREAD_FRAMES = 200
"""Answers that wait to go out; the oldest are dropped beyond."""

KEYS_AT_ONCE, CALLS_AT_ONCE = 32, 8

FRAMES_HZ = 300.0
"""Of all keys of one connection together: nobody who looks takes the time of who drives."""

DROVE_NS = NS_PER_S
"""Whose last command is older drives no more."""

FLEET, FLEET_S = "fleet", 1.0

LOOK_S = 0.25
"""How soon it is told that the robot is not heard any more."""

TELL_NS = NS_PER_S
"""A refusal of one reason is told so often at most; all are counted."""


class Following:
    """A key that is sent, and when it is due."""

    def __init__(self, robot: str, name: str, own: str, period: float) -> None:
        """`own` is the id of the robot whose page it is: of that one the id goes without saying."""
        self.robot, self.name, self.period = robot, name, period
        told = {"key": name} if robot == own else {"key": name, "robot": robot}
        self.head = msgspec.json.encode(told)[:-1] + b',"value":'
        self.stream: Stream | None = None
        self.sent = 0
        self.due = 0.0


class Viewer:
    """Lives as long as its connection."""

    def __init__(
        self,
        socket: web.WebSocketResponse,
        request: web.Request,
        who: Who,
        robots: Robots,
        hand: Hand,
        calls: Calls,
        fleet: Fleet,
        counts: Counts,
    ) -> None:
        self.who = who
        self.sender = f"{who.name[:40]}/{secrets.token_hex(4)}"
        self._socket, self._transport = socket, request.transport
        self._robots, self._hand, self._calls = robots, hand, calls
        self._fleet, self._counts = fleet, counts
        self._bucket = Bucket(MESSAGES_HZ, MESSAGES_AT_ONCE, clock.mono_ns())
        self._overruns = self._calling = 0
        self._out: deque[bytes] = deque(maxlen=UNREAD_FRAMES)
        self._news = asyncio.Event()
        self._following: dict[tuple[str, str], Following] = {}
        self._tasks: set[asyncio.Task[None]] = set()
        self._told: dict[str, int] = {}
        self._last: Order | None = None
        self._sequence = 0
        self._gone, self._about = "", robots.about
        self._fleet_due: float | None = None

    async def run(self) -> None:
        """Until it ends, by whomever."""
        self._greet()
        self._say(self._robots.way())
        pump = asyncio.create_task(self._pump())
        try:
            async for message in self._socket:
                if not await self._take(message):
                    break
        finally:
            # First of all: who drove and is gone drives no more.
            self._release()
            pump.cancel()
            for task in list(self._tasks):
                task.cancel()
            for one in list(self._following.values()):
                await self._leave(one)
            self._fleet.leave(self)

    def end(self, why: str) -> None:
        """Close it from outside; `why` is at most 120 characters."""
        self._release()
        self._start(self._close(why))

    # what comes

    async def _take(self, message: aiohttp.WSMessage) -> bool:
        """One message; False when the connection is over."""
        if message.type == aiohttp.WSMsgType.ERROR:
            self._counts.refuse("too_big")
            return False
        if message.type != aiohttp.WSMsgType.TEXT:
            self._refuse("message", "malformed", "messages are JSON as text")
            return True
        room = self._bucket.take(clock.mono_ns())
        try:
            frame = decode(message.data)
        except FrameError as error:
            self._refuse(error.about, "malformed", str(error))
            return room or await self._overrun()
        if not room and not (isinstance(frame, Call) and frame.call == "stop"):
            self._refuse("message", "too_fast", f"over {MESSAGES_HZ:g} messages a second")
            return await self._overrun()
        self._obey(frame)
        return True

    async def _overrun(self) -> bool:
        self._overruns += 1
        if self._overruns < OVERRUNS:
            return True
        await self._close("too many messages")
        return False

    def _obey(self, frame: Frame) -> None:
        match frame:
            case Command():
                self._command(frame)
            case Call():
                self._call(frame)
            case Ping():
                now = clock.now().wall_ns / 1e6
                self._say({"pong": frame.ping, "now": now})
            case Subscribe():
                self._subscribe(frame)
            case Unsubscribe():
                self._unsubscribe(frame)

    def _command(self, frame: Command) -> None:
        if not self.who.may("operator"):
            self._refuse("cmd", "role", f"you are {self.who.role}: {MAY[self.who.role]}")
            return
        if self._last is not None and frame.stamp_ns <= self._last.stamp_ns:
            self._refuse("cmd", "replayed", "stamp must be later than that of the command before")
            return
        self._sequence += 1
        twist, now_ns = frame.cmd, clock.mono_ns()
        self._last = Order(
            self.sender, twist.linear_x, twist.angular_z, frame.stamp_ns, self._sequence, now_ns
        )
        self._hand.give(self._last)

    def _release(self) -> None:
        """One zero of one who drove, meant now by his own clock; nobody sends him any more."""
        last, self._last = self._last, None
        now_ns = clock.mono_ns()
        # One who fell silent before has been let go of: a zero now would only be in others' way.
        if last is None or not last.moves or now_ns - last.given_ns > DROVE_NS:
            return
        stamp_ns = last.stamp_ns + now_ns - last.given_ns
        self._sequence += 1
        self._hand.give(Order(self.sender, 0.0, 0.0, stamp_ns, self._sequence, now_ns))

    def _call(self, frame: Call) -> None:
        if frame.call != "stop":
            if self._calling >= CALLS_AT_ONCE:
                self._refuse("call", "too_fast", f"{CALLS_AT_ONCE} calls are under way")
                return
            self._calling += 1
        self._start(self._answer(frame))

    async def _answer(self, frame: Call) -> None:
        try:
            reply = await self._calls.call(self.who, frame.call, frame.payload)
            ok, text = reply.success, reply.message
        except RefusedError as error:
            self._counts.refuse("role" if error.role else "malformed")
            ok, text = False, str(error)
        finally:
            if frame.call != "stop":
                self._calling -= 1
        self._say({"answer": frame.id, "ok": ok, "text": text})

    def _subscribe(self, frame: Subscribe) -> None:
        if frame.subscribe == FLEET:
            self._fleet_due = 0.0
            self._start(self._fleet.join(self))
            self._news.set()
            return
        robot, key = frame.robot or self._robots.id, frame.subscribe
        try:
            require_id(robot)
        except UsageError as error:
            self._refuse("subscribe", "malformed", str(error))
            return
        if key not in KEYS:
            self._refuse("subscribe", "malformed", f"{key!r} is none of {', '.join(sorted(KEYS))}")
            return
        known = self._following.get((robot, key))
        others = sum(1.0 / one.period for one in self._following.values() if one is not known)
        if others + frame.rate > FRAMES_HZ:
            self._refuse("subscribe", "too_many", f"{FRAMES_HZ:g} messages a second in all")
            return
        if known is not None:
            known.period, known.due = 1.0 / frame.rate, 0.0
            self._news.set()
            return
        if len(self._following) >= KEYS_AT_ONCE:
            self._refuse("subscribe", "too_many", f"{KEYS_AT_ONCE} keys at most")
            return
        one = Following(robot, key, self._robots.id, 1.0 / frame.rate)
        self._following[robot, key] = one
        self._start(self._join(one))

    def _unsubscribe(self, frame: Unsubscribe) -> None:
        if frame.unsubscribe == FLEET:
            self._fleet_due = None
            self._fleet.leave(self)
            return
        one = self._following.get((frame.robot or self._robots.id, frame.unsubscribe))
        if one is not None:
            self._start(self._leave(one))

    async def _join(self, one: Following) -> None:
        while self._robots.client is None:
            await asyncio.sleep(0.2)
        try:
            stream = await self._robots.streams.follow(self._robots.client, one.robot, one.name)
        except TimeoutError:
            stream = None
        if stream is None:
            self._following.pop((one.robot, one.name), None)
            self._refuse("subscribe", "too_many", "the bus is stuck, or has no room: try again")
            return
        if self._following.get((one.robot, one.name)) is not one:  # left meanwhile
            await self._robots.streams.leave(one.robot, one.name)
            return
        one.stream = stream
        self._news.set()

    async def _leave(self, one: Following) -> None:
        if self._following.pop((one.robot, one.name), None) is not None and one.stream is not None:
            one.stream = None
            await self._robots.streams.leave(one.robot, one.name)

    # what goes out

    def _greet(self) -> None:
        about = self._about = self._robots.about
        self._say(
            {
                "hello": {
                    "robot": self._robots.id,
                    "version": about.version,
                    "role": self.who.role,
                    "sender": self.sender,
                    "limits": {"linear": about.linear, "angular": about.angular},
                    "simulated": about.simulated,
                }
            }
        )

    def _say(self, message: object) -> None:
        self._out.append(msgspec.json.encode(message))
        self._news.set()

    def _refuse(self, what: str, reason: Reason, text: str) -> None:
        self._counts.refuse(reason)
        now_ns = clock.mono_ns()
        if now_ns - self._told.get(reason, -TELL_NS) >= TELL_NS:
            self._told[reason] = now_ns
            self._say({"refused": what, "reason": text})

    async def _pump(self) -> None:
        loop = asyncio.get_running_loop()
        try:
            while True:
                self._news.clear()
                await self._send_what_waits()
                now = loop.time()
                due = [await self._send_due(one, now) for one in list(self._following.values())]
                due.append(self._look_around(now))
                timer = loop.call_at(min(due), self._news.set)
                try:
                    await self._news.wait()
                finally:
                    timer.cancel()
        except ConnectionError:
            pass  # it is closing, which `run` sees

    async def _send_what_waits(self) -> None:
        while self._out:
            await self._socket.send_frame(self._out.popleft(), aiohttp.WSMsgType.TEXT)

    async def _send_due(self, one: Following, now: float) -> float:
        """Send it if it is time and there is news; when it is due next, by the loop's clock."""
        stream = one.stream
        if stream is None:
            return now + one.period  # `_join` says when it is there
        if one.due > now:
            return one.due
        # On a grid that all share: they wake up together.
        one.due = (now // one.period + 1) * one.period
        if stream.number != one.sent:
            if self._unread() > UNREAD_BYTES:
                self._counts.add("frames_left_out")
            else:
                one.sent, value, age = stream.value()
                frame = b'%b%b,"age":%.1f}' % (one.head, value, age)
                await self._socket.send_frame(frame, aiohttp.WSMsgType.TEXT)
        return one.due

    def _look_around(self, now: float) -> float:
        """Is the robot heard, who else is there; when to look again."""
        if self._robots.gone != self._gone:
            self._gone = self._robots.gone
            if self._gone:
                self._say({"gone": self._gone})
        if self._robots.about is not self._about:
            self._greet()
        if self._fleet_due is not None and now >= self._fleet_due:
            self._fleet_due = now + FLEET_S
            self._say({"fleet": self._fleet.rows()})
        return now + LOOK_S

    def _unread(self) -> int:
        return 0 if self._transport is None else self._transport.get_write_buffer_size()

    async def _close(self, why: str) -> None:
        await self._socket.close(code=aiohttp.WSCloseCode.POLICY_VIOLATION, message=why.encode())

    def _start(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

"""Serves one WebSocket of a page or a program. To the daemon, each WebSocket is one sender.

Incoming messages never wait for outgoing messages. So a client that reads nothing can still stop
the robot.
"""

from __future__ import annotations

import asyncio

import aiohttp
from aiohttp import web

from acsard.client.ride import MAX_SOURCE_TIMEOUT_S
from acsard.client.signing import CommandSigner
from acsard.core.messages.permissions import COMMAND_ROLE, SERVICE_ROLES
from acsard.core.messages.signature import public_name
from acsard.core.throttle import Throttle
from acsard.core.values import Role, Twist
from acsard.host import clock
from acsard.host.own_identity import sender_id
from acsard.web import socket_messages
from acsard.web.access import FLOOD_TEXT, REQUEST_RATE
from acsard.web.callers import AdmittedClient, RequestRefusedError
from acsard.web.calls import Calls
from acsard.web.followed_robot import FollowedRobot
from acsard.web.metrics import Counts
from acsard.web.outbox import Outbox, Relay, Wish
from acsard.web.routes import RECORDINGS_ROLE
from acsard.web.socket_messages import (
    Call,
    Command,
    Frame,
    FrameError,
    Ping,
    Subscribe,
    Unsubscribe,
    asks_to_stop,
    decode,
)
from acsard.web.socket_sender import Outgoing

# The page disables the controls of the actions that its user's role does not allow.
ACTIONS: dict[str, Role] = {
    **{str(verb): role for verb, role in SERVICE_ROLES.items()},
    "drive": COMMAND_ROLE,
    "recordings": RECORDINGS_ROLE,
}

# The connection ends if the client does not answer a ping within half of this time.
PING_INTERVAL_S = 10.0


class Parts:
    """What `Page` and all viewers share, such as the connection to the daemon."""

    def __init__(self, robot: FollowedRobot, counts: Counts) -> None:
        self.robot, self.counts = robot, counts
        self.outbox = Outbox(lambda: robot.client, counts)
        self.calls = Calls(robot)


class Viewer:
    """A client that is connected by a WebSocket: a page in a browser, or a program."""

    def __init__(
        self,
        socket: web.WebSocketResponse,
        request: web.Request,
        who: AdmittedClient,
        parts: Parts,
        *,
        camera: bool,
    ) -> None:
        self.who, self._camera = who, camera
        self._robot, self._outbox, self._calls = parts.robot, parts.outbox, parts.calls
        self._counts = parts.counts
        whole = sender_id(who.name)
        self._signer, self._relays = CommandSigner(whole), dict[str, Relay]()
        # Public name, in `state.sender` while the client drives; the sender id stays secret.
        self.sender = public_name(whole, parts.robot.certificate)
        self._socket = socket
        self._rate = Throttle()
        self._out = Outgoing(socket, request, parts.robot.streams, parts.counts, who.origin)
        # A call, the stops and the end, each while it is under way.
        self._calling: asyncio.Task[None] | None = None
        self._stopping: asyncio.Task[None] | None = None
        self._ending: asyncio.Task[None] | None = None
        self._stop_ids: list[int | str] = []
        self._unreachable_reason, self._about = "", parts.robot.about
        self._greeting: socket_messages.Greeting | None = None  # the last one

    async def run(self) -> None:
        self._greet()
        self._out.enqueue(socket_messages.DrivenPath(self._robot.path.points()))
        pump = asyncio.create_task(self._out.pump(self._look_around))
        try:
            async for message in self._socket:
                self._take(message)
                # While messages wait, the loop itself would not yield: a flood of empty frames
                # delayed the stop of another client by 6 s.
                await asyncio.sleep(0)
        finally:
            # Stop the robot first, because this viewer may have been driving.
            self._release()
            pump.cancel()
            if self._calling is not None:
                self._calling.cancel()
            self._out.unsubscribe_all()

    def end(self, why: str) -> None:
        """Stop the robot if this viewer may still drive it, and close the connection.

        The client receives the reason, at most 120 characters.
        """
        if self._ending is None:
            self._release()
            self._ending = asyncio.create_task(self._out.close(why))

    # Incoming messages.

    def _take(self, message: aiohttp.WSMessage) -> None:
        if self._ending is not None:  # after the close frame, only a stop counts
            is_text = message.type == aiohttp.WSMsgType.TEXT
            if is_text and not self._stop_ids and asks_to_stop(message.data):
                self._obey(Call("stop"))
            return
        if message.type == aiohttp.WSMsgType.ERROR:  # aiohttp closes the connection after this
            self._counts.refuse("too_big", self.who.origin)
            return
        room = self._rate.take(clock.mono_ns(), REQUEST_RATE)
        if message.type == aiohttp.WSMsgType.PING:
            self._out.pong(message.data)
        elif message.type == aiohttp.WSMsgType.TEXT:
            self._take_text(message.data, room=room)
        elif message.type != aiohttp.WSMsgType.PONG:
            self._out.refuse("message", "malformed", "messages must be JSON in text frames")
        if not room:
            self._counts.refuse("too_fast", self.who.origin)
            self.end(f"messages of this WebSocket: {FLOOD_TEXT}")

    def _take_text(self, text: str, *, room: bool) -> None:
        try:
            frame = decode(text)
        except FrameError as error:
            self._out.refuse(error.about, "malformed", str(error))
            if not asks_to_stop(text):
                return
            frame = Call("stop")
        # A message that ends a drive or stops the robot is obeyed even beyond the limit.
        is_stop = isinstance(frame, Call) and frame.call == "stop"
        if room or is_stop or (isinstance(frame, Command) and not frame.moves):
            self._obey(frame)

    def _obey(self, frame: Frame) -> None:
        try:
            self.who.require(frame.least, frame.kind)
        except RequestRefusedError as error:
            self._out.refuse(frame.kind, error.reason, str(error))
            return
        match frame:
            case Command():
                self._command(frame)
            case Call():
                self._call(frame)
            case Ping():
                now = clock.now().wall_ns / 1e6
                self._out.enqueue(socket_messages.Pong(frame.ping, now))
            case Subscribe():
                self._out.subscribe(frame.subscribe, frame.rate)
            case Unsubscribe():
                self._out.unsubscribe(frame.unsubscribe)

    def _command(self, frame: Command) -> None:
        if frame.source not in self._robot.about.timeouts:
            names = ", ".join(self._robot.about.timeouts)
            text = f"{frame.source} is not one of the robot's sources: {names}"
            self._out.refuse("cmd", "malformed", text)
            return
        twist = Twist(frame.cmd.linear_x, frame.cmd.angular_z)
        relay = self._relays.setdefault(frame.source, Relay(frame.source, self._signer))
        self._outbox.take(relay, Wish(twist, frame.stamp_ns, frame.echo))

    def _release(self) -> None:
        timeouts = self._robot.about.timeouts
        for source, relay in self._relays.items():
            self._outbox.release(relay, timeouts.get(source, MAX_SOURCE_TIMEOUT_S))

    def _call(self, frame: Call) -> None:
        if frame.call == "stop":
            self._stop_ids.append(frame.id)
            if self._stopping is None or self._stopping.done():
                # It continues when the connection ends.
                self._stopping = asyncio.create_task(self._stop())
        elif self._calling is not None and not self._calling.done():
            self._counts.refuse("too_fast", self.who.origin)
            text = "another call of this WebSocket is under way: wait for its answer"
            self._out.enqueue(socket_messages.Answer(frame.id, False, text))
        else:
            self._calling = asyncio.create_task(self._answer(frame))

    async def _stop(self) -> None:
        while self._stop_ids:  # all that arrived during one stop share the next
            ids, self._stop_ids = self._stop_ids, []
            ok, text = await self._reply(Call("stop"))
            for number in ids:
                self._out.enqueue(socket_messages.Answer(number, ok, text))

    async def _answer(self, frame: Call) -> None:
        ok, text = await self._reply(frame)
        self._out.enqueue(socket_messages.Answer(frame.id, ok, text))

    async def _reply(self, frame: Call) -> tuple[bool, str]:
        try:
            reply = await self._calls.call(self.who, frame.call, frame.payload)
        except RequestRefusedError as error:
            self._counts.refuse(error.reason, self.who.origin)
            return False, str(error)
        return reply.success, reply.message

    # Outgoing messages.

    def _greet(self) -> None:
        about = self._about = self._robot.about
        greeting = socket_messages.Greeting(
            self._robot.id,
            about.version,
            self.who.role,
            self.sender,
            socket_messages.Limits(about.linear, about.angular),
            about.simulated,
            about.state_hz,
            {
                what: self.who.why_not_allowed(least)
                for what, least in ACTIONS.items()
                if not self.who.may(least)
            },
            self._camera,
        )
        if greeting != self._greeting:
            self._greeting = greeting
            self._out.enqueue(socket_messages.Hello(greeting))

    def _look_around(self, now: float) -> float:
        if self._robot.gone != self._unreachable_reason:
            self._unreachable_reason = self._robot.gone
            if self._unreachable_reason:
                self._out.enqueue(socket_messages.DaemonUnreachable(self._unreachable_reason))
        if self._robot.about is not self._about:
            self._greet()
        return now + 0.25

"""The robot of this page: the way to it, what is known of it, and when it is not heard."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

import msgspec
from msgspec import Struct

from acsard.bus.address import Address
from acsard.bus.certificates import shown_at
from acsard.client import Client
from acsard.host import clock
from acsard.host.errors import MendableError, UnreachableError
from acsard.host.threads import in_thread
from acsard.messages.encodings import DecodeError, Decoder
from acsard.messages.schema import Info, PoseStamped, RobotState, Twist, TwistStamped
from acsard.values import NS_PER_S
from acsard.web.counts import Counts
from acsard.web.minute import Minute, Plotted
from acsard.web.streams import UNREADY, Stream, Streams
from acsard.web.trail import Trail

LOOK_S = 0.1
"""How often the newest state is looked at."""

AGAIN_S = 1.0
"""Until the next try to reach a daemon that is not there."""

ASK_S, ASK_SOON_S = 10.0, 1.0
"""How often it is asked who it is: once it has answered, and until then."""

MISSING = 3
"""So many states that did not come are a silence; at least `SILENT_S`."""

SILENT_S = 1.5

WISHED_NS = 2 * NS_PER_S
"""What was wished longer ago says nothing of now."""

Connect = Callable[[], Client]
"""Opens the way to the daemon, or raises `UnreachableError`; blocks."""


class About(Struct, frozen=True):
    """What the daemon says of itself."""

    version: str
    simulated: bool
    linear: float
    """m/s, the highest."""
    angular: float
    """rad/s, the highest."""
    state_hz: float
    recordings: str
    """The directory of the black box, "" without one."""


class Robots:
    """Reaches the daemon, and keeps what a new page has to know at once."""

    def __init__(self, address: Address, connect: Connect, about: About, counts: Counts) -> None:
        """`about` is what the configuration here says, until the daemon answers."""
        self.id, self.endpoint = address.robot_id, address.endpoint
        self.certificate = shown_at(address.endpoint, address.tls)
        """The common name under which the viewers' commands go, "" without a certificate."""
        self.about = about
        self.client: Client | None = None
        self.streams = Streams()
        self.gone = f"no daemon answers at {address.endpoint} yet"
        """Why nothing is heard of the robot, in words; "" while it is."""
        self._connect, self._counts = connect, counts
        self._trails = {"path": Trail(), "truth": Trail()}
        self._minute = Minute()
        self._states, self._poses = Decoder(RobotState), Decoder(PoseStamped)
        self._wishes = Decoder(TwistStamped)
        self._asks = asyncio.Event()
        self.state: RobotState | None = None

    async def run(self) -> None:
        """Until cancelled. Raises a `MendableError` that waiting does not mend."""
        self.client = await self._reached()
        asking = asyncio.create_task(self._ask_again_and_again())
        try:
            await self._watch(await self._following("state"))
        finally:
            asking.cancel()

    def ask_anew(self) -> None:
        """What the daemon says of itself has changed."""
        self._asks.set()

    def way(self) -> dict[str, list[tuple[float, float]]]:
        """Where it was in the last minutes, and truly was if that is known."""
        return {name: trail.points() for name, trail in self._trails.items()}

    def minute(self) -> Plotted:
        """What the plots show, of the last minute."""
        return self._minute.plotted(clock.mono_ns())

    async def _reached(self) -> Client:
        while True:
            try:
                return await in_thread(self._connect, None)
            except UnreachableError as error:
                self.gone = str(error)
                await asyncio.sleep(AGAIN_S)

    async def _following(self, key: str) -> Stream:
        assert self.client is not None
        while True:
            try:
                return await self.streams.follow(self.client, self.id, key)
            except UNREADY:
                self.gone = "the bus is stuck; it is tried again"
                await asyncio.sleep(AGAIN_S)

    async def _watch(self, states: Stream) -> None:
        seen, heard_ns, truth = 0, 0, None
        while True:
            now_ns = clock.mono_ns()
            if states.number != seen:
                seen, heard_ns = states.number, now_ns
                self._take(states, now_ns)
            silence_ns = max(SILENT_S, MISSING / self.about.state_hz) * NS_PER_S
            quiet = now_ns - heard_ns > silence_ns
            if quiet and (seen or not self.gone):
                self.gone = f"nothing is heard of the daemon at {self.endpoint}: does it run?"
            elif not quiet and self.gone:
                self.gone = ""
                self.ask_anew()
            if self.about.simulated and truth is None:
                truth = await self._following("sim/pose")
            if truth is not None:
                self._take_truth(truth, now_ns)
            await asyncio.sleep(LOOK_S)

    def _take(self, states: Stream, now_ns: int) -> None:
        before = self.state
        try:
            state = self.state = self._states.decode(*(states.raw() or ("", b"")))
        except DecodeError:
            self._counts.add("unreadable")
            return
        if before is not None and state.counters.get("lines", 0) < before.counters.get("lines", 0):
            self._trails = {name: Trail() for name in self._trails}  # another daemon
        self._trails["path"].add(now_ns, state.x, state.y)
        if self._minute.due(states.at_ns):
            self._minute.add(states.at_ns, state, self._wished(now_ns))

    def _wished(self, now_ns: int) -> Twist | None:
        """What the robot is to do now, where somebody follows that here."""
        stream = self.streams.followed(self.id, "cmd_vel_out")
        raw = None if stream is None else stream.raw()
        if stream is None or raw is None or now_ns - stream.at_ns > WISHED_NS:
            return None
        try:
            return self._wishes.decode(*raw).twist
        except DecodeError:
            return None

    def _take_truth(self, truth: Stream, now_ns: int) -> None:
        raw = truth.raw()
        if raw is None:
            return
        try:
            at = self._poses.decode(*raw).pose.position
        except DecodeError:
            return
        self._trails["truth"].add(now_ns, at.x, at.y)

    async def _ask_again_and_again(self) -> None:
        while True:
            self._asks.clear()
            told = await self._ask()
            try:
                async with asyncio.timeout(ASK_S if told else ASK_SOON_S):
                    await self._asks.wait()
            except TimeoutError:
                pass

    async def _ask(self) -> bool:
        """Take what it says of itself, if it does."""
        client = self.client
        assert client is not None
        try:
            info: Info = await in_thread(lambda: client.get("info"), None)
            config: dict[str, Any] = await in_thread(lambda: client.get("config"), None)
            self.about = About(
                info.version,
                info.simulated,
                float(config["limits"]["linear_speed"]),
                float(config["limits"]["angular_speed"]),
                float(config["rates"]["state"]),
                str(config["record"]["directory"]),
            )
        except (MendableError, DecodeError, msgspec.MsgspecError, KeyError, TypeError, ValueError):
            return False
        return True

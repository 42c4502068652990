"""Lowers the robot's highest speed to that of a nav2_msgs/SpeedLimit on the key `speed_limit`.

A speed limit never raises a speed. The robot's `limits.linear_speed` is the lower of two values:

- the *setting*: the value in the configuration, or the value of the last `set`.
- the limit in the last message, converted to m/s. A message with 0.0 lifts the limit.

The class `Robot` has no code for speed limits: this module sends it a `set` request with the lower
value. When the limit is lifted, this module sends the higher value again. A client may send a `set`
while a limit is in force. Its new settings must also be valid with the higher value, so that the
limit can be lifted later.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

from msgspec import Struct
from msgspec.structs import replace

from acsard.core.config.live import changed
from acsard.core.config.parsing import ConfigError
from acsard.core.config.settings import Config
from acsard.core.incoming.commands import MAX_COMMAND_BYTES, Arrival, caller_name
from acsard.core.messages.encodings import DecodeError, Decoder, decode_cdr, detect
from acsard.core.messages.keys_and_roles import SPEED_LIMIT
from acsard.core.messages.schema import Header, SpeedLimit
from acsard.core.values import NS_PER_S, Answer, Event, Refusal, Request

LOWERED_SETTING = "limits.linear_speed"
"""The setting that a speed limit lowers."""

MIN_INTERVAL_NS = NS_PER_S // 10
"""Least time between two changes of the limit, ns. Each change builds the whole configuration
again, so many changes would delay the control loop. If several messages arrive within this time,
only the newest one is applied."""

NO_LIMIT_VALUE = 0.0
"""Value of nav2_msgs/SpeedLimit that means "no limit", in m/s and in %."""


class _Payload(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    header: Header = Header()
    percentage: bool = False
    speed_limit: float


_decoder = Decoder(_Payload)


class Limit(Struct, frozen=True):
    """The limit that a message asks for."""

    speed: float
    """Highest speed, m/s. Infinity means that the message lifts the limit."""
    by: str
    """Name of the sender, for the log."""
    arrived_ns: int


def decode_limit(arrival: Arrival, configured: float) -> Limit:
    """Return the speed limit in a sample. Raise `DecodeError` if the sample is not valid.

    `configured` is the configured highest speed, m/s. A limit in % is a share of this speed.
    """
    if not arrival.put:
        raise DecodeError("not_a_put", "a DELETE is not a speed limit: send a PUT")
    if len(arrival.payload) > MAX_COMMAND_BYTES:
        raise DecodeError("too_big", f"{len(arrival.payload)} bytes are too many for a speed limit")
    message: SpeedLimit | _Payload
    if detect(arrival.encoding, arrival.payload) == "cdr":
        message = decode_cdr(SpeedLimit, arrival.payload)
    else:
        message = _decoder.decode(arrival.encoding, arrival.payload)
    value = message.speed_limit
    if not math.isfinite(value):
        raise DecodeError("not_finite", "the speed limit is NaN or infinity; send 0.0 to lift it")
    if value < 0.0 or (message.percentage and value > 100.0):
        unit = " %" if message.percentage else " m/s"
        most = " to 100 %" if message.percentage else " m/s or more"
        raise DecodeError("out_of_range", f"{value:g}{unit}: send 0{most}; 0 lifts the limit")
    speed = value / 100.0 * configured if message.percentage else value
    name = caller_name(arrival.via, arrival.attachment, arrival.sender)
    by = f"{name} on the key {SPEED_LIMIT}"
    return Limit(math.inf if value == NO_LIMIT_VALUE else speed, by, arrival.arrived_ns)


NO_LIMIT = Limit(math.inf, "", 0)


class SpeedLimiter:
    """The speed limit in force, and the settings that will apply when this limit ends."""

    def __init__(self, config: Config) -> None:
        """Start without a limit. `config` is the robot's present configuration."""
        self._limit = NO_LIMIT
        self._waiting: Limit | None = None
        """The limit of the newest message, until it is applied; None if no message waits."""
        self._changed_ns = 0
        self._robot = self.settings = config
        """`_robot` is the robot's configuration, in which the speed limit has lowered the speed.
        `settings` is the configuration that would be in force without the speed limit. It stays the
        same object until a setting changes."""
        self._asked: tuple[Request, float] | None = None
        """A pair: the client's `set` request in this step that changes the highest speed, and the
        speed that it requests, m/s. None if no request in this step changes the highest speed."""
        self._held: list[Request] = []
        """The `set` requests that wait for the next control step. While a limit is in force, a step
        takes only one `set` request."""

    @property
    def lowers(self) -> bool:
        """Whether a speed limit keeps the robot's highest speed below its setting.

        After the limit is lifted, this stays True until the robot has the higher value again.
        """
        setting = self.settings.limits.linear_speed
        return self._limit.speed < setting or self._robot.limits.linear_speed < setting

    @property
    def text(self) -> str:
        """The limit in force with its sender, in words; "" if no limit lowers the highest speed."""
        if not self.lowers:
            return ""
        setting = self.settings.limits.linear_speed
        return (
            f"{self._limit.speed:.3g} m/s, set by {self._limit.by}; back to {setting:g} m/s when "
            "this limit ends"
        )

    def receive(self, arrival: Arrival, configured: float, refusals: list[Refusal]) -> None:
        """Decode the limit in a message, and store it for the next step.

        `configured` is the highest speed to which a limit in % refers, m/s. An invalid message only
        adds an entry to `refusals`.
        """
        try:
            self._waiting = decode_limit(arrival, configured)
        except DecodeError as error:
            refusals.append(Refusal(error.reason, f"{SPEED_LIMIT}: {error}"))

    def requests(
        self, requests: tuple[Request, ...], now_ns: int
    ) -> tuple[tuple[Request, ...], list[Answer]]:
        """Return the requests for the robot in this step, and the answers to refused requests.

        The argument `requests` contains the requests of the clients, and `now_ns` is the monotonic
        time of the step. The caller must call `settle` after the step.
        """
        if self._limit is NO_LIMIT and not self._held and self._waiting is None:
            return requests, []
        own = self._limit_request(now_ns)
        if self._limit is NO_LIMIT and not self._held:
            return (*own, *requests), []
        robot_requests, refused, has_set = list(own), list[Answer](), False
        waiting, self._held = [*self._held, *requests], []
        for request in waiting:
            if request.verb != "set" or self._limit is NO_LIMIT:
                robot_requests.append(request)
            elif has_set:
                self._held.append(request)
            else:
                has_set = True
                try:
                    robot_requests.append(self._limited(request))
                except ConfigError as error:
                    refused.append(Answer(request.id, False, str(error)))
        return tuple(robot_requests), refused

    def _limited(self, request: Request) -> Request:
        """Return a client's `set` request, with the highest speed lowered to the limit in force.

        Raises `ConfigError` if the requested settings would be invalid when the limit ends.
        """
        # The robot itself checks whether a change must wait until the robot stands still.
        made, _ = changed(self.settings, request.settings, at_rest=True)
        if LOWERED_SETTING not in request.settings:
            return request
        wanted = made.limits.linear_speed
        self._asked = request, wanted
        if wanted <= self._limit.speed:
            return request
        return replace(request, settings=request.settings | {LOWERED_SETTING: self._limit.speed})

    def _limit_request(self, now_ns: int) -> tuple[Request, ...]:
        if self._waiting is None or now_ns - self._changed_ns < MIN_INTERVAL_NS:
            return ()
        new, self._waiting = self._waiting, None
        self._limit = NO_LIMIT if math.isinf(new.speed) else new
        lowest = min(self.settings.limits.linear_speed, new.speed)
        if lowest == self._robot.limits.linear_speed:
            return ()
        self._changed_ns = now_ns
        return (
            Request("set", asked_ns=new.arrived_ns, by=new.by, settings={LOWERED_SETTING: lowest}),
        )

    def settle(
        self, robot: Config, answers: Iterable[Answer], events: list[Event]
    ) -> tuple[Answer, ...]:
        """Store the robot's configuration after a step, and return the answers for the clients.

        `robot` is the robot's configuration after the step. `answers` are the robot's answers in
        the step. A client may have set a speed above the limit. The answer to this client and a new
        event in `events` then say that the speed will apply when the limit ends.
        """
        answers = tuple(answers)
        speed = self.settings.limits.linear_speed
        asked, self._asked = self._asked, None
        if asked is not None:
            request, wanted = asked
            answer = next((reply for reply in answers if reply.id == request.id), None)
            if answer is not None and answer.success:
                speed = wanted
                if wanted > self._limit.speed:
                    text = f"{LOWERED_SETTING} = {wanted:g} {self._pending_text}"
                    events.append(Event("set", text, by=request.by, kind="waits"))
                    if len(request.settings) > 1:
                        text = f"{answer.message}; {text}"
                    new_answer = replace(answer, message=text)
                    answers = tuple([new_answer if reply is answer else reply for reply in answers])
        if robot is not self._robot or speed != self.settings.limits.linear_speed:
            self._robot = robot
            limited = self._limit is not NO_LIMIT
            limits = replace(robot.limits, linear_speed=speed) if limited else robot.limits
            self.settings = replace(robot, limits=limits) if limited else robot
        return answers

    @property
    def _pending_text(self) -> str:
        limit = self._limit
        return f"will apply when the limit of {limit.speed:.3g} m/s ends ({limit.by})"

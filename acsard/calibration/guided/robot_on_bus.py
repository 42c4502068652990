"""The robot on the bus during a calibration: it drives legs, and its messages are recorded.

`leg_driver.py` decides which command to send.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import zenoh

from acsard.calibration.guided.leg_driver import LegDriver, Recorder
from acsard.calibration.guided.legs import GuideError, Leg
from acsard.calibration.runs import Run
from acsard.client.commander import OPENING_PERIOD_S, OPENING_S, SEND_PERIOD_S, ZEROS
from acsard.client.follower import FIRST_S
from acsard.client.synchronous import Client
from acsard.client.watch import Watch
from acsard.core.config.settings import Config
from acsard.core.messages.encodings import DecodeError, Decoder
from acsard.core.messages.schema import Imu, JointState, Odometry, PoseStamped
from acsard.core.messages.topics import by_key
from acsard.daemon.bus.subscription import Subscription, encoded, queue_on
from acsard.terminal.prompt import Prompt

SOURCE = "app"

LOOK_S = 0.005
"""Period in which keys and messages are polled, s.

A key press stops the robot at most this much later.
"""

SHOWN_S = 0.2

POSITIONS = (Odometry, PoseStamped)
"""Types of a position message, in the order of decoding attempts.

CDR does not name its type, and a payload that is too short for odometry is a pose.
"""

Take = Callable[[Any, float], object]


class Sensor:
    """The messages of one key, decoded as the first of `types` that fits."""

    def __init__(self, session: zenoh.Session, key: str, types: tuple[type, ...]) -> None:
        self.key = key
        self._samples = Subscription(queue_on(session, key, latched=False), key)
        self._decoders: list[Decoder[Any]] = [Decoder(one) for one in types]

    def hear(self, take: Take, now: float) -> int:
        """Pass every message that has arrived to `take` and return their number.

        Raises `GuideError` if a message cannot be decoded.
        """
        count = 0
        while (sample := self._samples.try_recv()) is not None:
            take(self._decoded(sample), now)
            count += 1
        return count

    def await_first(self, what: str) -> None:
        """Wait for the first message. Raises `GuideError` if none arrives within `FIRST_S`."""
        end = time.monotonic() + FIRST_S
        while not self.hear(lambda message, now: None, 0.0):
            if time.monotonic() > end:
                raise GuideError(f"{what} does not arrive on {self.key}")
            time.sleep(LOOK_S)

    def _decoded(self, sample: zenoh.Sample) -> Any:
        errors = []
        for at, decoder in enumerate(self._decoders):
            try:
                message = decoder.decode(*encoded(sample))
            except DecodeError as error:
                errors.append(str(error))
                continue
            self._decoders = self._decoders[at : at + 1]
            return message
        raise GuideError(f"the messages on {self.key} cannot be read: {'; '.join(errors)}")


class RobotOnBus:
    """The robot on the bus: sends the commands of a leg and records the sensors meanwhile."""

    def __init__(self, client: Client, config: Config, prompt: Prompt) -> None:
        self._client, self._prompt = client, prompt
        self._joints, self._geometry = config.joints.as_tuple(), config.drive
        self._sensors: list[tuple[Sensor, str]] = []
        self._wheels = Sensor(client.session, client.key("wheel_states"), (JointState,))
        self._watch = Watch(client, time.monotonic())

    def gyro(self, key: str) -> None:
        """Record turn rates from a key. Raises `GuideError` if none arrive."""
        sensor = Sensor(self._client.session, self._full(key), (Imu,))
        sensor.await_first("a gyro's turn rate")
        self._sensors.append((sensor, "gyro"))

    def positions(self, key: str, session: zenoh.Session | None) -> None:
        """Record positions from a key, by `session` if it is given.

        Raises `GuideError` if none arrive.
        """
        sensor = Sensor(session or self._client.session, self._full(key), POSITIONS)
        sensor.await_first("a position (PoseStamped or Odometry)")
        self._sensors.append((sensor, "place"))

    def ride(self, leg: Leg) -> Run:
        """Drive a leg and return its recording. Raises `GuideError` if the leg is cut short."""
        recorder = Recorder(self._joints)
        self._drain()
        sender = self._client.sender
        driver = LegDriver(leg, SOURCE, self._geometry, time.monotonic(), sender)
        try:
            self._drive(driver, recorder)
        finally:
            for _ in range(ZEROS):
                self._client.send(0.0, 0.0)
        if driver.halted and self._watch.unreadable:
            raise GuideError(
                "the daemon's state cannot be read: does another version of acsard run?"
            )
        if driver.halted:
            raise GuideError(f"{driver.halted}. The tool commanded zero, and writes nothing")
        return recorder.run()

    def _drive(self, driver: LegDriver, recorder: Recorder) -> None:
        begun = sent = shown = time.monotonic()
        last = None
        while not driver.over:
            for key in self._prompt.keys(LOOK_S):
                driver.key(key, time.monotonic())
            now = time.monotonic()
            self._hear(driver, recorder, now)
            command = driver.step(now)
            period = OPENING_PERIOD_S if now - begun < OPENING_S else SEND_PERIOD_S
            if command != last or now - sent >= period:
                self._client.send(command.linear, command.angular)
                last, sent = command, now
            if now - shown > SHOWN_S:
                self._prompt.progress(driver.progress(now))
                shown = now
        self._prompt.progress(1.0)

    def _hear(self, driver: LegDriver, recorder: Recorder, now: float) -> None:
        for state in self._watch.look(now):
            driver.state(state, now)

        def turned(message: JointState, came: float) -> None:
            driver.wheels(recorder.wheels(message, came), came)

        self._wheels.hear(turned, now)
        for sensor, name in self._sensors:
            sensor.hear(getattr(recorder, name), now)

    def _drain(self) -> None:
        """Discard the messages that arrived before the leg."""
        for sensor in (self._wheels, *(one for one, _ in self._sensors)):
            sensor.hear(lambda message, now: None, 0.0)
        self._watch.look(time.monotonic())

    def _full(self, key: str) -> str:
        """Return a key of the table below this robot's id, and any other key as it is written."""
        return self._client.key(key) if by_key(key) is not None else key

"""Connects a guided drive to the robot: sends the commands of a leg, and records the messages.

The senders stamp with different clocks, or not at all, so stamps show only intervals. The message
with the smallest delay from stamp to arrival counts as undelayed; the fit finds the rest.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import zenoh
from msgspec import Struct

from acsard.bus.subscription import Subscription, encoded, queue_on
from acsard.calibration.guided.drive_plan import DisturbedError, GuideError, Leg
from acsard.calibration.guided.leg_driver import OPENING_S, LegDriver
from acsard.calibration.log_rows import FOUR
from acsard.calibration.log_table import APPLIED, Floats, Table
from acsard.calibration.runs import NEW_RUN_AFTER_S, Log, Run, on_arrival_clock, runs
from acsard.client.connection import Connection
from acsard.client.driving import repeat_zeros
from acsard.client.follower import FIRST_STATE_TIMEOUT_S, Watch
from acsard.client.reads import decoder_of
from acsard.client.ride import OPENING_PERIOD_S, SEND_PERIOD_S
from acsard.core.config.settings import Config
from acsard.core.messages.encodings import DecodeError, Decoder
from acsard.core.messages.keys_and_roles import by_key
from acsard.core.messages.schema import Imu, JointState, Odometry, PoseStamped, Time, TwistStamped
from acsard.core.values import NS_PER_S, Seconds, WheelSpeeds
from acsard.host import clock
from acsard.terminal.prompt import Prompt

SOURCE = "app"

POLL_PERIOD_S = 0.005  # a key takes effect within this time

DISPLAY_PERIOD_S = 0.2  # interval between updates of the progress display of a leg

RECONNECT_TIMEOUT_S = 3.0  # if a silent daemon returns within this time, the leg is repeated

# CDR does not name its type. A pose is too short to be decoded as `Odometry`.
POSITION_TYPES = (Odometry, PoseStamped)

Take = Callable[[Any, float], object]  # processes a message and its time of arrival, s


class Sensor:
    """A subscription to one Zenoh key. The first message decides which of `types` all must have."""

    def __init__(self, session: zenoh.Session, key: str, types: tuple[type, ...]) -> None:
        self.key = key
        self._samples = Subscription(queue_on(session, key, latched=False), key)
        self._decoders: list[Decoder[Any]] = [decoder_of(type_) for type_ in types]

    def receive(self, take: Take, now: float) -> int:
        """Pass each message that has arrived to `take`, and return the number of messages.

        Raises `GuideError` if a message cannot be decoded.
        """
        count = 0
        while (sample := self._samples.try_recv()) is not None:
            take(self._decoded(sample), now)
            count += 1
        return count

    def discard(self) -> int:
        return self.receive(lambda message, now: None, 0.0)

    def await_first(self, what: str) -> None:
        """Wait for a message and discard it. Raises `GuideError` if none arrives."""
        end = clock.steady_s() + FIRST_STATE_TIMEOUT_S
        while not self.discard():
            if clock.steady_s() > end:
                raise GuideError(
                    f"{what} does not arrive on the Zenoh key {self.key}: does the sender run, and "
                    "does it publish on this key?"
                )
            time.sleep(POLL_PERIOD_S)

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
        raise GuideError(
            f"the messages on the Zenoh key {self.key} cannot be read ({'; '.join(errors)}): does "
            "the sender publish another message type?"
        )


# By the kind of recorded message.
COLUMNS_BY_STREAM = {
    "wheels": FOUR, "gyro": ("yaw_rate",), "places": ("x", "y"), "commands": APPLIED,
}  # fmt: skip


class Sample(Struct, frozen=True):
    """The values of one message, with its time of arrival and its stamp."""

    arrival: Seconds  # on this computer's clock
    stamp: Seconds | None  # by the sender's clock
    values: tuple[float, ...]  # of the columns in `COLUMNS_BY_STREAM`


class LegRecorder:
    """Collects the samples of one leg. Every `arrival` is the time of arrival of a message, s."""

    def __init__(self, joints: Sequence[str]) -> None:
        self._joints = joints
        self.samples: dict[str, list[Sample]] = {name: [] for name in COLUMNS_BY_STREAM}

    def wheels(self, message: JointState, arrival: float) -> WheelSpeeds:
        """Add a sample of the wheel speeds, and return these speeds, rad/s.

        Raises `GuideError` if the speed of a wheel is missing.
        """
        speeds = dict(zip(message.name, message.velocity, strict=False))
        for joint in self._joints:
            if joint not in speeds:
                raise GuideError(
                    f"wheel_states has no speed of {joint}: if another program publishes on this "
                    "key, stop it"
                )
        values = tuple(speeds[joint] for joint in self._joints)
        self._add("wheels", message.header.stamp, arrival, values)
        return WheelSpeeds(*values)

    def gyro(self, message: Imu, arrival: float) -> None:
        self._add("gyro", message.header.stamp, arrival, (message.angular_velocity.z,))

    def place(self, message: PoseStamped | Odometry, arrival: float) -> None:
        """Add a position. The heading of the message is ignored."""
        pose = message.pose if isinstance(message, PoseStamped) else message.pose.pose
        spot = pose.position
        self._add("places", message.header.stamp, arrival, (spot.x, spot.y))

    def command(self, message: TwistStamped, arrival: float) -> None:
        values = message.twist.linear.x, message.twist.angular.z
        self._add("commands", message.header.stamp, arrival, values)

    def _add(self, stream: str, stamp: Time, arrival: float, values: tuple[float, ...]) -> None:
        stamp_s = stamp.to_ns() / NS_PER_S if stamp.sec else None
        self.samples[stream].append(Sample(arrival, stamp_s, values))

    def log(self) -> Log:
        """Return the samples of the leg as a log.

        Raises `DisturbedError` if the wheel samples have a gap, and `LogError` if they cannot be
        used.
        """
        sensors: list[dict[str, Floats]] = []
        for stream, names in COLUMNS_BY_STREAM.items():
            samples = self.samples[stream]
            values = np.array([sample.values for sample in samples]).reshape(-1, len(names)).T
            sensors.append({"t": times(samples)} | dict(zip(names, values, strict=True)))
        log = runs(Table.joined(sensors))
        if len(log.runs) > 1:
            why = f"no wheel speeds arrived for {NEW_RUN_AFTER_S:g} s"
            raise DisturbedError(why, f"{why}. The tool did not change any file")
        return log


def times(samples: Sequence[Sample]) -> Floats:
    """Return the times at which the samples were made, s, on this computer's clock."""
    arrivals = np.array([sample.arrival for sample in samples])
    stamps = np.array([math.nan if s.stamp is None else s.stamp for s in samples])
    return (
        arrivals
        if not len(arrivals) or np.isnan(stamps).any()
        else on_arrival_clock(arrivals, stamps)
    )


class RobotOnBus:
    """Drives the robot one leg at a time, and records its sensors during each leg."""

    def __init__(self, client: Connection, config: Config, prompt: Prompt) -> None:
        self._client, self._prompt = client, prompt
        self._joints, self._config = config.joints.as_tuple(), config
        commands = Sensor(client.session, client.key("cmd_vel_out"), (TwistStamped,))
        self._sensors: list[tuple[Sensor, str]] = [(commands, "command")]
        self._wheels = Sensor(client.session, client.key("wheel_states"), (JointState,))
        self._watch = Watch(client, clock.steady_s())

    def gyro(self, key: str) -> None:
        """Record the turn rates on `key` in each later leg. Raises `GuideError` if none arrive."""
        sensor = Sensor(self._client.session, self._full(key), (Imu,))
        sensor.await_first("a gyro's turn rate")
        self._sensors.append((sensor, "gyro"))

    def positions(self, key: str, session: zenoh.Session | None) -> None:
        """Record the positions on `key` in each later leg. Raises `GuideError` if none arrive.

        A `session` of None means the session that commands the robot.
        """
        sensor = Sensor(session or self._client.session, self._full(key), POSITION_TYPES)
        sensor.await_first("a position (PoseStamped or Odometry)")
        self._sensors.append((sensor, "place"))

    def ride(self, leg: Leg) -> Run:
        """Drive a leg and return its recording.

        Raises `DisturbedError` if the leg can be repeated, `GuideError` if not, and `LogError` if
        the wheel samples cannot be used.
        """
        recorder = LegRecorder(self._joints)
        self._drain()
        sender = self._client.sender
        driver = LegDriver(leg, SOURCE, self._config, clock.steady_s(), sender)
        try:
            self._drive(driver, recorder)
        finally:
            for pause_s in repeat_zeros(self._client):
                time.sleep(pause_s)
        if driver.halted and self._watch.unreadable:
            raise GuideError(
                "the messages with the daemon's state cannot be read: if the daemon has another "
                "version of acsard, use that version here too"
            )
        if driver.halted:
            end = "" if driver.halted.endswith("?") else "."
            text = f"{driver.halted}{end} The tool commanded zero speed and did not change any file"
            if driver.disturbed or (driver.silent and self.returns()):
                raise DisturbedError(driver.halted, text)
            raise GuideError(text)
        log = recorder.log()
        for note in log.notes:
            self._prompt.show_text(f"note: {note}")
        return log.runs[0]

    def returns(self) -> bool:
        """Wait for a state of the daemon, and return whether one has arrived."""
        end = clock.steady_s() + RECONNECT_TIMEOUT_S
        while clock.steady_s() < end:
            if self._watch.poll(clock.steady_s()):
                return True
            time.sleep(POLL_PERIOD_S)
        return False

    def _drive(self, driver: LegDriver, recorder: LegRecorder) -> None:
        begun = sent = display_s = clock.steady_s()
        last = None
        while not driver.over:
            for key in self._prompt.keys(POLL_PERIOD_S):
                driver.key(key, clock.steady_s())
            now = clock.steady_s()
            self._receive(driver, recorder, now)
            command = driver.step(now)
            period = OPENING_PERIOD_S if now - begun < OPENING_S else SEND_PERIOD_S
            if command != last or now - sent >= period:
                self._client.send(command.linear, command.angular)
                last, sent = command, now
            if now - display_s > DISPLAY_PERIOD_S:
                self._prompt.progress(driver.progress(now))
                display_s = now
        self._prompt.progress(1.0)

    def _receive(self, driver: LegDriver, recorder: LegRecorder, now: float) -> None:
        for state in self._watch.poll(now):
            driver.state(state, now)

        def wheels(message: JointState, arrival: float) -> None:
            stamp = message.header.stamp.to_ns() / NS_PER_S
            driver.wheels(recorder.wheels(message, arrival), stamp or arrival, arrival)

        self._wheels.receive(wheels, now)
        for sensor, name in self._sensors:
            sensor.receive(getattr(recorder, name), now)

    def _drain(self) -> None:
        for sensor in (self._wheels, *(sensor for sensor, _ in self._sensors)):
            sensor.discard()
        self._watch.poll(clock.steady_s())

    def _full(self, key: str) -> str:
        return self._client.key(key) if by_key(key) is not None else key

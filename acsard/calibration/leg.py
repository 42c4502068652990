"""Drives the robot through one leg, and records its sensors meanwhile.

The client drives each move, and says why the robot does not follow. The senders stamp with
different clocks, or not at all, so the message with the smallest delay from stamp to arrival counts
as not delayed; the fit finds the rest.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from typing import Any

import numpy as np
import zenoh

from acsard.bus.subscription import Subscription, encoded
from acsard.calibration.geometry import CONFIGURED, Base
from acsard.calibration.log import APPLIED, LogError, Notes, Run, run_of
from acsard.calibration.plan import Leg, Move
from acsard.calibration.series import Floats
from acsard.client.connection import Connection
from acsard.client.driving import Driver, drive
from acsard.client.follower import FIRST_STATE_TIMEOUT_S
from acsard.core.config.settings import Config
from acsard.core.messages.encodings import DecodeError, Decoder
from acsard.core.messages.keys_and_roles import IMU
from acsard.core.messages.schema import Imu, JointState, Odometry, PoseStamped, TwistStamped
from acsard.core.values import NS_PER_S, Seconds, wheels4
from acsard.host import clock
from acsard.host.errors import NoAnswerError, NotDrivenError
from acsard.terminal.prompt import Prompt

POLL_S = 0.005  # a key takes effect within this time
DISPLAY_S = 0.2  # between two views of the progress
STANDS_S = 0.7  # that is recorded after a leg: the sensors may be late
MAX_JITTER_S = 5.0  # of the delay from stamp to arrival; above it, stamps are not used
MIN_SAMPLES = 20

# How far the wheels may roll otherwise than commanded, m and rad, and as a share: more is an
# obstacle, a speed limit or another command, and the robot could leave the floor.
OFF, OFF_SHARE = (0.1, 0.2), 0.1
CHECK_S = 0.5  # between two of these checks
LAG_S = 1.0  # by which the wheels may be late meanwhile: their ramp, their response and the network

# A pause of this program that keeps commands from the robot: they time out after 0.25 s by default.
PAUSE_S = 0.2
PAUSED = (
    "this computer did not run the calibration for {:.1f} s, so the robot was not driven "
    "meanwhile: end programs that keep the computer busy"
)

Values = Callable[[Any], tuple[float, ...]]


class Sensor:
    """A subscription to one key whose messages are all of one of `types`."""

    def __init__(
        self, session: zenoh.Session, key: str, types: tuple[type, ...], values: Values,
        columns: tuple[str, ...],
    ) -> None:  # fmt: skip
        self.key, self.columns, self._values = key, columns, values
        self._samples = Subscription(session, key)
        self._decoders: list[Decoder[Any]] = [Decoder(type_) for type_ in types]
        self.rows: list[tuple[float, ...]] = []  # arrival, stamp (0 if unknown), values

    def receive(self, now: Seconds) -> int:
        """Store all messages that have arrived, and return their number. Raises `LogError`."""
        before = len(self.rows)
        while (sample := self._samples.try_recv()) is not None:
            message = self._decoded(sample)
            stamp = message.header.stamp
            self.rows.append((now, stamp.to_ns() / NS_PER_S if stamp.sec else 0.0,
                              *self._values(message)))  # fmt: skip
        return len(self.rows) - before

    def await_first(self, what: str) -> None:
        end = clock.steady_s() + FIRST_STATE_TIMEOUT_S
        while not self.receive(0.0):
            if clock.steady_s() > end:
                raise LogError(
                    f"{what} does not arrive on the Zenoh key {self.key}: does the sender run, and "
                    "does it publish on this key?"
                )
            time.sleep(POLL_S)

    def stream(self) -> tuple[Floats, ...]:
        """Return the times of the samples on this computer's clock, s, and their values."""
        if not self.rows:
            return (np.zeros(0),) * (1 + len(self.columns))
        arrivals, stamps, *values = np.array(self.rows).T
        delay = arrivals - stamps
        if not stamps.all() or float(np.ptp(delay)) > MAX_JITTER_S:
            return arrivals, *values
        return stamps + delay.min(), *values

    def _decoded(self, sample: zenoh.Sample) -> Any:
        errors = []
        for at, decoder in enumerate(self._decoders):
            try:
                message = decoder.decode(*encoded(sample))
            except DecodeError as error:
                errors.append(str(error))
                continue
            # CDR does not name its type. A pose is too short to be decoded as `Odometry`.
            self._decoders = self._decoders[at : at + 1]
            return message
        raise LogError(
            f"the messages on the Zenoh key {self.key} cannot be read ({'; '.join(errors)}): does "
            "the sender publish another message type?"
        )


def place_and_yaw(message: PoseStamped | Odometry) -> tuple[float, ...]:
    pose = message.pose if isinstance(message, PoseStamped) else message.pose.pose
    turn = pose.orientation
    return pose.position.x, pose.position.y, 2 * math.atan2(turn.z, turn.w)


def require_path(
    move: Move, rows: Sequence[tuple[float, ...]], base: Base, driven: Seconds | None = None
) -> None:
    """Raise `NotDrivenError` if the wheels did not roll the path of a move.

    `rows` are the arrivals, stamps and speeds of the wheels since its start. `driven` is the time
    since its first speed, or None after its end.
    """
    if not (move.linear or move.angular):
        return
    if len(rows) < MIN_SAMPLES:
        if driven is not None:
            return
        raise NotDrivenError("hardly any wheel speeds arrive: is the network or the board slow?")
    table = np.array(rows)
    steps = np.diff(table[:, 0])[:, None]
    rolled = ((table[1:, 2:] + table[:-1, 2:]) / 2 * steps).sum(axis=0)
    made = base.motion(CONFIGURED, *rolled)
    least, most = (move.seconds,) * 2 if driven is None else (max(0.0, driven - LAG_S), driven)
    commanded = move.linear, move.angular
    for seen, speed, off, unit in zip(made, commanded, OFF, ("m", "rad"), strict=True):
        wish = speed * most
        near = sorted((speed * least, float(seen), wish))[1]
        if abs(seen - near) > off + OFF_SHARE * abs(wish):
            raise NotDrivenError(
                f"by its wheels the robot moved {float(seen):.2f} {unit}, although {wish:.2f} "
                f"{unit} was commanded: is there a speed limit or an obstacle, does another "
                "program send commands, or does the board not reach the speeds (`acsard mcu "
                "check`)?"
            )


class Recorder:
    """The sensors of the robot, and the robot itself."""

    def __init__(self, client: Connection, config: Config, prompt: Prompt) -> None:
        self._client, self._config, self._prompt = client, config, prompt
        joints = config.joint_names

        def speeds(message: JointState) -> tuple[float, ...]:
            found = dict(zip(message.name, message.velocity, strict=False))
            if missing := [joint for joint in joints if joint not in found]:
                raise LogError(
                    f"wheel_states has no speed of {missing[0]}: if another program publishes on "
                    "this key, stop it"
                )
            fr, fl, rl, rr = wheels4([found[joint] for joint in joints])
            return (fl + rl) / 2, (fr + rr) / 2

        def twist(message: TwistStamped) -> tuple[float, ...]:
            return message.twist.linear.x, message.twist.angular.z

        self._wheels = self._sensor("wheel_states", (JointState,), speeds, ("left", "right"))
        self._others = [self._sensor("cmd_vel_out", (TwistStamped,), twist, APPLIED)]
        self._received = self._pause = 0.0  # last call of `_receive`, longest pause before one

    def _sensor(
        self, key: str, types: tuple[type, ...], values: Values, columns: tuple[str, ...]
    ) -> Sensor:
        return Sensor(self._client.session, self._client.key(key), types, values, columns)

    def add_gyro(self) -> None:
        """Record the gyro, too. Raises `LogError` if none publishes."""
        sensor = self._sensor(IMU, (Imu,), lambda m: (m.angular_velocity.z,), ("yaw_rate",))
        sensor.await_first("a gyro's turn rate")
        self._others.append(sensor)

    def add_poses(self, key: str, session: zenoh.Session) -> None:
        """Record the poses on a full key of this session, too."""
        sensor = Sensor(
            session, key, (Odometry, PoseStamped), place_and_yaw,
            ("x", "y", "yaw"),
        )  # fmt: skip
        sensor.await_first("a pose (PoseStamped or Odometry)")
        self._others.append(sensor)

    def ride(self, leg: Leg) -> Run:
        """Drive a leg, and return its recording.

        Raises `NotDrivenError` if the robot does not follow or a person stops it, and `LogError` if
        the sensors cannot be used.
        """
        self._receive()
        for sensor in (self._wheels, *self._others):
            sensor.rows.clear()
        self._pause = 0.0
        try:
            self._drive(leg)
        except (NotDrivenError, NoAnswerError):
            if self._pause > PAUSE_S:
                raise NotDrivenError(PAUSED.format(self._pause)) from None
            raise
        for _ in self._standing(STANDS_S):
            self._prompt.keys(POLL_S)
        self._prompt.progress(1.0)
        return self._run(leg.name)

    def _drive(self, leg: Leg) -> None:
        done, shown = 0.0, -DISPLAY_S
        base = Base.of(self._config.drive)
        for number, move in enumerate(leg.moves):
            by_key = leg.by_key and number == len(leg.moves) - 1
            first, checked = len(self._wheels.rows), 0.0
            with closing(self._steps(move)) as steps:
                for passed in steps:
                    if done + passed - shown >= DISPLAY_S:
                        shown = done + passed
                        self._prompt.progress(min(0.99, shown / leg.seconds))
                    if self._prompt.keys(POLL_S):
                        if by_key:
                            break
                        raise NotDrivenError("a key was pressed")
                    if passed - checked >= CHECK_S:
                        checked = passed
                        require_path(move, self._wheels.rows[first:], base, passed)
                else:
                    if by_key:
                        raise NotDrivenError(
                            "no key was pressed, although the robot must have turned a full circle"
                        )
                    require_path(move, self._wheels.rows[first:], base)
            done += move.seconds

    def _steps(self, move: Move) -> Generator[Seconds, None, None]:
        # Yields the seconds since the first speed of the move, often; the caller waits meanwhile.
        if not (move.linear or move.angular):
            yield from self._standing(move.seconds)
            return
        driver = Driver(self._client)
        try:
            for wait_s in drive(move.linear, move.angular, move.seconds)(driver):
                for _ in self._standing(wait_s):
                    begun, now = driver.ride.begun, clock.steady_s()
                    yield 0.0 if begun is None else min(move.seconds, now - begun)
        finally:
            for pause_s in driver.zeros():
                time.sleep(pause_s)
            driver.end()

    def _standing(self, seconds: Seconds) -> Generator[Seconds, None, None]:
        begun = clock.steady_s()
        while (passed := clock.steady_s() - begun) < seconds:
            yield passed
            self._receive()

    def _receive(self) -> None:
        now = clock.steady_s()
        self._pause, self._received = max(self._pause, now - self._received), now
        for sensor in (self._wheels, *self._others):
            sensor.receive(now)

    def _run(self, name: str) -> Run:
        streams = {" ".join(s.columns): s.stream() for s in (self._wheels, *self._others)}
        if "x y yaw" in streams:
            t, x, y, yaw = streams.pop("x y yaw")
            streams |= {"x y": (t, x, y), "yaw": (t, yaw)}
        return run_of(name, streams, Notes())

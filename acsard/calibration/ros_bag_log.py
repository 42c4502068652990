"""Builds the table of a log from the messages of a ROS 2 bag.

The wheel speeds come from a `JointState`, the turn rates from an `Imu`, and the positions from a
`PoseStamped` or an `Odometry`. This module chooses the topics by their types. With `--topic`, the
user can name the topics to use instead.

An `Odometry` is usually computed from the wheels, so it cannot calibrate them. It is used only if
the user names its topic, or if the bag has neither turn rates nor other positions. In the second
case, an `Odometry` that shows exactly the same turns as the wheels is refused.
"""

from __future__ import annotations

import math
import re
from array import array
from collections.abc import Iterable, Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from acsard.calibration.log_table import FOUR, TWO, Floats, LogError, Table, bounded, spikes
from acsard.calibration.runs import MIN_BACKWARD_STEP_S, cumulative, gaps, on_arrival_clock
from acsard.core.formatting import many, printable
from acsard.core.messages.encodings import DecodeError, decode_cdr
from acsard.core.messages.schema import Imu, JointState, Odometry, PoseStamped, Quaternion
from acsard.core.values import NS_PER_S

TYPES: dict[str, type[JointState | Imu | Odometry | PoseStamped]] = {
    "sensor_msgs/msg/JointState": JointState,
    "sensor_msgs/msg/Imu": Imu,
    "nav_msgs/msg/Odometry": Odometry,
    "geometry_msgs/msg/PoseStamped": PoseStamped,
}

REFERENCES = "a gyro (sensor_msgs/msg/Imu) or positions (geometry_msgs/msg/PoseStamped)"

GUIDE_PAGE = "deploy/calibration/README.md"

AXES = ("z", "-z", "x", "-x", "y", "-y")
"""Axes of an IMU that may point up. `-x` means that x points down."""

MIN_MESSAGES = 20
"""A topic is used only if it has at least this number of messages with a value."""

MAX_DELAY_DIFFERENCE_S = 1.0
"""If the delays of two topics differ by more than this time, s, their stamps come from different
clocks.

The delay of a topic is the median time from the stamp of a message to its recording.
"""

INTERVAL_S = 1.0
"""Length of the intervals in which a sensor's turns are compared with those of the wheels, s."""

UPRIGHT, LYING = 0.5, 0.8
"""Limits for the absolute correlation between turns about an IMU axis and turns of the wheels.

If the correlation is below `UPRIGHT` for the chosen axis and above `LYING` for another axis, the
IMU lies on its side. The log is then refused.
"""

MAX_COPY_DIFFERENCE = 3e-3
"""Limit for the RMS difference between the turns of an `Odometry` and those of the wheels.

The limit is relative to the RMS turn. Up to this limit, the `Odometry` counts as computed from the
wheels.
"""

DELAYS_S = np.arange(-0.1, 0.101, 0.01)
"""Delays of an `Odometry` relative to the wheels, s. `_computed_from` tries each of them."""


class RosMessage(NamedTuple):
    topic: str
    type: str
    """Type of the message by its name in ROS, such as `nav_msgs/msg/Odometry`."""
    encoding: str
    """Encoding of `data`; ROS 2 uses `cdr`."""
    wall_ns: int
    """Time at which the message was recorded, ns since 1970."""
    data: bytes


class Choice(Struct, frozen=True):
    """The topics and the IMU axis that the user chose for a ROS 2 bag."""

    topics: tuple[str, ...] = ()
    """Names of the topics to use; () means that the tool chooses them by their message types."""
    axis: str = ""
    """The IMU axis that points up, one of `AXES`; "" means z."""


class _Topic:
    def __init__(self, name: str, type_: str) -> None:
        self.name, self.type = name, type_
        self.kind = TYPES[type_]
        self.arrivals, self.stamps, self.values = array("q"), array("q"), array("d")
        self.wheels: tuple[str, ...] = ()
        """Log columns that get the speeds of the joints of a `JointState`; () for other types."""
        self.joints: set[str] = set()
        self.unreadable, self.why = 0, ""

    def __len__(self) -> int:
        return len(self.arrivals)

    def __str__(self) -> str:
        return f"{printable(self.name)} ({self.kind.__name__})"

    def take(self, message: RosMessage, joints: Sequence[str]) -> None:
        if message.encoding != "cdr":
            self._refuse(f"the message is encoded as {message.encoding or 'nothing'}, not as cdr")
            return
        try:
            decoded: Any = decode_cdr(self.kind, message.data)
        except DecodeError as error:
            self._refuse(str(error))
            return
        values = self._values(decoded, joints)
        if values:
            self.arrivals.append(message.wall_ns)
            self.stamps.append(decoded.header.stamp.to_ns())
            self.values.extend(values)

    def _refuse(self, why: str) -> None:
        self.unreadable += 1
        self.why = self.why or why

    def _values(self, message: Any, joints: Sequence[str]) -> Sequence[float]:
        match message:
            case JointState():
                return self._joints(message, joints)
            case Imu():
                if message.angular_velocity_covariance[0] == -1.0:
                    return ()
                rate = message.angular_velocity
                return rate.x, rate.y, rate.z
            case Odometry():
                pose = message.pose.pose
            case _:
                pose = message.pose
        return pose.position.x, pose.position.y, _yaw(pose.orientation)

    def _joints(self, message: JointState, joints: Sequence[str]) -> Sequence[float]:
        """Return the angles of the wheels in a message, followed by their speeds.

        Return () if the message contains no wheels, or other wheels than the first message.
        """
        columns = wheel_joints(tuple(message.name), tuple(joints))
        self.joints.update(message.name[:8])
        self.wheels = self.wheels or tuple(columns)
        if not columns or tuple(columns) != self.wheels:
            return ()
        return [
            sum(numbers[at] for at in indices) / len(indices)
            if len(numbers) == len(message.name)
            else math.nan
            for numbers in (message.position, message.velocity)
            for indices in columns.values()
        ]

    def columns(self) -> Floats:
        return np.frombuffer(self.values).reshape(len(self), -1)

    def seconds(self, times: array[int], since_ns: int) -> Floats:
        return (np.frombuffer(times, dtype=np.int64) - since_ns) / NS_PER_S

    @property
    def stamped(self) -> bool:
        return all(self.stamps)


def _yaw(turn: Quaternion) -> float:
    size = turn.x**2 + turn.y**2 + turn.z**2 + turn.w**2
    if not size:
        return math.nan
    return math.atan2(2 * (turn.w * turn.z + turn.x * turn.y), size - 2 * (turn.y**2 + turn.z**2))


_SHORT = {
    "fl": ("fl", "lf"), "fr": ("fr", "rf"), "rl": ("rl", "lr", "bl", "lb"),
    "rr": ("rr", "br", "rb"), "left": ("l",), "right": ("r",),
}  # fmt: skip
"""Maps each log column (of a wheel or of a side) to the abbreviations for it in joint names."""

_COLUMN = {word: column for column, words in _SHORT.items() for word in words}


def wheel_of(joint: str) -> str:
    """Return the log column for the wheel that a joint's name means, such as "fl" or "left".

    Return "" if the name does not mean a wheel.
    """
    name = re.sub(r"([a-z])([A-Z])", r"\1_\2", joint).lower()
    if any(word in name for word in ("caster", "castor", "steer")):
        return ""
    sides = [side for side in TWO if side in name]
    if len(sides) == 1:
        end = "f" if "front" in name else "r" if "rear" in name or "back" in name else ""
        return end + sides[0][0] if end else sides[0]
    short = [_COLUMN[word] for word in re.findall("[a-z]+", name) if word in _COLUMN]
    return short[0] if len(short) == 1 and not sides else ""


@cache
def wheel_joints(names: tuple[str, ...], joints: tuple[str, ...]) -> dict[str, list[int]]:
    """Return the wheel joints that fill each column of the log, as indices in `names`.

    The columns are "fr", "fl", "rl" and "rr", or "left" and "right". If one side has no wheel
    joint, the result is empty.

    Args:
        names: the names of the joints in a message.
        joints: the configured names of the wheel joints, in the order of `FOUR`.
    """
    if set(joints) <= set(names):
        return {column: [names.index(joint)] for column, joint in zip(FOUR, joints, strict=True)}
    wheels = [name for name in names if "wheel" in name.lower()] or names
    columns: dict[str, list[int]] = {}
    for name in wheels:
        if column := wheel_of(name):
            columns.setdefault(column, []).append(names.index(name))
    if columns.keys() == set(FOUR) and all(len(indices) == 1 for indices in columns.values()):
        return {column: columns[column] for column in FOUR}
    sides: dict[str, list[int]] = {side: [] for side in TWO}
    for column, indices in columns.items():
        sides["left" if column[-1] == "l" or column == "left" else "right"] += indices
    return sides if all(sides.values()) else {}


def table(messages: Iterable[RosMessage], joints: Sequence[str], choice: Choice) -> Table:
    """Build the table of a log from the messages of a bag.

    `joints` contains the configured names of the wheel joints, in the order of `FOUR`. Raises
    `LogError` if the bag lacks usable data, or if it is unclear which topics to use.
    """
    topics: dict[str, _Topic] = {}
    others: dict[str, str] = {}
    for message in messages:
        type_ = message.type if "/msg/" in message.type else message.type.replace("/", "/msg/", 1)
        if type_ not in TYPES:
            others[message.topic] = message.type
            continue
        topic = topics.setdefault(message.topic, _Topic(message.topic, type_))
        if topic.type == type_:
            topic.take(message, joints)
    return _Log(list(topics.values()), others, joints, choice).table()


class _Rolled(NamedTuple):
    """The angles that the wheels of each side have rolled since the first sample, rad.

    An interval without a speed counts as rest.
    """

    t: Floats
    """Times of the samples, s."""
    left: Floats
    right: Floats


class _Log:
    def __init__(
        self, topics: list[_Topic], others: dict[str, str], joints: Sequence[str], choice: Choice
    ) -> None:
        self._topics, self._others, self._joints, self._choice = topics, others, joints, choice
        self._axis = choice.axis or "z"
        self._notes: list[str] = []

    def table(self) -> Table:
        wheels, gyro, places = self._chosen()
        used = [topic for topic in (wheels, gyro, places) if topic is not None]
        for topic in used:
            if topic.unreadable:
                self._notes.append(
                    f"{many(topic.unreadable, 'message')} of {topic} left out: {topic.why}"
                )
        times = dict(zip((topic.name for topic in used), self._times(used), strict=True))
        parts = [self._wheels(wheels, times[wheels.name])]
        rolled = _rolled(parts[0])
        if gyro is not None:
            parts.append(self._gyro(gyro, times[gyro.name], rolled))
        if places is not None:
            parts.append(self._places(places, times[places.name], rolled))
        if self._choice.axis and gyro is None:
            raise LogError(
                "--yaw-axis is the axis of an IMU, but the tool uses no IMU: leave this option out"
            )
        roles = [f"the wheels from {wheels}"]
        roles += [f"the turn rates from {gyro} about its {self._axis} axis"] if gyro else []
        roles += [f"the positions from {places}"] if places else []
        table = Table.joined(parts)
        notes = (f"used: {', '.join(roles)}", *self._notes, *bounded(table.columns))
        return replace(table, notes=notes)

    # Choice of the topics

    def _chosen(self) -> tuple[_Topic, _Topic | None, _Topic | None]:
        names = self._choice.topics
        known = {topic.name: topic for topic in self._topics}
        for name in names:
            if name not in known:
                raise LogError(
                    f"the bag has no topic {printable(name)} that can be used. {self._listed()}"
                )
        of = {
            kind: [topic for topic in self._topics if topic.kind is kind]
            for kind in TYPES.values()
        }  # fmt: skip
        for topic in of[JointState]:
            if topic.name in names and not topic.wheels:
                raise LogError(
                    f"{self._no_wheels([topic])}. To use the wheels of another topic, leave out "
                    f"--topic {printable(topic.name)}"
                )
        wheels = self._choose_topic(
            "the wheels", [topic for topic in of[JointState] if topic.wheels]
        )
        if wheels is None:
            raise LogError(self._no_wheels(of[JointState]))
        free = not any(known[name].kind is not JointState for name in names)
        gyro = self._choose_topic("the turn rates", of[Imu], free=free)
        places = self._choose_topic("the positions", of[PoseStamped] if free else
                           [*of[PoseStamped], *of[Odometry]], free=free)  # fmt: skip
        if free and places is None:
            odometry = [topic for topic in of[Odometry] if len(topic) >= MIN_MESSAGES]
            if gyro is None:
                places = self._choose_topic("the positions", odometry)
            elif odometry:
                name = printable(odometry[0].name)
                self._notes.append(
                    f"{', '.join(map(str, odometry))} not used: most odometry is computed from "
                    "the wheels. If this odometry comes from another sensor, such as SLAM or "
                    f"motion capture, name the topics to use: --topic {printable(gyro.name)} "
                    f"--topic {name}"
                )
        if gyro is None and places is None:
            raise LogError(
                f"the bag has nothing with which to compare the wheels: record {REFERENCES} as "
                f"well. {self._listed()}"
            )
        return wheels, gyro, places

    def _choose_topic(
        self, what: str, fit: Sequence[_Topic], *, free: bool = True
    ) -> _Topic | None:
        """Return the one topic of `fit` to use as the source of `what`, or None.

        If the user has named a topic, only this topic is used. If `free` is false, only a topic
        that the user named may be used.
        """
        named = [topic for topic in fit if topic.name in self._choice.topics]
        for topic in named:
            if len(topic) < MIN_MESSAGES:
                raise LogError(_too_few(topic))
        if not named and not free:
            return None
        candidates = named or [topic for topic in fit if len(topic) >= MIN_MESSAGES]
        if len(candidates) > 1:
            names = ", ".join(map(str, candidates))
            raise LogError(
                f"several topics can be the source of {what}: {names}; choose one, for example "
                f"with --topic {printable(candidates[0].name)}"
                + (
                    " (then also give --topic for each other sensor to use)"
                    if what != "the wheels"
                    else ""
                )
            )
        if not candidates and (few := [topic for topic in fit if topic.unreadable]):
            raise LogError(_too_few(few[0]))
        return candidates[0] if candidates else None

    def _no_wheels(self, states: Sequence[_Topic]) -> str:
        for topic in states:
            if not topic.wheels and topic.joints:
                names = ", ".join(printable(name) for name in sorted(topic.joints)[:8])
                return (
                    f"the joints of {topic} must include a known left wheel and a known right "
                    f"wheel, but are {names}. Write the names of the wheel joints into [joints] "
                    f"of the configuration, or convert the bag as {GUIDE_PAGE} shows"
                )
            if topic.unreadable or topic.wheels:
                return _too_few(topic)
        return (
            "the bag has no wheel angles: record a topic of type sensor_msgs/msg/JointState with "
            f"the wheels' joints. {self._listed()}"
        )

    def _listed(self) -> str:
        topics = [str(topic) for topic in self._topics]
        topics += [f"{printable(name)} ({printable(kind)})" for name, kind in self._others.items()]
        if not topics:
            return "The bag has no messages at all"
        return f"The bag contains {', '.join(topics[:20])}{', ...' if len(topics) > 20 else ''}"

    # Times

    def _times(self, used: Sequence[_Topic]) -> list[Floats]:
        """Return the sample times of each topic, s, all on the same clock."""
        since_ns = min(topic.arrivals[0] for topic in used)
        arrivals = [topic.seconds(topic.arrivals, since_ns) for topic in used]
        stamps = [topic.seconds(topic.stamps, since_ns) for topic in used]
        for topic, times in zip(used, stamps, strict=True):
            back = float(np.diff(times).min(initial=0.0))
            if topic.stamped and back < -MIN_BACKWARD_STEP_S:
                raise LogError(
                    f"the stamps of {topic} go back by {-back:.0f} s in the middle of the bag, "
                    "because a simulation or a played bag restarted: record each drive in its own "
                    "bag"
                )
        start = since_ns / NS_PER_S
        if all(topic.stamped for topic in used):
            delays = [float(np.median(c - m)) for c, m in zip(arrivals, stamps, strict=True)]
            apart = max(delays) - min(delays)
            if apart <= MAX_DELAY_DIFFERENCE_S:
                return [times + start for times in stamps]
            self._notes.append(
                f"the stamps of the topics come from different clocks, {apart:.3g} s apart: the "
                "tool moves the stamps of each topic to the clock of the recording"
            )
        return [
            (on_arrival_clock(c, m) if topic.stamped else c) + start
            for topic, c, m in zip(used, arrivals, stamps, strict=True)
        ]

    # Columns

    def _wheels(self, topic: _Topic, t: Floats) -> dict[str, Floats]:
        count = len(topic.wheels)
        angles, speeds = topic.columns()[:, :count], topic.columns()[:, count:]
        samples = angles[np.isfinite(angles).all(axis=1)]
        if len(samples) and np.any(np.ptp(samples, axis=0) > 0.0):
            t, speeds = speeds_of(t, angles)
        elif not np.any(np.abs(speeds) > 0.0):
            raise LogError(
                f"{topic} has neither positions nor velocities that change: its publisher leaves "
                "both empty, or the wheels stood still. Record the wheels while the robot drives"
            )
        return {"t": t} | dict(zip(topic.wheels, speeds.T, strict=True))

    def _gyro(self, topic: _Topic, t: Floats, rolled: _Rolled) -> dict[str, Floats]:
        rates, axis = topic.columns(), self._axis
        sign, used = (-1.0 if axis[0] == "-" else 1.0), "xyz".index(axis[-1])
        follow = np.nan_to_num([_follows(t, rates[:, at], rolled) for at in range(3)])
        best = int(np.argmax(np.abs(follow)))
        if abs(follow[used]) < UPRIGHT and abs(follow[best]) > LYING:
            up = "-" * bool(follow[best] < 0.0) + "xyz"[best]
            raise LogError(
                f"the turn rate about the {axis[-1]} axis of {topic} does not match the wheels, "
                f"but the rate about its {'xyz'[best]} axis does: the IMU lies on its side. Give "
                f"--yaw-axis={up}"
            )
        return {"t": t, "yaw_rate": sign * rates[:, used]}

    def _places(self, topic: _Topic, t: Floats, rolled: _Rolled) -> dict[str, Floats]:
        x, y, yaw = topic.columns().T
        named = topic.name in self._choice.topics
        if topic.kind is Odometry and not named and _computed_from(t, yaw, rolled):
            raise LogError(
                f"{topic} shows exactly the same turns as the wheels, so it was computed from "
                f"the wheels and cannot show their errors: record {REFERENCES}. If it comes from a "
                f"sensor, give --topic {printable(topic.name)}"
            )
        turns = np.isfinite(yaw)
        # A source that does not measure an orientation sends a constant one.
        return {"t": t, "x": x, "y": y} | (
            {"yaw": yaw} if turns.any() and float(np.ptp(yaw[turns])) > 0.0 else {}
        )


def _too_few(topic: _Topic) -> str:
    if topic.unreadable > len(topic):
        return f"the messages of {topic} cannot be read: {topic.why}"
    return (
        f"{topic} has only {many(len(topic), 'message')} that the tool can use, but "
        f"{MIN_MESSAGES} are needed: record this topic while the robot drives"
    )


def speeds_of(t: Floats, angles: Floats) -> tuple[Floats, Floats]:
    """Return wheel speeds that are computed from recorded angles.

    The result is a pair: the times of the speeds, s, and the speeds, rad/s. A speed is the mean
    over one sample period. The integral of the speeds is therefore exactly the angle that the wheel
    rolled, even if the sample times are uneven. Gaps in the samples give no speed. Jumps of an
    angle, for example to 0 after a restart of the motor driver, give no speed either.

    Args:
        t: the times of the samples, s.
        angles: the angles, rad, with a row for each time and a column for each wheel.
    """
    whole = np.isfinite(angles).all(axis=1)
    times, first = np.unique(t[whole], return_index=True)
    angles = np.column_stack([_unwrapped(column) for column in angles[whole][first].T])
    if len(times) < 2:
        return times[:0], angles[:0]
    period = float(np.median(np.diff(times)))
    steps = np.diff(angles, axis=0) / np.maximum(np.diff(times), period)[:, None]
    order = np.arange(len(steps))
    cut = np.any([spikes(column, order) for column in steps.T], axis=0)
    cut |= np.isin(times[:-1], gaps(times)[:, 0])
    speed_t, speeds = [], []
    for part in np.split(np.arange(len(times)), np.flatnonzero(cut) + 1):
        if len(part) < 2:
            continue
        begin, end = times[part[0]], times[part[-1]]
        edges = np.linspace(begin, end, max(1, round((end - begin) / period)) + 1)
        sampled = [np.interp(edges, times[part], column[part]) for column in angles.T]
        speed_t.append((edges[1:] + edges[:-1]) / 2)
        speeds.append(np.column_stack([np.diff(column) / np.diff(edges) for column in sampled]))
    return np.concatenate(speed_t), np.concatenate(speeds)


def _unwrapped(angles: Floats) -> Floats:
    """Remove jumps by 2 pi from angles that are wrapped to one turn.

    Angles that span more than 2 pi are not wrapped, so they stay unchanged.
    """
    jumps = np.abs(np.diff(angles)).max(initial=0.0) > np.pi
    within = float(np.ptp(angles)) <= 2 * np.pi + 1e-3 if len(angles) else False
    return np.unwrap(angles) if jumps and within else angles


def _rolled(wheels: dict[str, Floats]) -> _Rolled:
    t = wheels["t"]
    left, right = (
        np.mean([wheels[name] for name in wheels if name in names], axis=0)
        for names in (("left", "fl", "rl"), ("right", "fr", "rr"))
    )
    return _Rolled(t, _summed(t, left), _summed(t, right))


def _summed(t: Floats, rates: Floats) -> Floats:
    return cumulative(np.nan_to_num((rates[1:] + rates[:-1]) / 2 * np.diff(t)))


def _edges(t: Floats, rolled: _Rolled) -> Floats:
    """Return the limits of the intervals in which sensor and wheels are compared, s."""
    if not len(t) or not len(rolled.t):
        return np.zeros(0)
    return np.arange(max(t.min(), rolled.t[0]), min(t.max(), rolled.t[-1]), INTERVAL_S)


def _follows(t: Floats, rates: Floats, rolled: _Rolled) -> float:
    """Return how well the turns of a sensor follow the robot's turns according to the wheels.

    The result is a correlation from -1 to 1, or NaN if it is unknown.
    """
    order = np.argsort(t, kind="stable")
    edges = _edges(t, rolled)
    if len(edges) < 4:
        return math.nan
    sensor_turns = np.diff(np.interp(edges, t[order], _summed(t[order], rates[order])))
    turned = np.diff(np.interp(edges, rolled.t, rolled.right - rolled.left))
    if not np.ptp(sensor_turns) or not np.ptp(turned):
        return math.nan
    return float(np.corrcoef(sensor_turns, turned)[0, 1])


def _computed_from(t: Floats, yaw: Floats, rolled: _Rolled) -> bool:
    """Return whether the yaw follows the wheels so exactly that it was computed from them."""
    finite = np.isfinite(yaw)
    order = np.argsort(t[finite], kind="stable")
    times, angle = t[finite][order], np.unwrap(yaw[finite][order])
    edges = _edges(times, rolled)[1:-1]
    if len(edges) < 4:
        return False
    sides = np.column_stack(
        [np.diff(np.interp(edges, rolled.t, side)) for side in (rolled.left, rolled.right)]
    )
    for delay in DELAYS_S:
        turned = np.diff(np.interp(edges + delay, times, angle))
        off = turned - sides @ np.linalg.lstsq(sides, turned, rcond=None)[0]
        if float(off @ off) <= MAX_COPY_DIFFERENCE**2 * float(turned @ turned):
            return True
    return False

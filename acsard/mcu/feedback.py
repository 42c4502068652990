"""A good line -> feedback: when it was complete, and what the wheels did since the one before.

Knows the wire's pace and the encoders' counts; whether the link can be trusted is `session.py`'s.
"""

from __future__ import annotations

from msgspec import Struct

from acsard.config.settings import McuConfig
from acsard.config.wire_time import wire_ns
from acsard.mcu.check import Reading
from acsard.mcu.encoders import Encoders, Turned
from acsard.mcu.frames import Codec, Motors
from acsard.values import NS_PER_S, Instant, WheelSpeeds


class Feedback(Struct, frozen=True):
    """One good line: complete at `at`, `dt` s after the previous one.

    After a gap `dt` is 0 (how the robot moved in it is unknown) and `gap` is its length in s.
    `turned` is how far the wheels turned since the previous line by their encoders' counts, in rad
    and `WHEELS` order, where it is known; it also holds over a gap.
    """

    at: Instant
    speeds: WheelSpeeds
    dt: float
    gap: float = 0.0
    turned: Motors | None = None
    bridged: float = 0.0
    """s of `dt` that no line reported; the speeds of its neighbours stand in for them."""
    asked_ns: int | None = None
    """When the line it answers was made, monotonic, where the reply tells which one that is."""
    counted: Motors | None = None
    """rad in `WHEELS` order that the wheels turned in all of `dt` but `bridged`, where the speeds
    show whole counts (`snapping.py`)."""
    steps: Motors = (0.0, 0.0, 0.0, 0.0)
    """rad/s by which each wheel's speed steps for its encoder's sake; `math.inf` is not known."""


class Timeline:
    """Puts one good line after the other; remembers the last one's time and counts."""

    def __init__(self, mcu: McuConfig, codec: Codec, wheel_speed: float, quiet_ns: int) -> None:
        """`wheel_speed` rad/s is the fastest a wheel can turn; `quiet_ns` makes a link stale."""
        self._codec, self._baud_rate = codec, mcu.baud_rate
        self._encoders = Encoders(mcu.encoder_counts, wheel_speed, quiet_ns)
        self._counts = mcu.encoder_counts
        self._last: Instant | None = None
        self.leaps = 0
        """Readings whose counts no wheel can have made; the speeds stood in for them."""
        self.restarted = False
        """The last line's clock says that the MCU has started again."""

    def forget(self) -> None:
        """The next line's counts have nothing to do with the last one's."""
        self._encoders.forget()

    def place(
        self,
        speeds: WheelSpeeds,
        reading: Reading | None,
        read_at: Instant,
        following: int,
        gap: bool,
    ) -> Feedback:
        """The feedback of a line; `following` bytes came behind it in the same read.

        `gap` says that the link was silent before it.
        """
        # Bytes that followed in the same read were on the wire after this line was complete.
        age = wire_ns(following, self._baud_rate)
        at = Instant(read_at.mono_ns - age, read_at.wall_ns - age)
        last = self._last
        if last is not None and at.mono_ns < last.mono_ns:
            at = Instant(last.mono_ns, max(at.wall_ns, last.wall_ns))
        self._last = at
        turned = self._turned(reading, at.mono_ns)
        if last is None:
            return Feedback(at, speeds, 0.0)
        wheels = None
        if turned is not None:
            wheels = self._codec.wheels(turned.motors)
        since = (at.mono_ns - last.mono_ns) / NS_PER_S
        if gap or self.restarted:
            return Feedback(at, speeds, 0.0, gap=since, turned=wheels)
        return Feedback(at, speeds, since if turned is None else turned.dt, turned=wheels)

    def _turned(self, reading: Reading | None, at_ns: int) -> Turned | None:
        """How far the motors turned since the line before, if its counts tell."""
        self.restarted = False
        if reading is None or not self._counts:
            self._encoders.forget()
            return None
        turned = self._encoders.turned(reading, at_ns)
        if isinstance(turned, Turned):
            return turned
        self.restarted = turned == "restarted"
        self.leaps += turned == "leap"
        return None

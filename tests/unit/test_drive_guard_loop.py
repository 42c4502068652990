"""Robot and guard together: a healthy robot never trips the guard, whatever happens."""

from __future__ import annotations

from hypothesis import assume, given
from hypothesis import strategies as st

from acsard.core.config.contradictions import contradictions
from acsard.core.config.settings import Config, DriveConfig, FeedbackConfig, LimitsConfig
from acsard.core.guard import Guard
from acsard.core.values import REST, Plain, Request, Status, Twist
from tests.unit.rig import Rig


class Loop(Rig):
    """A robot whose lines pass a guard, as in the control loop; `wire` is the last sent line."""

    def __init__(self, config: Config) -> None:
        super().__init__(config)
        self.guard = Guard(self.codec.stop, config)
        self.superseded, self.trips, self.wire = False, list[str](), b""
        self.linked()

    def go(
        self, *twists: Twist, ms: float, goes: bool = True, request: Request | None = None
    ) -> None:
        """Make a step. `goes`: the line leaves the computer."""
        requests = (request,) if request else ()
        out = self.step(*twists, ms=ms, requests=requests, superseded=self.superseded)
        self.guard.use(self.robot.config)
        assert out.line is not None
        status = Status(out.mode, out.code, out.reason, out.link, out.source)
        data, trip = self.guard.check(out.line, self.now_ns, status, out.command_ns)
        self.trips += [trip] * bool(trip)
        self.superseded = not goes
        if goes:
            self.guard.record_written(data)
            self.wire = data

    def set_limits(self, ms: float, **limits: Plain) -> None:
        settings = {f"limits.{name}": value for name, value in limits.items()}
        self.go(ms=ms, request=Request("set", settings=settings))


@st.composite
def legal(draw: st.DrawFn) -> Config:
    """Return a random valid configuration. Its slowest ramps are often the longest allowed ones."""
    drive = DriveConfig(
        draw(st.floats(0.03, 0.2)),
        draw(st.floats(0.2, 0.8)),
        draw(st.floats(0.5, 2.0)),
        draw(st.floats(0.8, 1.2)),
        draw(st.floats(0.8, 1.2)),
    )
    wheel_speed = draw(st.floats(1.0, 90.0))
    sides = drive.left_wheel_radius_multiplier + drive.right_wheel_radius_multiplier
    rim = wheel_speed * drive.wheel_radius * sides / 2
    most = (rim, 2 * rim / (drive.wheel_separation * drive.wheel_separation_multiplier))
    numbers: dict[str, float] = {"wheel_speed": wheel_speed}
    for axis, reach, limit in zip(("linear", "angular"), most, (10.0, 50.0), strict=True):
        speed = draw(st.floats(0.0, limit))
        fastest = min(speed, reach)
        least = max(0.02, 1.001 * fastest / 5)
        softer = draw(st.one_of(st.just(least), st.floats(least, 100.0)))
        harder = max(softer, 1.001 * fastest / 2)
        numbers |= {
            f"{axis}_speed": speed,
            f"{axis}_acceleration": 100.0,
            f"{axis}_deceleration": softer,
            f"{axis}_stop_deceleration": draw(st.one_of(st.just(harder), st.floats(harder, 100.0))),
            f"{axis}_jerk": draw(st.sampled_from((0.0, 0.0, 500.0))),
        }
    feedback = FeedbackConfig(wheel_speed=99.99)
    return Config(drive=drive, limits=LimitsConfig(**numbers), feedback=feedback)


HAPPENINGS = (
    "silence", "stall", "superseded", "command", "half", "stop", "clear", "lower", "harder"
)  # fmt: skip


def happen(loop: Loop, what: str, steps: int, ms: float, full: Twist) -> None:
    """Apply one event in the middle of a ramp."""
    limits = loop.robot.config.limits
    match what:
        case "stall":
            loop.go(ms=ms * 10)
        case "superseded":
            for _ in range(steps):
                loop.go(ms=ms, goes=False)
        case "command" | "half":
            share = 1.0 if what == "command" else 0.5
            for _ in range(steps):
                loop.go(Twist(full.linear * share, full.angular * share), ms=ms)
        case "stop" | "clear":
            loop.go(ms=ms, request=Request(what))
        case "lower":
            loop.set_limits(
                ms, linear_speed=limits.linear_speed / 2, angular_speed=limits.angular_speed / 2
            )
        case "harder":
            loop.set_limits(ms, linear_deceleration=limits.linear_stop_deceleration)
    for _ in range(steps):
        loop.go(ms=ms)


@given(
    config=legal(),
    ms=st.sampled_from((10.0, 24.0, 90.0)),
    signs=st.tuples(st.sampled_from((-1, 0, 1)), st.sampled_from((-1, 0, 1))),
    happenings=st.lists(st.tuples(st.sampled_from(HAPPENINGS), st.integers(0, 12)), max_size=6),
)
def test_no_permitted_ramp_is_cut_short_whatever_events_interrupt_it(
    config: Config, ms: float, signs: tuple[int, int], happenings: list[tuple[str, int]]
) -> None:
    assume(not contradictions(config))
    loop = Loop(config)
    full = Twist(signs[0] * 10.0, signs[1] * 50.0)
    loop.go(REST, ms=10.0)
    for _ in range(30):
        loop.go(full, ms=24.0)
    for what, steps in happenings:
        happen(loop, what, steps, ms, full)
    for _ in range(round(5500 / ms)):
        loop.go(ms=ms)
    assert loop.trips == []
    assert loop.wire == loop.codec.stop

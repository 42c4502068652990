"""A speed limit only lowers the highest speed, whatever clients change while it applies."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsard.core.config.contradictions import contradictions
from acsard.core.config.live import changed
from acsard.core.config.parsing import ConfigError
from acsard.core.config.settings import Config
from acsard.core.incoming.commands import Arrival, Via
from acsard.core.incoming.speed_limit import (
    LOWERED_SETTING,
    MIN_INTERVAL_NS,
    SpeedLimiter,
    decode_limit,
)
from acsard.core.messages.encodings import FORMATS, DecodeError, Format, encode, encoding_name
from acsard.core.messages.schema import Header, SpeedLimit, Time
from acsard.core.ros.attachments import Attachment
from acsard.core.values import Answer, Event, Plain, Refusal, Request
from tests.each import each

FULL = SpeedLimit(Header(Time(12, 5), "map"), True, 40.0)


def arrival(payload: bytes, encoding: str = "", put: bool = True, via: Via = "native") -> Arrival:
    attachment = Attachment(1, 7, b"g" * 16).pack() if via == "rmw" else b""
    return Arrival("speed_limit", put, payload, encoding, 7, None, "", via, attachment)


def limit_message(value: object, **fields: Any) -> Arrival:
    """Return a message in hand-written JSON."""
    return arrival(json.dumps({"speed_limit": value} | fields).encode())


@each("named", [True, False])
@each("form", FORMATS)
def test_a_speed_limit_is_read_in_every_encoding(form: Format, named: bool) -> None:
    encoding = encoding_name(form, "SpeedLimit") if named else ""
    assert decode_limit(arrival(encode(FULL, form), encoding), 0.5).speed == pytest.approx(0.2)


def test_in_json_only_the_number_is_required_and_is_in_metres_per_second() -> None:
    assert decode_limit(limit_message(0.3), 1.0).speed == 0.3


@each(
    ("value", "percentage", "speed"),
    [(0.0, False, math.inf), (0.0, True, math.inf), (-0.0, False, math.inf), (100.0, True, 0.8),
     (50.0, True, 0.4), (9.0, False, 9.0), (1e-300, False, 1e-300)],
)  # fmt: skip
def test_zero_means_no_limit_and_a_percentage_refers_to_the_configured_speed(
    value: float, percentage: bool, speed: float
) -> None:
    assert decode_limit(limit_message(value, percentage=percentage), 0.8).speed == speed


def test_the_sender_of_a_limit_is_named() -> None:
    by = decode_limit(arrival(encode(FULL, "cdr"), via="rmw"), 1.0).by
    assert by == f"unnamed (rmw {(b'g' * 16).hex()}) on the key speed_limit"


REFUSED: dict[str, list[Arrival]] = {
    "out_of_range": [
        limit_message(-0.1),
        limit_message(-5.0, percentage=True),
        limit_message(100.1, percentage=True),
    ],
    "not_finite": [
        arrival(encode(SpeedLimit(Header(), share, value), "cdr"))
        for value in (math.nan, math.inf, -math.inf)
        for share in (False, True)
    ],
    "wrong_shape": [
        arrival(b"{}"),
        limit_message("fast"),
        limit_message(0.3, percent=True),
        limit_message(None),
    ],
    "malformed": [arrival(encode(FULL, "cdr")[:-1]), arrival(b'{"speed_limit": NaN}')],
    "unknown_encoding": [arrival(b"0.5")],
    "too_big": [arrival(b"{" + b" " * 5000)],
    "not_a_put": [arrival(encode(FULL, "json"), put=False)],
}


@each("reason", REFUSED)
def test_a_refused_message_is_reported_with_its_reason_and_keeps_the_earlier_limit(
    reason: str,
) -> None:
    for message in REFUSED[reason]:
        limiter, refusals = SpeedLimiter(Config()), list[Refusal]()
        limiter.receive(limit_message(0.5), 1.0, refusals)
        limiter.requests((), MIN_INTERVAL_NS)
        limiter.receive(message, 1.0, refusals)
        assert [refusal.reason for refusal in refusals] == [reason]
        assert refusals[0].text.startswith("speed_limit: ")
        assert limiter.requests((), 2 * MIN_INTERVAL_NS) == ((), []), "the earlier limit stays"


DAMAGE = st.lists(st.tuples(st.integers(0, 200), st.binary(max_size=8)), min_size=1, max_size=4)


@given(st.sampled_from(FORMATS), DAMAGE, st.booleans())
def test_a_damaged_message_is_refused_or_gives_a_limit_of_at_least_zero(
    form: Format, damage: list[tuple[int, bytes]], named: bool
) -> None:
    payload = encode(FULL, form)
    for at, data in damage:
        start = at % (len(payload) + 1)
        payload = payload[:start] + data + payload[start + 1 :]
    try:
        # A percentage of the smallest positive numbers is rounded to 0.
        assert (
            decode_limit(arrival(payload, encoding_name(form) if named else ""), 1.0).speed >= 0.0
        )
    except DecodeError:
        pass


class Robot:
    """A robot's configuration, which applies `set` requests as `core/robot.py` does."""

    def __init__(self) -> None:
        self.config = Config()
        self.limiter = SpeedLimiter(self.config)
        self.events: list[Event] = []
        self.now_ns = 10 * MIN_INTERVAL_NS
        self.peak = 0.0
        """Highest speed that was allowed at any moment of the last step, m/s."""

    def limit(self, value: float, percentage: bool = False) -> None:
        self.limiter.receive(limit_message(value, percentage=percentage), 1.0, [])

    def step(self, *wishes: Mapping[str, Plain], at_rest: bool = True) -> dict[int, Answer]:
        """Run a step with a `set` request for each dict. Return the answers by request number."""
        self.now_ns += MIN_INTERVAL_NS
        requests = [
            Request("set", number, settings=dict(wish)) for number, wish in enumerate(wishes, 1)
        ]
        batch, refused = self.limiter.requests(tuple(requests), self.now_ns)
        answers, self.peak = list[Answer](), self.config.limits.linear_speed
        for request in batch:
            try:
                self.config, news = changed(self.config, request.settings, at_rest)
                answers.append(Answer(request.id, True, news))
            except ConfigError as error:
                answers.append(Answer(request.id, False, str(error)))
            # The robot drives at the end of a step only.
        self.peak = self.config.limits.linear_speed
        results = (*refused, *self.limiter.settle(self.config, answers, self.events))
        return {answer.id: answer for answer in results}

    @property
    def speed(self) -> float:
        return self.config.limits.linear_speed


def test_a_limit_lowers_the_setting_and_its_end_restores_the_setting() -> None:
    robot = Robot()
    robot.limit(0.3)
    robot.step()
    assert robot.speed == 0.3
    assert (
        robot.limiter.text
        == "0.3 m/s, set by unnamed (native) on the key speed_limit; back to 1 m/s when this limit "
        "ends"
    )
    robot.limit(0.0)
    robot.step()
    assert (robot.speed, robot.limiter.text) == (1.0, "")
    assert robot.limiter.settings is robot.config


@each("value", [1.0, 1.5, 50.0])
def test_a_limit_above_the_setting_raises_nothing(value: float) -> None:
    robot = Robot()
    robot.limit(value)
    robot.step()
    assert (robot.speed, robot.limiter.text) == (1.0, "")


def test_a_set_below_the_limit_applies_immediately_and_stays_when_the_limit_ends() -> None:
    robot = Robot()
    robot.limit(0.5)
    robot.step()
    assert robot.step({LOWERED_SETTING: 0.2})[1].success
    assert (robot.speed, robot.limiter.text) == (0.2, "")
    robot.limit(0.0)
    robot.step()
    assert robot.speed == 0.2


def test_a_set_above_the_limit_waits_for_its_end_and_the_answer_says_so() -> None:
    robot = Robot()
    robot.limit(0.3)
    robot.step()
    answer = robot.step({LOWERED_SETTING: 0.8})[1]
    text = (
        "limits.linear_speed = 0.8 will apply when the limit of 0.3 m/s ends "
        "(unnamed (native) on the key speed_limit)"
    )
    assert answer == Answer(1, True, text)
    assert [(event.name, event.text) for event in robot.events] == [("set", text)]
    assert (robot.speed, robot.limiter.settings.limits.linear_speed) == (0.3, 0.8)
    robot.limit(0.0)
    robot.step()
    assert robot.speed == 0.8


def test_the_answer_also_names_the_settings_that_apply_immediately() -> None:
    robot = Robot()
    robot.limit(0.3)
    robot.step()
    answer = robot.step({LOWERED_SETTING: 0.8, "limits.linear_acceleration": 0.5})[1]
    text = "limits.linear_acceleration = 0.5 (was 1.0); limits.linear_speed = 0.8 will apply when"
    assert text in answer.message


def test_a_limit_and_a_higher_set_in_one_step_leave_the_limit_in_force() -> None:
    robot = Robot()
    robot.limit(0.3)
    robot.step({LOWERED_SETTING: 1.4})
    assert robot.speed == 0.3
    robot.limit(0.0)
    robot.step()
    assert robot.speed == 1.4


def test_a_set_that_contradicts_the_setting_under_the_limit_is_refused() -> None:
    """The new deceleration is enough at the limited 0.3 m/s.

    It is not enough at the configured 1 m/s, which applies again after the limit.
    """
    robot = Robot()
    robot.limit(0.3)
    robot.step()
    answer = robot.step({"limits.linear_deceleration": 0.15})[1]
    assert not answer.success
    assert "braking from full speed (1 m/s)" in answer.message
    assert robot.config.limits.linear_deceleration == Config().limits.linear_deceleration


@each(
    "wish",
    [
        {LOWERED_SETTING: 11.0},
        {LOWERED_SETTING: "fast"},
        {LOWERED_SETTING: -1.0},
        {"limits.nothing": 1.0},
    ],
)
def test_an_invalid_set_is_refused_in_the_same_way_with_and_without_a_limit(
    wish: dict[str, Plain],
) -> None:
    plain, limited = Robot(), Robot()
    limited.limit(0.3)
    limited.step()
    assert limited.step(wish) == plain.step(wish)
    assert limited.limiter.settings.limits.linear_speed == 1.0


def test_two_sets_of_one_step_are_processed_one_after_the_other() -> None:
    """Each request is valid alone. Together they contradict each other when the limit ends."""
    robot = Robot()
    robot.limit(0.3)
    robot.step()
    first = robot.step({"limits.linear_deceleration": 0.2}, {LOWERED_SETTING: 1.2})
    assert list(first) == [1]
    assert first[1].success
    second = robot.step()
    assert list(second) == [2]
    assert not second[2].success


def test_a_flood_of_messages_changes_the_limit_at_most_ten_times_a_second() -> None:
    limiter, changes = SpeedLimiter(Config()), 0
    for step in range(200):
        limiter.receive(limit_message(0.2 + 0.001 * step), 1.0, [])
        batch, _ = limiter.requests((), 10 * MIN_INTERVAL_NS + step * MIN_INTERVAL_NS // 10)
        changes += len(batch)
        config = Config() if not batch else changed(Config(), batch[0].settings, True)[0]
        if batch:
            limiter.settle(config, [], [])
    assert changes == 20


WISHES = st.dictionaries(
    st.sampled_from([LOWERED_SETTING, "limits.linear_deceleration",
                     "limits.linear_stop_deceleration", "limits.wheel_speed",
                     "limits.linear_acceleration"]),
    st.floats(0.01, 60.0) | st.just("x"),
    min_size=1,
    max_size=2,
)  # fmt: skip
LIMITS = st.tuples(st.floats(0.0, 3.0), st.just(False)) | st.tuples(
    st.floats(0.0, 100.0), st.just(True)
)


@given(st.lists(st.tuples(st.none() | LIMITS, st.lists(WISHES, max_size=2), st.booleans())))
def test_the_lower_one_of_limit_and_setting_wins_after_each_step(steps: list[Any]) -> None:
    robot, limit = Robot(), math.inf
    for message, wishes, at_rest in steps:
        if message is not None:
            value, share = message
            robot.limit(value, share)
            limit = math.inf if value == 0.0 else value / 100.0 if share else value
        robot.step(*wishes, at_rest=at_rest)
        settings = robot.limiter.settings
        assert robot.speed == min(limit, settings.limits.linear_speed)
        assert contradictions(settings) == [], "or the end of the limit would be refused"
    robot.limit(0.0)
    robot.step()
    robot.step()
    assert robot.config == robot.limiter.settings

"""A speed limit is decoded from every encoding, or refused with a reason."""

from __future__ import annotations

import json
import math
from contextlib import suppress
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsard.core.incoming.commands import Arrival, Via, decode_limit
from acsard.core.messages.encodings import FORMATS, DecodeError, Format, encode, encoding_name
from acsard.core.messages.schema import Header, SpeedLimit, Time
from acsard.core.ros.attachments import Attachment
from tests.each import each

FULL = SpeedLimit(header=Header(Time(12, 5), "map"), percentage=True, speed_limit=40.0)


def arrival(payload: bytes, encoding: str = "", put: bool = True, via: Via = "native") -> Arrival:
    attachment = Attachment(1, 7, b"g" * 16).pack() if via == "rmw" else b""
    return Arrival("speed_limit", put, payload, encoding, 7, None, "", via, attachment)


def typed(value: object, **fields: Any) -> Arrival:
    """Return a message in hand-written JSON."""
    return arrival(json.dumps({"speed_limit": value} | fields).encode())


LIMITS: list[tuple[Arrival, float | str | None]] = [
    *((arrival(encode(FULL, form), encoding), 0.32) for form in FORMATS
      for encoding in ("", encoding_name(form, "SpeedLimit"))),
    # In m/s, or in percent of the configured 0.8 m/s. Zero means no limit.
    (typed(0.3), 0.3), (typed(9.0), 9.0), (typed(1e-300), 1e-300), (typed(0.0), None),
    (typed(-0.0), None), (typed(0.0, percentage=True), None), (typed(100.0, percentage=True), 0.8),
    (typed(50.0, percentage=True), 0.4),
    (typed(-0.1), "out_of_range"), (typed(-5.0, percentage=True), "out_of_range"),
    (typed(100.1, percentage=True), "out_of_range"),
    *((arrival(encode(SpeedLimit(percentage=share, speed_limit=value), "cdr")), "not_finite")
      for value in (math.nan, math.inf, -math.inf) for share in (False, True)),
    (arrival(b"{}"), "wrong_shape"), (typed("fast"), "wrong_shape"), (typed(None), "wrong_shape"),
    (typed(0.3, percent=True), "wrong_shape"), (arrival(encode(FULL, "cdr")[:-1]), "malformed"),
    (arrival(b'{"speed_limit": NaN}'), "malformed"), (arrival(b"0.5"), "unknown_encoding"),
    (arrival(b"{" + b" " * 5000), "too_big"),
    (arrival(encode(FULL, "json"), put=False), "not_a_put"),
]  # fmt: skip


@each(("message", "verdict"), LIMITS)
def test_a_speed_limit_is_accepted_or_refused_with_its_reason(
    message: Arrival, verdict: float | str | None
) -> None:
    if isinstance(verdict, str):
        with pytest.raises(DecodeError) as refusal:
            decode_limit(message, 0.8)
        assert refusal.value.reason == verdict
    else:
        assert decode_limit(message, 0.8).speed == (verdict and pytest.approx(verdict))


def test_the_sender_of_a_limit_is_named() -> None:
    by = decode_limit(arrival(encode(FULL, "cdr"), via="rmw"), 1.0).by
    assert by == f"unnamed (rmw {(b'g' * 16).hex()}) on the key speed_limit"


DAMAGE = st.lists(st.tuples(st.integers(0, 200), st.binary(max_size=8)), min_size=1, max_size=4)


@given(st.sampled_from(FORMATS), DAMAGE, st.booleans())
def test_a_damaged_message_is_refused_or_gives_a_limit_of_at_least_zero(
    form: Format, damage: list[tuple[int, bytes]], named: bool
) -> None:
    payload = encode(FULL, form)
    for at, data in damage:
        start = at % (len(payload) + 1)
        payload = payload[:start] + data + payload[start + 1 :]
    with suppress(DecodeError):
        # A percentage of the smallest positive numbers is rounded to 0.
        speed = decode_limit(arrival(payload, encoding_name(form) if named else ""), 1.0).speed
        assert speed is None or speed >= 0.0

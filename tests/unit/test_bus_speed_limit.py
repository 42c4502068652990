"""A speed limit is decoded from every encoding, or refused with a reason."""

from __future__ import annotations

import json
import math
from contextlib import suppress
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsard.core.incoming.commands import Arrival, Via
from acsard.core.incoming.speed_limit import decode_limit
from acsard.core.messages.encodings import FORMATS, DecodeError, Format, encode, encoding_name
from acsard.core.messages.schema import Header, SpeedLimit, Time
from acsard.core.ros.attachments import Attachment
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
    [(0.0, False, None), (0.0, True, None), (-0.0, False, None), (100.0, True, 0.8),
     (50.0, True, 0.4), (9.0, False, 9.0), (1e-300, False, 1e-300)],
)  # fmt: skip
def test_zero_means_no_limit_and_a_percentage_refers_to_the_configured_speed(
    value: float, percentage: bool, speed: float | None
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
def test_an_invalid_message_is_refused_with_its_reason(reason: str) -> None:
    for message in REFUSED[reason]:
        with pytest.raises(DecodeError) as refusal:
            decode_limit(message, 1.0)
        assert refusal.value.reason == reason


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

"""A viewer's message is accepted whole or refused with the reason."""

from __future__ import annotations

import pytest

from acsard.client.commander import Wish
from acsard.core.messages.encodings import DecodeError, encode
from acsard.core.messages.schema import Header, Time, TwistStamped, Vector3
from acsard.core.messages.schema import Twist as Message
from acsard.core.values import NS_PER_S, Twist
from acsard.foxglove.twists import encoding_of, wish
from tests.each import each

MESSAGE = Message(Vector3(x=0.3), Vector3(z=-0.2))
STAMPED = TwistStamped(Header(Time(5)), MESSAGE)


@each("name", ["geometry_msgs/Twist", "geometry_msgs/msg/Twist"])
@each("form", ["json", "cdr"])
def test_a_panel_s_twist_is_read(name: str, form: str) -> None:
    encoding = encoding_of(form, name)
    found = wish(encoding, encode(MESSAGE, "json" if form == "json" else "cdr"))
    assert found == Wish(Twist(0.3, -0.2))


@pytest.mark.parametrize("form", ["json", "cdr"])
def test_a_stamped_one_too_with_its_stamp(form: str) -> None:
    encoding = encoding_of(form, "geometry_msgs/msg/TwistStamped")
    found = wish(encoding, encode(STAMPED, "json" if form == "json" else "cdr"))
    assert found == Wish(Twist(0.3, -0.2), 5 * NS_PER_S)


@each(
    ("form", "name"),
    [
        ("json", "std_msgs/msg/String"),
        ("json", "Twist"),
        ("json", ""),
        ("ros1", "geometry_msgs/Twist"),
        ("", "geometry_msgs/Twist"),
    ],
)
def test_what_drives_nothing_is_told_before_it_is_sent(form: str, name: str) -> None:
    with pytest.raises(DecodeError, match="wanted"):
        encoding_of(form, name)


@each(
    "payload",
    [
        b"",
        b"{}",
        b'{"linear": {"x": 1}}',
        b'{"linear": {"x": "fast"}, "angular": {}}',
        b'{"linear": {"x": NaN}, "angular": {}}',
        b'{"linear": {"x": 1}, "angular": {}, "more": 1}',
        b"\xff" * 60,
        b'{"linear": {"x": 1}, "angular": {}}' + b" " * 5000,
    ],
)
def test_what_is_no_twist_is_refused(payload: bytes) -> None:
    for encoding in (encoding_of("json", "geometry_msgs/Twist"),):
        with pytest.raises(DecodeError):
            wish(encoding, payload)


@each("cut", range(0, 52, 4))
def test_cdr_cut_anywhere_is_refused(cut: int) -> None:
    with pytest.raises(DecodeError):
        wish(encoding_of("cdr", "geometry_msgs/Twist"), encode(MESSAGE, "cdr")[:cut])

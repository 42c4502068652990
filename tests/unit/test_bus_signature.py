"""The daemon reads the sender of a command from acsard's attachment, if the message has one."""

from __future__ import annotations

import hashlib
import json

import msgspec
from hypothesis import given
from hypothesis import strategies as st

from acsard.core.messages.schema import Beat
from acsard.core.messages.signature import (
    HASH_DIGITS,
    MAX_NAME_LENGTH,
    Signature,
    claims_echo,
    public_name,
    unpack,
)
from acsard.daemon.bus.inbox import MAX_ATTACHMENT_BYTES
from tests.each import each

WHOLE = {"sender": "joystick-7", "stamp": 1_795_154_884_365_624_370, "sequence": 12}


def test_a_packed_signature_is_unpacked_unchanged() -> None:
    signature = Signature("laptop/12/ab", 5, 1, echo=Beat((1 << 48) - 1, (1 << 53) - 1))
    assert unpack(signature.pack()) == signature


@each("form", [lambda fields: json.dumps(fields).encode(), msgspec.msgpack.encode])
@each("left_out", [(), ("stamp",), ("sequence",), ("stamp", "sequence")])
def test_a_map_in_json_or_msgpack_with_a_sender_is_a_signature(
    form: object, left_out: tuple[str, ...]
) -> None:
    assert callable(form)
    fields = {name: value for name, value in WHOLE.items() if name not in left_out}
    signature = unpack(form(fields))
    assert signature == Signature("joystick-7", fields.get("stamp"), fields.get("sequence"))  # type: ignore[arg-type]


@each(
    "attachment",
    [
        b"",
        b"{",
        b"traceparent=00-1",
        b"\x81",
        json.dumps({"stamp": 5}).encode(),
        json.dumps(WHOLE | {"sender": ""}).encode(),
        json.dumps(WHOLE | {"sender": "x" * 65}).encode(),
        json.dumps(WHOLE | {"stamp": -1}).encode(),
        json.dumps(WHOLE | {"stamp": 1 << 70}).encode(),
        json.dumps(WHOLE | {"sequence": 1.5}).encode(),
        msgspec.msgpack.encode([1, 2, 3]),
        b'{"later": '.ljust(MAX_ATTACHMENT_BYTES, b"["),
        b"\x81\xa5later".ljust(MAX_ATTACHMENT_BYTES, b"\x91"),
    ],
)
def test_any_other_attachment_is_not_a_signature(attachment: bytes) -> None:
    assert unpack(attachment) is None


@given(st.binary(max_size=80))
def test_unpacking_any_bytes_raises_no_error(attachment: bytes) -> None:
    for received in (attachment, b"{" + attachment):
        unpack(received)
        claims_echo(received)


@each(
    ("sender", "name"),
    [
        ("joystick/s3cret", "joystick"),
        ("laptop/12/s3cret", "laptop/12"),
        ("mallory (rmw 00)/x", "mallory ?rmw 00?"),
        ("a\nACSARD_EVENT=stop/x", "a?ACSARD_EVENT?stop"),
        ("J\u00fcrgen/x", "J\u00fcrgen"),
        ("x" * 50 + "/s3cret", "x" * MAX_NAME_LENGTH),
    ],
)
def test_a_public_name_is_the_name_without_the_secret_and_a_hash_of_both(
    sender: str, name: str
) -> None:
    digits = hashlib.sha256(sender.encode()).hexdigest()[:16]
    assert public_name(sender) == f"{name}/{digits}"


@each("sender", ["s3cret", "/s3cret", " /s3cret", "1f2e" * 8])
def test_the_public_name_of_a_sender_id_without_a_name_is_only_a_hash(sender: str) -> None:
    assert public_name(sender) == hashlib.sha256(sender.encode()).hexdigest()[:16]


@given(st.text(min_size=1, max_size=64))
def test_any_sender_id_has_a_short_printable_public_name_that_is_not_its_own(sender: str) -> None:
    name = public_name(sender)
    assert name != sender
    assert len(name) <= MAX_NAME_LENGTH + 1 + HASH_DIGITS
    assert name.isprintable()
    assert not set(name) & set('(),="[]\n')
    assert public_name(name) != name

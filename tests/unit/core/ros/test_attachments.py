"""acsard packs and unpacks rmw_zenoh's attachment of 33 bytes exactly, and refuses other bytes."""

from __future__ import annotations

import pytest
import zenoh.ext
from hypothesis import given
from hypothesis import strategies as st

from acsard.core.messages.encodings import DecodeError
from acsard.core.ros.attachments import Attachment, unpack
from tests.each import each

GID = bytes.fromhex("ac170f31eadcd9ff0cd86d7a17907d1c")
CAPTURED = bytes.fromhex("010000000000000015cd853dfe9c971710" + GID.hex())

attachments = st.builds(
    Attachment,
    st.integers(-(2**63), 2**63 - 1),
    st.integers(-(2**63), 2**63 - 1),
    st.binary(min_size=16, max_size=16),
)


def test_the_captured_bytes_are_written_and_read_exactly() -> None:
    attachment = Attachment(1, 1_700_000_000_123_456_789, GID)
    assert attachment.pack() == CAPTURED
    assert unpack(CAPTURED) == attachment


@given(attachments)
def test_the_serializer_of_zenoh_writes_the_same_bytes(attachment: Attachment) -> None:
    fields = (
        zenoh.ext.Int64(attachment.sequence),
        zenoh.ext.Int64(attachment.stamp_ns),
        attachment.gid,
    )
    packed = attachment.pack()
    assert packed == zenoh.ext.z_serialize(fields).to_bytes()
    assert unpack(packed) == attachment


def reason(data: bytes) -> str:
    with pytest.raises(DecodeError) as caught:
        unpack(data)
    return caught.value.reason


def test_a_missing_attachment_has_its_own_reason() -> None:
    assert reason(b"") == "no_attachment"


@each("length", [1, 16, 20, 32, 34, 64])
def test_an_attachment_of_another_length_is_refused(length: int) -> None:
    assert reason((CAPTURED * 2)[:length]) == "bad_attachment"


@each("length", [0, 15, 17, 255])
def test_an_attachment_with_another_gid_length_is_refused(length: int) -> None:
    assert reason(CAPTURED[:16] + bytes([length]) + CAPTURED[17:]) == "bad_attachment"


@given(st.binary(max_size=70))
def test_any_bytes_are_an_attachment_or_refused(data: bytes) -> None:
    try:
        assert unpack(data).pack() == data
    except DecodeError as error:
        assert error.reason in ("no_attachment", "bad_attachment")  # noqa: PT017

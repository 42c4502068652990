"""The name of a client that sent a request cannot forge any other part of the message."""

from __future__ import annotations

import msgspec
from hypothesis import given
from hypothesis import strategies as st

from acsard.core.incoming.commands import caller_name
from acsard.core.messages.signature import DIGITS, MAX_NAME, public_name
from tests.each import each


def signed(name: str) -> bytes:
    return msgspec.json.encode({"sender": name})


def test_a_native_call_has_the_name_it_gives() -> None:
    for form in (msgspec.json, msgspec.msgpack):
        signature = form.encode({"sender": "alice@laptop patrol/s3cret", "sequence": 7})
        assert caller_name("native", signature) == "alice@laptop patrol/b8978a0526b85c8d (native)"


@each(
    "attachment",
    [b"", b"joe", b"{}", b'{"sender": 7}', b'{"sender": "\xff"}', b"\x81", signed("")],
)
def test_who_gives_no_name_is_unnamed(attachment: bytes) -> None:
    assert caller_name("native", attachment) == "unnamed (native)"


def test_what_was_stamped_tells_the_session_that_stamped_it() -> None:
    session = public_name("1f2e")
    assert caller_name("native", b"", "1f2e") == f"unnamed (native, session {session})"


def test_an_rmw_client_is_its_gid() -> None:
    gid = bytes(range(16))
    assert caller_name("rmw", bytes(17) + gid) == f"unnamed (rmw {gid.hex()})"


def test_a_bridge_tells_nothing() -> None:
    assert caller_name("bridge", b"rqh" + bytes(17)) == "unnamed (bridge)"


@each(
    ("name", "kept"),
    [
        ("mallory (rmw 00)", "mallory ?rmw 00?"),
        ("a, b", "a? b"),
        ("a\nACSARD_EVENT=stop", "a?ACSARD_EVENT?stop"),
        ("\x1b[2J", "??2J"),
        ("\u202elaptop", "?laptop"),
        ("Jürgen", "Jürgen"),
    ],
)
def test_a_name_cannot_pass_for_the_words_around_it(name: str, kept: str) -> None:
    who = caller_name("native", signed(f"{name}/s3cret"))
    assert who == f"{kept}/{public_name(f'{name}/s3cret')[-DIGITS:]} (native)"


@given(st.binary(max_size=100) | st.text(max_size=100).map(signed))
def test_any_attachment_makes_a_short_printable_name(attachment: bytes) -> None:
    who = caller_name("native", attachment)
    name = who.removesuffix(" (native)")
    assert who == f"{name} (native)"
    assert 1 <= len(name) <= MAX_NAME + 1 + DIGITS
    assert name.isprintable()
    assert not set(name) & set('(),="\n')

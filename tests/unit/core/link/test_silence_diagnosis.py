"""Tests of the sentences about a board that does not link up, each with an action."""

from __future__ import annotations

import pytest

from acsard.core.link.lines import LineReader
from acsard.core.link.silence_diagnosis import MENDS, PATIENCE_NS, Heard, Look, SilenceDiagnosis

GOOD = b"ap00.00,bp00.00,cp00.00,dp00.00\r\n"

HEARD: dict[str, tuple[bytes, Look, str]] = {
    "mute": (b"", "nothing", "nothing was received"),
    "half lines": (
        b"ap00.00,bp00.00,c" * 9,
        "cut",
        "153 bytes received but no line end; the last bytes are `",
    ),
    "cut lines": (b"ap00.00,bp0\r\n" * 4, "cut", "none good, the last `ap00.00,bp0`"),
    "noise": (
        (b"\x00\xff~" + GOOD) * 144,
        "foreign",
        r"144 lines received, none good, the last `\x00\xff~ap00.00,bp00.00,cp00.00,dp00.00`",
    ),
    "wrong baud rate": (b"\xf8\x00\xe6\n\x9e" * 3, "garbage", "3 lines received, none good"),
    "no end": (
        b"\xf8\x00\xe6" * 3, "garbage", r"the last bytes are `\xf8\x00\xe6\xf8\x00\xe6\xf8\x00\xe6`"
    ),
    "some good": (GOOD + b"ap?\r\n", "few", "2 lines received, only 1 good, the last other `ap?`"),
    "all good": (GOOD * 2, "sparse", "2 lines received, all of them good, but too few"),
}  # fmt: skip


def heard(data: bytes) -> Heard:
    found = Heard()
    found.take(data)
    for line, _ in LineReader().feed(data):
        found.line(line, line + b"\r\n" == GOOD)
    return found


@pytest.mark.parametrize(("data", "looks", "counted"), HEARD.values(), ids=HEARD)
def test_it_says_what_was_heard_how_that_looks_and_what_to_do(
    data: bytes, looks: Look, counted: str
) -> None:
    found = heard(data)
    assert found.looks == looks
    assert counted in found.counted
    assert found.words.startswith(f"the microcontroller: {found.counted}; {MENDS[looks]}")
    assert "`acsard mcu check`" in found.words


def test_it_is_told_after_three_seconds_and_again_only_when_it_looks_otherwise() -> None:
    hearing, told = SilenceDiagnosis(), []
    for tick in range(100):
        now_ns = tick * PATIENCE_NS // 10
        if tick > 50:
            hearing.now.take(b"\x00")
        if hearing.judge(now_ns):
            assert hearing.heard is not None
            told.append((tick, hearing.heard.looks))
    assert told == [(10, "nothing"), (60, "garbage")]
    hearing.forget()
    assert hearing.heard is None
    assert not hearing.judge(10 * PATIENCE_NS)

"""Tests of the text about a link that is down.

The reasons are the received bytes, rare lines, and delays of this computer.
"""

from __future__ import annotations

import pytest

from acsard.core.config.settings import McuConfig
from acsard.core.link.host_stalls import is_ours
from tests.unit.core.link.test_session import GOOD, Bench


def test_a_board_that_only_prints_noise_is_told_with_what_it_said() -> None:
    bench = Bench().open()
    texts = []
    for tick in range(500):
        bench.wait(10, *([b"\x00\xff~" + GOOD] if tick % 2 else []))
        texts += [event.text for event in bench.session.events if event.name == "link_booting"]
    told = [text for text in texts if "none good" in text]
    assert len(told) == 1
    assert "150 lines received, none good, the last `" in told[0]
    assert bench.session.words() == told[0]
    bench.wait(10, GOOD * 3)
    assert bench.session.words() == "linked"


def test_a_link_that_fell_silent_says_so_first_and_then_what_is_heard() -> None:
    bench = Bench().up()
    for _ in range(20):
        bench.wait(10)
    assert bench.session.words().startswith(
        "the built-in simulator, which is a part of this program, is late"
    )
    for _ in range(302):
        bench.wait(10)
    assert "nothing was received" in bench.session.words()


@pytest.mark.parametrize(
    ("apart", "longest", "told", "untold"),
    [
        (20, 0.25, "set mcu.reply_period = 0.20", "seldom"),
        (20, 0.15, "at least every 0.15 s", "mcu.reply_period"),
        (74, 0.25, "at least every 0.25 s", "mcu.reply_period"),
        (136, 0.25, "at least every 0.25 s", "mcu.reply_period"),
    ],
)
def test_lines_too_far_apart_are_told_and_no_setting_that_would_be_refused(
    apart: int, longest: float, told: str, untold: str
) -> None:
    bench = Bench(McuConfig(port="/dev/board"), longest_reply=longest).open()
    for tick in range(600):
        bench.wait(10, *([] if tick % apart else [GOOD]))
    assert f"lines come {apart / 100:.2f} s apart" in bench.session.words()
    assert told in bench.session.words()
    assert untold not in bench.session.words()


def test_one_silence_is_no_clock_of_the_boards_own() -> None:
    bench = Bench(McuConfig(port="/dev/board")).up()
    for _ in range(20):
        bench.wait(10)
    bench.wait(10, GOOD)
    assert (bench.link(), "reply_period" in bench.session.words()) == ("stale", False)


@pytest.mark.parametrize("port", ["sim", "/dev/board"])
def test_lines_that_we_were_late_to_hear_are_no_advice_about_the_board(port: str) -> None:
    bench = Bench(McuConfig(port=port)).up()
    told = set()
    for _ in range(20):  # this computer runs a step late and finds the bytes that arrived meanwhile
        bench.wait(200)
        told.add(bench.session.words())
        bench.wait(10, GOOD)
        told.add(bench.session.words())
    assert not [words for words in told if "reply_period" in words or "seldom" in words]
    assert any(is_ours(words) for words in told)

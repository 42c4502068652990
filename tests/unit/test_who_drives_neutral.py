"""The neutral-first rule: a zero arms a sender, and where a source says so a pause."""

from __future__ import annotations

import pytest

from acsard.core.motion.arbiter import MAX_ANNOUNCED, MAX_SENDERS
from acsard.core.values import Command
from tests.each import each
from tests.unit.commanders import GO, MS, TWISTS, Commanders


@pytest.mark.parametrize("shared", ["", "*"])
def test_ten_seconds_without_an_accepted_command_disarm(shared: str) -> None:
    for silent_ms, driver in ((10_000, "high.a"), (10_001, "-")):
        one = Commanders().play(f"high.a{shared} zero; 1000 high.a{shared} go > high.a")
        one.play(f"{silent_ms} high.a{shared} go > {driver}")


# an identity that several programs may share

SHARED = {
    "its zero arms at once": "high.a* zero; high.a* go > -",
    "nearly a second": "high.a* zero; 999 high.a* go > -",
    "a second without a speed": "high.a* zero; 1000 high.a* go > high.a",
    "more zeros do not restart it": "high.a* zero; 500 high.a* zero; 500 high.a* go > high.a",
    "a speed of another one ends it": "high.a* zero; 500 high.b* go; 700 high.a* go > -",
    "not a speed of a single program": "high.a* zero; 500 high.b go; 700 high.a* go > high.a",
    "what is unreadable ends it": "high.a* zero; 500 high.a unreadable; 700 high.a* go > -",
    "its own only": "high.a* zero; 500 high.b unreadable; 700 high.a* go > high.a",
    "what is unreadable arms nobody": "high.a unreadable; stranger.a unreadable; 1000 high.a go > -"
    " ? high neutral",
}
PAUSE = {
    "not the first command of a publisher": "pause.a#1 go > - ? pause neutral",
    "not one before the event of its step": "pause.a#7 zero; 1000 reset; -2 pause.a#8 go; 2 > -",
    "not if commands behind the zero were lost": "pause.a#7 zero; 1100 pause.a#12 go > -",
    "the successor of a zero": "pause.a#7 zero; 1000 reset; pause.a#8 go > pause.a",
    "hours later, too": "pause.a#7 zero; 7200000 pause.a#8 go > pause.a",
    "not sooner than a second": "pause.a#7 zero; reset; 999 pause.a#8 go > -",
    "not if a number is missing": "pause.a#7 zero; 20000 pause.a#9 go > -",
    "not the successor of a speed": "pause.a#7 go; 20000 pause.a#8 go > -",
    "not for a number again": "pause.a#7 zero; pause.a#8 go; 20000 pause.a#8 go > -",
    "not at another source": "low.a#1 go > -; 20000 low.a#2 go > -",
    "a zero of ROS needs a second": "pause.a#7 zero; 999 pause.a#8 go > -",
    "and no speed in it": "pause.a#7 zero; 500 pause.a#8 go; 600 pause.a#9 go > -",
    "then it arms": "pause.a#7 zero; 500 pause.a#8 zero; 500 pause.a#9 go > pause.a",
    "a zero of one with an id does not wait": "pause.a zero; pause.a go > pause.a",
    "not on a plain key": "pause.a go > -; 100000 pause.a go > -; 100000 pause.a* go > -",
    "a bridge that was there, and silent": "+pause; 10000 pause.a^ go > pause.a",
    "not sooner than its lease": "+pause; 9999 pause.a^ go > -",
    "not without its token": "11000 pause.a^ go > -; +pause; -pause; 20000 pause.a^ go > -",
    "not while another one speaks": "+pause; 6000 pause.b^ go; 6000 pause.a^ go > -",
    "not if a second bridge came": "+pause; 6000 +pause; 6000 pause.a^ go > -",
    "nor if one of two went": "+pause; +pause; 6000 -pause; 9999 pause.a^ go > -",
    "not if the daemon stood still": "wake; +pause; 9000 wake; 2000 pause.a^ go > -",
    "between zero and proof": "+pause; pause.a^ zero; 11000 pause.a^ go > pause.a",
    "a publisher of before": "+pause.a; 61000 pause.a#500 go > pause.a",
    "not sooner than the lease of rmw": "+pause.a; 60999 pause.a#500 go > -",
    "not by the token of another": "+pause.b; 61000 pause.a#500 go > -",
    "not while its numbers tell more": "+pause.a; pause.a#5 go; 61000 pause.a#7 go > -",
    "not by a native number": "pause.a zero; reset; 1000 pause.a go > -",
}


@each(("name", "story"), [*SHARED.items(), *PAUSE.items()])
def test_shared_identities_and_pauses(name: str, story: str) -> None:
    Commanders().play(story)


def test_a_bridged_sender_that_was_replaced_has_spoken_all_the_same() -> None:
    one = Commanders().play("+pause; 6000 pause.first^ go")
    for number in range(MAX_SENDERS):
        one.play(f"pause.{number} go")
    one.play("6000 pause.a^ go > -; 11000 pause.a^ go > pause.a")


def test_a_publisher_that_was_replaced_or_unreadable_was_not_silent() -> None:
    one = Commanders().play("+pause.a; pause.a#500 go; 61000 pause.a#501 go > -")
    for number in range(MAX_SENDERS):
        one.play(f"pause.{number} go")
    one.play("20 pause.a#519 go > -")
    one = Commanders()
    for number in range(MAX_SENDERS):
        one.play(f"pause.{number} zero")
    one.play("+pause.a")
    for step in range(310):
        for number in range(MAX_SENDERS):
            one.play(f"pause.{number} zero")
        one.play(f"100 pause.a#{500 + step} go ! too_many_senders; 100")
    one.play("500 pause.a#900 go > -")
    one = Commanders().play("+pause.a; 61000 pause.a nan ! not_finite; 100 pause.a#500 go > -")
    one = Commanders().play("+pause.a; 61000 pause.a unreadable; 100 pause.a#500 go > -")


def test_no_number_of_tokens_takes_memory_for_ever() -> None:
    one = Commanders()
    for number in range(2 * MAX_ANNOUNCED):
        one.play(f"+pause.{number}")
    assert len(one.arbiter.sources["pause"].announced) == MAX_ANNOUNCED
    one.play("-pause.0; +pause.1; 61000 pause.1#500 go > pause.1; pause.90#500 go > pause.1")


@each("pause_s", [1.0, 5.0, 9.9, 10.1, 10.9, 11.1, 15.0, 60.0, 3600.0])
@each("who", ["pause.a#{}", "pause.a^"])
def test_each_goal_after_the_first_drives_without_a_hand(pause_s: float, who: str) -> None:
    """Nav2 sends a zero at the end of each goal, and then nothing."""
    one, number = Commanders().play("+pause; +pause.a"), 100
    one.play(f"50 {who.format(number)} zero")
    for _ in range(4):
        one.wait(1000 * pause_s)
        for _ in range(40):
            number += 1
            one.play(f"50 {who.format(number)} go")
        one.play("> pause.a")
        number += 1
        one.play(f"50 {who.format(number)} zero")


@each("gap_s", [0.5, 1.1, 5.0, 10.5, 12.0, 61.5, 300.0])
@each("who", ["pause.a#{}", "pause.a^", "pause.a", "pause.a*"])
@each("event", ["reset", "first"])
def test_a_publisher_that_never_stops_does_not_drive_after_a_gap(
    gap_s: float, who: str, event: str
) -> None:
    """The network loses its commands, and its token after the lease; both come back together."""
    one, number = Commanders(), 5000
    if event == "reset":
        one.play("+pause; +pause.a")
        for _ in range(40):
            number += 1
            one.play(f"50 {who.format(number)} go")
        one.play("reset")
        if gap_s > 10:
            one.play(f"{min(gap_s, 60.9) * 1000} -pause")
        if gap_s > 61:
            one.play(f"{(gap_s - 60.9) * 1000} -pause.a")
        one.play("+pause; +pause.a")
    if event == "first" or gap_s <= 10:
        one.wait(1000 * gap_s)
        one.play("+pause; +pause.a" if event == "first" else "")
    number += round(20 * gap_s)
    for _ in range(200):
        number += 1
        one.play(f"50 {who.format(number)} go > -")


def test_the_second_begins_again_after_a_stall() -> None:
    for zero in ("high.a* zero", "high.a* zero@0 ! unproven"):
        one = Commanders().play(f"wake; {zero}; 900 wake")
        if "@" in zero:
            one.play("high.a* zero@0")
        sender = one.arbiter.sources["high"].senders["a"]
        assert not sender.is_armed(one.now_ns + 999 * MS)
        assert sender.is_armed(one.now_ns + 1000 * MS)


# a zero of a clock that is not proven yet


@each(("late_ms", "driver"), [(0, "high.a"), (240, "high.a"), (260, "-")])
def test_it_arms_unless_the_proof_shows_that_it_was_late(late_ms: int, driver: str) -> None:
    one = Commanders().play(f"high.a zero@{late_ms} ! unproven")
    for _ in range(8):
        one.wait(50).act("high.a", "go@0")
    assert one.act("high.a", "go@0") in ("", "not_newer")
    one.play(f"> {driver}")


def test_a_shared_one_waits_for_its_second_and_a_pause_arms_with_the_proof() -> None:
    one = Commanders()
    one.act("high.a*", "zero@0")
    for _ in range(40):
        one.wait(50).act("high.a*", "go@0")
    one.play("> -; 50 high.a* zero@0; 1000 high.a* go@0 > high.a")
    one = Commanders().play("+pause.a; 61000 pause.a#501 go@0 ! unproven > -")
    for number in range(502, 506):
        one.play(f"50 pause.a#{number} go@0 ! unproven > -")
    one.play("50 pause.a#506 go@0 > pause.a")


def test_what_a_network_held_back_does_not_arm() -> None:
    one = Commanders().prove_clock("high.a").play("50 reset; high.a go@0; 400")
    one.play("high.a go@350 ! stale; high.a go@300 ! stale; high.a go@250; high.a go@0 > -")
    one = Commanders().prove_clock("high.a").play("600 reset; 5 high.a go@500 ! stale")
    one.play("5 high.a go@400 ! stale; 5 high.a go@100 > -; 200 high.a go@0 > -")


def test_a_refused_zero_that_is_newer_ends_the_speed() -> None:
    one = Commanders(armed=True)
    assert one.accept(Command("high", GO, one.now_ns, sequence=1)) == ""
    one.arbiter.caught_up_ns = one.now_ns + 100 * MS
    for number, driver in ((1, "high"), (0, "high"), (2, "high zero")):
        stamp_ns = one.now_ns + one.offset_ns
        zero = Command("high", TWISTS["zero"], one.now_ns + 1, stamp_ns, sequence=number)
        assert one.accept(zero) == "unproven"
        one.play(f"> {driver}")
    one.play("reset; 500 high go@0 > -")


@each("proven", [True, False])
@each(("wait_ms", "number", "code"), [(2, 1, "not_newer"), (2, 3, ""), (260, 1, "")])
def test_a_speed_that_a_zero_of_another_clock_overtook_is_not_newer(
    wait_ms: float, number: int, code: str, proven: bool
) -> None:
    one = Commanders().prove_clock("high")

    def send(twist: str, clock: str, number: int | None = None) -> str:
        stamp_ns = one.now_ns + one.offset_ns
        twist_, at_ns = TWISTS[twist], one.now_ns
        return one.accept(Command("high", twist_, at_ns, stamp_ns, clock, sequence=number))

    for _ in range(20 if proven else 0):
        one.wait(50)
        send("zero", "other clock")
    one.wait(1)
    assert send("zero", "other clock", 2) == ("" if proven else "unproven")
    one.wait(wait_ms)
    assert send("go", "", number) == code

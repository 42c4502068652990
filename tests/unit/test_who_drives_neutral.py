"""The neutral-first rule: a zero arms a sender, and where a source says so a pause."""

from __future__ import annotations

import pytest

from acsard.core.values import Command, Wait
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
    "a pause of a second arms": "pause.a go > -; 1000 pause.a go > pause.a",
    "not a shorter one": "pause.a go; 999 pause.a go > - ? pause neutral",
    "a shared one too": "pause.a* go > -; 1000 pause.a* go > pause.a",
    "a pause of all that share": "pause.a* go" + "; 600 pause.b* go > -; 600 pause.a* go > -" * 9,
    "not at another source": "low.a go > -; 5000 low.a go > -",
}


@each(("name", "story"), [*SHARED.items(), *PAUSE.items()])
def test_shared_identities_and_pauses(name: str, story: str) -> None:
    one = Commanders()
    one.arbiter.watched_ns = one.now_ns
    one.play(story)


def test_a_pause_counts_after_the_event_and_while_the_daemon_watches() -> None:
    one = Commanders().play("5000 reset; 900 pause go > -")
    assert one.choice().wait == Wait("neutral", "pause", 1.0, pause=True)
    one.arbiter.watched_ns = one.wait(600).now_ns
    one.play("600 pause go > -; 1000 pause go > pause")
    # Not in the first five seconds of the daemon, in which lost clients come back.
    one = Commanders().play("wake; 4000 pause go > -; 1999 pause go > -; 1000 pause go > pause")


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
    one = Commanders().play("pause.a go@0 ! unproven > -" + "; 50 pause.a go@0 ! unproven > -" * 4)
    one.play("50 pause.a go@0 > pause.a")


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

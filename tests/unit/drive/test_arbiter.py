"""Who drives: priority, timeouts, neutral first, and the age of stamped commands."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsard.config.settings import CommandsConfig, Source
from acsard.drive.arbiter import Arbiter, Choice, Freshness
from acsard.values import NS_PER_S, REST, Command, SourceStatus, Twist

MS = 1_000_000
HOUR_NS = 3600 * NS_PER_S
GO = Twist(0.5, 0.2)
BACK = Twist(-0.3, 0.0)

HIGH = Source("high", 100)
SLOW = Source("slow", 100, timeout=1.0)
LEFT = Source("left", 50)
RIGHT = Source("right", 50)
LOW = Source("low", 10)


class Bench:
    """An arbiter and its time; `offset_ns` is how far the senders' clocks are ahead."""

    def __init__(self, *sources: Source, neutral_first: bool = True, armed: bool = True) -> None:
        self.arbiter = Arbiter(CommandsConfig(neutral_first, sources))
        self.arbiter.require_neutral()
        self.now_ns = 10 * NS_PER_S
        self.offset_ns = 1_800_000_000 * NS_PER_S
        if armed:
            for source in sources:
                self.send(source, REST)
            self.wait(5000)

    def wait(self, ms: float) -> Bench:
        self.now_ns += int(ms * MS)
        return self

    def send(self, source: Source | str, twist: Twist = GO, voice: str = "") -> str:
        name = source if isinstance(source, str) else source.name
        return self.arbiter.accept(Command(name, twist, self.now_ns, voice=voice))

    def stamped(
        self,
        source: Source,
        late_ms: float = 0.0,
        sender: str = "",
        twist: Twist = GO,
        voice: str = "",
    ) -> str:
        """Send a command that was stamped `late_ms` ago by the sender's clock."""
        stamp_ns = self.now_ns + self.offset_ns - int(late_ms * MS)
        return self.arbiter.accept(
            Command(source.name, twist, self.now_ns, stamp_ns, sender, voice)
        )

    def unreadable(self, source: Source, voice: str = "") -> None:
        """Something that could not be decoded came from there."""
        self.arbiter.notice(source.name, voice, self.now_ns)

    def choice(self) -> Choice:
        return self.arbiter.choose(self.now_ns)

    def driver(self) -> str:
        """Whose command is followed now, "" if nobody's."""
        choice = self.choice()
        return "" if choice.twist is None else choice.source

    def status(self, source: Source) -> SourceStatus:
        (status,) = (s for s in self.arbiter.sources(self.now_ns) if s.name == source.name)
        return status


# one source


def test_nobody_drives_when_nobody_commands() -> None:
    choice = Bench(HIGH, LOW).choice()
    assert (choice.source, choice.twist, choice.arrived_ns) == ("", None, None)
    assert choice.reason.startswith("no commands")


def test_without_sources_nobody_drives() -> None:
    assert Bench().driver() == ""


def test_a_command_is_followed_and_the_reason_names_its_source() -> None:
    bench = Bench(HIGH)
    assert bench.send(HIGH) == ""
    assert bench.choice() == Choice("high", GO, "commanded by high", bench.now_ns)


def test_the_newest_command_counts() -> None:
    bench = Bench(HIGH)
    bench.send(HIGH, GO)
    bench.send(HIGH, BACK)
    assert bench.choice().twist == BACK


def test_a_zero_is_a_command_too() -> None:
    bench = Bench(HIGH)
    bench.send(HIGH, REST)
    assert bench.choice().twist == REST
    assert bench.driver() == "high"


@pytest.mark.parametrize("source", [HIGH, SLOW, Source("quick", 1, timeout=0.02)])
def test_a_command_counts_until_the_timeout_of_its_source(source: Source) -> None:
    bench = Bench(source)
    bench.send(source)
    bench.wait(source.timeout * 1000)
    assert bench.driver() == source.name
    bench.wait(0.000001)
    assert bench.driver() == ""


def test_each_command_begins_the_timeout_again() -> None:
    bench = Bench(HIGH)
    for _ in range(10):
        bench.send(HIGH)
        assert bench.wait(240).driver() == "high"


# refusals


@pytest.mark.parametrize(
    "twist",
    [
        Twist(math.nan, 0.0),
        Twist(0.0, math.nan),
        Twist(math.inf, 0.0),
        Twist(0.0, -math.inf),
    ],
)
def test_what_is_not_finite_is_refused(twist: Twist) -> None:
    bench = Bench(HIGH)
    assert bench.send(HIGH, twist) == "not_finite"
    assert bench.driver() == ""


def test_an_unknown_source_is_refused_and_never_listed() -> None:
    bench = Bench(HIGH)
    assert bench.send("stranger") == "unknown_source"
    assert bench.driver() == ""
    assert [s.name for s in bench.arbiter.sources(bench.now_ns)] == ["high"]


def test_a_huge_command_is_accepted_for_the_limits_to_clamp() -> None:
    bench = Bench(HIGH)
    assert bench.send(HIGH, Twist(1e308, -1e308)) == ""


def test_a_refused_command_refreshes_no_timeout() -> None:
    bench = Bench(HIGH)
    bench.send(HIGH)
    bench.wait(200)
    assert bench.send(HIGH, Twist(math.nan, 0.0)) == "not_finite"
    assert bench.wait(60).driver() == ""


def test_a_refused_command_changes_no_twist() -> None:
    bench = Bench(HIGH)
    bench.send(HIGH)
    bench.send(HIGH, Twist(math.nan, 0.0))
    assert bench.choice().twist == GO


# several sources


def test_the_higher_priority_drives_whatever_the_order_of_arrival() -> None:
    for first, second in ((HIGH, LOW), (LOW, HIGH)):
        bench = Bench(LOW, HIGH)
        bench.send(first)
        bench.send(second)
        assert bench.driver() == "high"


def test_the_higher_priority_takes_over_at_once() -> None:
    bench = Bench(HIGH, LOW)
    bench.send(LOW)
    assert bench.driver() == "low"
    bench.send(HIGH, BACK)
    assert bench.choice().twist == BACK


def test_when_the_higher_priority_falls_silent_the_lower_takes_over_with_its_own_command() -> None:
    bench = Bench(HIGH, LOW)
    bench.send(HIGH, GO)
    bench.wait(200).send(LOW, BACK)
    assert bench.driver() == "high"
    assert bench.wait(51).choice().twist == BACK


def test_when_the_higher_priority_falls_silent_an_old_lower_command_stays_dead() -> None:
    bench = Bench(SLOW, LOW)
    bench.send(SLOW)
    bench.send(LOW)
    bench.wait(1000)
    assert bench.driver() == "slow"
    assert bench.wait(1).driver() == ""


def test_the_order_of_configuration_does_not_matter() -> None:
    for sources in ((HIGH, LEFT, LOW), (LOW, LEFT, HIGH), (LEFT, HIGH, LOW)):
        bench = Bench(*sources)
        for source in sources:
            bench.send(source)
        assert bench.driver() == "high"


@pytest.mark.parametrize("sources", [(LEFT, RIGHT), (RIGHT, LEFT)])
def test_among_equals_the_first_to_come_keeps_the_robot(sources: tuple[Source, ...]) -> None:
    bench = Bench(*sources)
    for _ in range(50):
        bench.send(LEFT)
        assert bench.driver() == "left"
        bench.wait(20).send(RIGHT)
        assert bench.driver() == "left"


@pytest.mark.parametrize("sources", [(LEFT, RIGHT), (RIGHT, LEFT)])
def test_among_equals_the_second_takes_over_when_the_first_is_silent_and_keeps_it(
    sources: tuple[Source, ...],
) -> None:
    bench = Bench(*sources)
    bench.send(LEFT)
    assert bench.driver() == "left"
    bench.wait(200).send(RIGHT)
    assert bench.wait(51).driver() == "right"
    bench.send(LEFT)
    assert bench.driver() == "right"


@pytest.mark.parametrize("sources", [(LEFT, RIGHT, HIGH), (RIGHT, LEFT, HIGH)])
def test_among_equals_the_first_to_come_has_the_robot_back_after_a_higher_one(
    sources: tuple[Source, ...],
) -> None:
    bench = Bench(*sources)
    bench.send(RIGHT)
    assert bench.driver() == "right"
    bench.wait(10).send(LEFT)
    bench.send(RIGHT)
    bench.send(HIGH)
    assert bench.driver() == "high"
    for _ in range(3):
        bench.wait(100).send(LEFT)
        bench.send(RIGHT)
    assert bench.driver() == "right"


def test_among_equals_the_first_to_come_is_the_first_to_arrive() -> None:
    bench = Bench(LEFT, RIGHT)
    bench.send(RIGHT)
    bench.wait(1).send(LEFT)
    assert bench.driver() == "right"


def test_a_lower_priority_never_keeps_the_robot_from_a_higher() -> None:
    bench = Bench(LEFT, HIGH, RIGHT)
    bench.send(LEFT)
    assert bench.driver() == "left"
    bench.send(RIGHT)
    bench.send(HIGH)
    assert bench.driver() == "high"


# neutral first


def test_a_source_that_was_never_neutral_does_not_drive() -> None:
    bench = Bench(HIGH, armed=False)
    for _ in range(100):
        assert bench.send(HIGH) == ""
        assert bench.driver() == ""
        bench.wait(50)


def test_a_new_arbiter_asks_for_neutral_unasked() -> None:
    arbiter = Arbiter(CommandsConfig(True, (HIGH,)))
    assert arbiter.accept(Command("high", GO, 0)) == ""
    assert arbiter.choose(0).twist is None


def test_a_zero_is_neutral() -> None:
    bench = Bench(HIGH, armed=False)
    bench.send(HIGH, GO)
    bench.send(HIGH, REST)
    assert bench.choice().twist == REST
    bench.send(HIGH, GO)
    assert bench.choice().twist == GO


def test_a_negative_zero_is_neutral() -> None:
    bench = Bench(HIGH, armed=False)
    bench.send(HIGH, Twist(-0.0, -0.0))
    bench.send(HIGH, GO)
    assert bench.driver() == "high"


@pytest.mark.parametrize("twist", [Twist(0.0, 1e-9), Twist(1e-9, 0.0)])
def test_hardly_moving_is_not_neutral(twist: Twist) -> None:
    bench = Bench(HIGH, armed=False)
    bench.send(HIGH, twist)
    bench.send(HIGH, GO)
    assert bench.driver() == ""


@pytest.mark.parametrize("source", [HIGH, SLOW])
def test_a_source_that_was_heard_and_then_silent_for_its_own_timeout_is_neutral(
    source: Source,
) -> None:
    bench = Bench(source, armed=False)
    bench.send(source)
    bench.wait(source.timeout * 1000).send(source)
    assert bench.driver() == ""
    bench.wait(source.timeout * 1000 + 0.000001).send(source)
    assert bench.driver() == source.name


def test_silence_from_the_start_is_not_neutral() -> None:
    bench = Bench(HIGH, armed=False)
    bench.wait(60_000).send(HIGH)
    assert bench.driver() == ""


def test_a_refused_zero_is_not_neutral() -> None:
    bench = Bench(HIGH, armed=False)
    bench.send(HIGH, Twist(0.0, math.nan))
    bench.stamped(HIGH)
    stamp_ns = bench.now_ns + bench.offset_ns - HOUR_NS
    zero = Command("high", REST, bench.now_ns, stamp_ns)
    assert bench.arbiter.accept(zero) == "stale"
    bench.send(HIGH)
    assert bench.driver() == ""


def test_a_refused_command_is_not_heard_so_its_silence_is_not_neutral() -> None:
    bench = Bench(HIGH, armed=False)
    bench.send(HIGH, Twist(math.nan, 0.0))
    bench.wait(1000).send(HIGH)
    assert bench.driver() == ""


def test_a_source_that_was_neutral_stays_so_through_its_own_silence() -> None:
    bench = Bench(HIGH)
    bench.send(HIGH)
    bench.wait(60_000).send(HIGH)
    assert bench.driver() == "high"


def test_the_neutral_of_one_source_is_not_that_of_another() -> None:
    bench = Bench(HIGH, LOW, armed=False)
    bench.send(LOW, REST)
    bench.send(HIGH)
    assert bench.driver() == ""


def test_requiring_neutral_forgets_every_command() -> None:
    bench = Bench(HIGH, LOW)
    bench.send(LOW)
    bench.arbiter.require_neutral()
    assert bench.driver() == ""
    assert bench.status(LOW).age_s is None


def test_requiring_neutral_forgets_what_was_neutral() -> None:
    bench = Bench(HIGH)
    bench.arbiter.require_neutral()
    bench.send(HIGH)
    assert bench.driver() == ""


def test_requiring_neutral_forgets_what_was_heard() -> None:
    bench = Bench(HIGH, armed=False)
    bench.send(HIGH)
    bench.arbiter.require_neutral()
    bench.wait(1000).send(HIGH)
    assert bench.driver() == ""


def test_requiring_neutral_forgets_who_came_first() -> None:
    bench = Bench(LEFT, RIGHT)
    bench.send(RIGHT)
    assert bench.driver() == "right"
    bench.arbiter.require_neutral()
    bench.wait(10).send(LEFT, REST)
    assert bench.driver() == "left"
    bench.wait(10).send(RIGHT, REST)
    assert bench.driver() == "left"


def test_a_waiting_source_holds_its_place_with_zero() -> None:
    bench = Bench(HIGH, LOW, armed=False)
    bench.send(LOW, REST)
    bench.send(LOW, GO)
    assert bench.driver() == "low"
    bench.send(HIGH, GO)
    choice = bench.choice()
    assert (choice.source, choice.twist, choice.arrived_ns) == ("high", None, None)
    assert choice.reason.startswith("neutral first: high must send a zero, or pause for 0.25 s")


def test_without_neutral_first_the_first_command_drives() -> None:
    bench = Bench(HIGH, neutral_first=False, armed=False)
    bench.send(HIGH)
    assert bench.driver() == "high"
    bench.arbiter.require_neutral()
    assert bench.driver() == ""
    bench.send(HIGH)
    assert bench.driver() == "high"


# the senders of one source


def test_the_zero_of_one_sender_arms_no_other_of_its_source() -> None:
    bench = Bench(HIGH, armed=False)
    for step in range(40):
        bench.send(HIGH, GO, "a")
        if step == 10:
            bench.send(HIGH, REST, "b")
        assert bench.choice().twist in (None, REST)
        bench.wait(50)


def test_the_sender_that_was_neutral_drives_while_another_of_its_source_was_not() -> None:
    bench = Bench(HIGH, armed=False)
    bench.send(HIGH, GO, "a")
    assert bench.driver() == ""
    bench.wait(50).send(HIGH, REST, "b")
    for _ in range(10):
        bench.wait(50).send(HIGH, GO, "a")
        bench.send(HIGH, BACK, "b")
        assert bench.choice().twist == BACK


def test_of_two_senders_of_a_source_the_first_is_followed_alone_and_the_other_is_told() -> None:
    bench = Bench(HIGH, armed=False)
    for voice in ("a", "b"):
        bench.send(HIGH, REST, voice)
        bench.wait(20)
    for _ in range(50):
        bench.send(HIGH, GO, "a")
        assert bench.choice().twist == GO
        bench.wait(20).send(HIGH, BACK, "b")
        assert bench.choice().twist == GO
        assert bench.status(HIGH).waits_for == (
            "1 more of its senders: the first until it is silent"
        )
        bench.wait(20)


def test_the_second_sender_of_a_source_has_it_once_the_first_is_silent_and_keeps_it() -> None:
    bench = Bench(HIGH, armed=False)
    for voice in ("a", "b"):
        bench.send(HIGH, REST, voice)
        bench.wait(20)
    bench.send(HIGH, GO, "a")
    bench.wait(200).send(HIGH, BACK, "b")
    assert bench.wait(50).choice().twist == GO
    assert bench.wait(1).choice().twist == BACK
    assert bench.status(HIGH).waits_for == ""
    bench.send(HIGH, GO, "a")
    assert bench.choice().twist == BACK


def test_a_zero_of_the_second_sender_brakes_nobody_who_came_first() -> None:
    bench = Bench(HIGH, armed=False)
    bench.send(HIGH, REST, "a")
    bench.wait(20).send(HIGH, GO, "a")
    bench.wait(20).send(HIGH, REST, "b")
    assert bench.choice().twist == GO


def test_a_sender_that_was_never_neutral_holds_its_source_s_place_with_zero() -> None:
    bench = Bench(HIGH, LOW, armed=False)
    bench.send(LOW, REST)
    bench.send(LOW)
    bench.send(HIGH, GO, "a")
    choice = bench.choice()
    assert (choice.source, choice.twist) == ("high", None)
    assert "neutral first" in bench.status(HIGH).waits_for


@pytest.mark.parametrize("sources", [(LEFT, RIGHT), (RIGHT, LEFT)])
def test_among_equal_sources_the_sender_who_came_first_counts(sources: tuple[Source, ...]) -> None:
    bench = Bench(*sources)
    bench.send(RIGHT, REST, "r")
    bench.wait(10).send(LEFT, REST, "l")
    bench.send(RIGHT, GO, "r")
    bench.send(LEFT, BACK, "l")
    assert bench.choice().twist == GO


def test_each_sender_must_be_neutral_again_once_that_is_required() -> None:
    bench = Bench(HIGH, armed=False)
    for voice in ("a", "b"):
        bench.send(HIGH, REST, voice)
    bench.arbiter.require_neutral(bench.now_ns)
    for voice in ("a", "b"):
        bench.wait(50).send(HIGH, GO, voice)
        assert bench.driver() == ""


@pytest.mark.parametrize("before", [REST, GO])
def test_what_arrived_before_neutral_was_asked_for_makes_no_sender_neutral_nor_heard(
    before: Twist,
) -> None:
    bench = Bench(HIGH, armed=False)
    bench.arbiter.require_neutral(bench.now_ns + 100 * MS)
    bench.send(HIGH, before, "a")
    bench.wait(300).send(HIGH, GO, "a")
    assert bench.driver() == ""


def test_the_pause_of_one_sender_is_not_cut_short_by_another_nor_made_up_by_it() -> None:
    bench = Bench(HIGH, armed=False)
    bench.send(HIGH, GO, "a")
    for _ in range(6):
        bench.wait(50).send(HIGH, BACK, "b")
    bench.send(HIGH, GO, "a")
    assert bench.choice().twist == GO


def test_without_neutral_first_the_first_sender_to_come_is_followed() -> None:
    bench = Bench(HIGH, neutral_first=False, armed=False)
    bench.send(HIGH, GO, "a")
    bench.wait(20).send(HIGH, BACK, "b")
    assert bench.choice().twist == GO


def test_a_source_s_age_is_that_of_the_last_command_of_any_sender() -> None:
    bench = Bench(HIGH, armed=False)
    for voice in ("a", "b", "a", "b"):
        bench.wait(50).send(HIGH, REST, voice)
    assert bench.wait(20).status(HIGH).age_s == 0.02
    bench.send(HIGH, REST, "a")
    assert bench.wait(10).status(HIGH).age_s == 0.01


# what is no silence


def test_what_a_network_held_back_and_then_lets_in_arms_nobody() -> None:
    bench = Bench(HIGH, armed=False)
    bench.stamped(HIGH)
    bench.wait(50).arbiter.require_neutral(bench.now_ns)
    assert bench.stamped(HIGH) == ""
    bench.wait(400)
    answers = [bench.stamped(HIGH, late_ms=late) for late in (350, 300, 250, 200, 100, 0)]
    assert answers == ["stale", "stale", "", "", "", ""]
    assert bench.driver() == ""


def test_what_pours_in_soon_after_a_clear_arms_nobody_however_late_each_came() -> None:
    bench = Bench(HIGH, armed=False)
    bench.stamped(HIGH)
    bench.wait(600).arbiter.require_neutral(bench.now_ns)
    assert [bench.wait(5).stamped(HIGH, late_ms=late) for late in (500, 400, 100)] == [
        "stale",
        "stale",
        "",
    ]
    assert bench.driver() == ""
    assert bench.wait(200).stamped(HIGH) == ""
    assert bench.driver() == ""


def test_a_gap_between_arrivals_that_is_none_between_stamps_is_no_pause() -> None:
    bench = Bench(HIGH, armed=False)
    bench.stamped(HIGH)
    bench.wait(260).stamped(HIGH, late_ms=210)
    assert bench.driver() == ""
    bench.wait(260).stamped(HIGH, late_ms=240)
    assert bench.driver() == ""


def test_a_pause_that_shows_in_the_stamps_too_is_neutral() -> None:
    bench = Bench(HIGH, armed=False)
    bench.stamped(HIGH)
    bench.wait(251).stamped(HIGH, late_ms=1.001)
    assert bench.driver() == ""
    bench.wait(300).stamped(HIGH)
    assert bench.driver() == "high"


def test_a_pause_before_a_command_without_a_stamp_is_neutral() -> None:
    bench = Bench(HIGH, armed=False)
    bench.stamped(HIGH)
    bench.wait(251).send(HIGH)
    assert bench.driver() == "high"


@pytest.mark.parametrize("step_ms", [10, 50, 249])
def test_one_who_sends_nonsense_is_not_silent(step_ms: int) -> None:
    bench = Bench(HIGH, armed=False)
    bench.send(HIGH)
    for _ in range(1 + 300 // step_ms):
        assert bench.wait(step_ms).send(HIGH, Twist(math.nan, 0.0)) == "not_finite"
    bench.wait(step_ms).send(HIGH)
    assert bench.driver() == ""


@pytest.mark.parametrize("step_ms", [10, 50, 249])
def test_one_who_sends_what_cannot_be_read_is_not_silent(step_ms: int) -> None:
    bench = Bench(HIGH, armed=False)
    bench.send(HIGH, GO, "a")
    for _ in range(1 + 300 // step_ms):
        bench.wait(step_ms).unreadable(HIGH, "a")
    bench.wait(step_ms).send(HIGH, GO, "a")
    assert bench.driver() == ""


def test_after_nonsense_a_whole_pause_is_neutral() -> None:
    bench = Bench(HIGH, armed=False)
    bench.send(HIGH, GO, "a")
    bench.wait(200).unreadable(HIGH, "a")
    bench.wait(251).send(HIGH, GO, "a")
    assert bench.driver() == "high"


@pytest.mark.parametrize("source", [Source("stranger", 1), HIGH])
def test_what_cannot_be_read_is_nothing_of_one_who_was_never_heard(source: Source) -> None:
    bench = Bench(HIGH, armed=False)
    bench.unreadable(source, "a")
    bench.wait(1000).send(HIGH, GO, "a")
    assert bench.driver() == ""
    assert bench.status(HIGH).waits_for.startswith("neutral first")


def test_what_cannot_be_read_is_no_silence_of_its_own_sender_only() -> None:
    bench = Bench(HIGH, armed=False)
    bench.send(HIGH, GO, "a")
    bench.wait(200).unreadable(HIGH, "b")
    bench.wait(51).send(HIGH, GO, "a")
    assert bench.driver() == "high"


def test_a_refused_command_is_no_sign_of_one_who_may_drive() -> None:
    bench = Bench(HIGH, LOW)
    bench.send(LOW)
    assert bench.send(HIGH, Twist(math.nan, 0.0), "a") == "not_finite"
    bench.unreadable(HIGH, "a")
    assert bench.driver() == "low"


def test_a_twist_that_is_zero_because_opposites_cancel_is_not_neutral() -> None:
    bench = Bench(HIGH, armed=False)
    cancelled = Command("high", REST, bench.now_ns, cancelled=True)
    assert bench.arbiter.accept(cancelled) == ""
    assert bench.driver() == ""
    bench.send(HIGH, GO)
    assert bench.driver() == ""


def test_a_twist_that_cancels_out_is_followed_of_one_who_may_drive() -> None:
    bench = Bench(HIGH)
    assert bench.arbiter.accept(Command("high", REST, bench.now_ns, cancelled=True)) == ""
    assert bench.choice().twist == REST


# how many senders are remembered


def armed_in_turn(bench: Bench, voices: list[str]) -> None:
    for voice in voices:
        bench.wait(10).send(HIGH, REST, voice)


def drives(bench: Bench, voice: str) -> bool:
    """Whether it may, asked when all others are silent; it is then silent itself."""
    bench.wait(300).send(HIGH, GO, voice)
    allowed = bench.driver() == "high"
    bench.wait(300)
    return allowed


def test_sixteen_senders_of_a_source_may_drive_in_turn() -> None:
    bench = Bench(HIGH, armed=False)
    voices = [f"voice {number}" for number in range(16)]
    armed_in_turn(bench, voices)
    assert all(drives(bench, voice) for voice in voices)


def test_a_seventeenth_sender_takes_the_place_of_the_one_silent_for_longest() -> None:
    bench = Bench(HIGH, armed=False)
    voices = [f"voice {number}" for number in range(16)]
    armed_in_turn(bench, voices)
    bench.wait(300).send(HIGH, GO, voices[0])  # now number 1 is the one noticed longest ago
    assert bench.wait(300).send(HIGH, REST, "one more") == ""
    # Asked last: who is new again takes a place too.
    asked = ("one more", voices[0], voices[2], voices[1])
    assert [drives(bench, voice) for voice in asked] == [True, True, True, False]


def test_sixteen_live_senders_let_in_no_other_and_keep_the_one_that_came_first() -> None:
    bench = Bench(HIGH, armed=False)
    bench.send(HIGH, REST, "holder")
    bench.wait(20).send(HIGH, GO, "holder")
    answers = [bench.wait(1).send(HIGH, REST, f"stranger {number}") for number in range(16)]
    assert answers == [""] * 15 + ["crowded"]
    assert bench.choice().twist == GO
    assert bench.wait(14).send(HIGH, GO, "holder") == ""
    assert bench.choice().twist == GO


def test_a_refused_sample_of_a_new_sender_makes_nobody_forgotten() -> None:
    bench = Bench(HIGH, armed=False)
    voices = [f"voice {number}" for number in range(16)]
    armed_in_turn(bench, voices)
    bench.wait(300)
    assert bench.send(HIGH, Twist(math.nan, 0.0), "one more") == "not_finite"
    assert all(drives(bench, voice) for voice in voices)


def test_of_more_than_sixteen_senders_those_that_may_not_drive_are_forgotten_first() -> None:
    bench = Bench(HIGH, armed=False)
    voices = [f"voice {number}" for number in range(15)]
    armed_in_turn(bench, voices)
    for number in range(100):
        bench.wait(1).send(HIGH, BACK, f"stranger {number}")
    assert all(drives(bench, voice) for voice in voices)


def test_a_crowd_that_sends_zeros_takes_the_robot_from_nobody_who_is_heard_as_often() -> None:
    bench = Bench(HIGH, armed=False)
    bench.send(HIGH, REST, "a")
    for number in range(200):
        if number % 8 == 0:
            bench.send(HIGH, GO, "a")
        bench.wait(1).send(HIGH, REST, f"stranger {number}")
        assert bench.choice().twist == GO
    assert bench.status(HIGH).waits_for.startswith("15 more of its senders")


def test_a_crowd_that_sends_what_cannot_be_read_makes_nobody_forgotten() -> None:
    bench = Bench(HIGH, armed=False)
    bench.send(HIGH, GO, "a")
    for number in range(100):
        bench.wait(1).unreadable(HIGH, f"stranger {number}")
    bench.wait(251).send(HIGH, GO, "a")
    assert bench.driver() == "high"


def test_the_crowd_of_one_source_is_none_of_another() -> None:
    bench = Bench(HIGH, LOW, armed=False)
    bench.send(LOW, REST, "a")
    for number in range(100):
        bench.send(HIGH, REST, f"stranger {number}")
    bench.wait(300).send(LOW, GO, "a")
    assert bench.driver() == "low"


# the law of it

TWISTS = {"a": Twist(0.1, 0.0), "b": Twist(0.2, 0.0)}
"""What tells in these whose twist is followed."""

KINDS = ("go", "zero", "cancelled", "nan", "unreadable", "stamped", "neutral")


class Told:
    """What a sender has done since neutral was last required, as the law says it."""

    def __init__(self) -> None:
        self.zero = self.paused = False
        self.counted: int | None = None
        """The stamp of the last command that counted, or 0 when it had none."""
        self.sign_ns = 0

    def sent(self, at_ns: int, stamp_ns: int, refused: bool, zero: bool) -> None:
        silent = at_ns - self.sign_ns > 250 * MS
        self.sign_ns = at_ns
        if refused:
            return
        if self.counted is not None and silent:
            held = stamp_ns and self.counted and stamp_ns - self.counted <= 250 * MS
            self.paused |= not held
        self.zero |= zero
        self.counted = stamp_ns


@given(
    st.lists(
        st.tuples(
            st.sampled_from([0, 20, 100, 249, 251, 300, 600]),
            st.sampled_from("ab"),
            st.sampled_from(KINDS),
            st.sampled_from([0, 60, 200, 249, 260, 400]),
        ),
        max_size=30,
    )
)
def test_no_twist_is_followed_of_a_sender_that_was_neither_neutral_nor_silent(
    story: list[tuple[int, str, str, int]],
) -> None:
    bench = Bench(HIGH, armed=False)
    told = {"a": Told(), "b": Told()}
    for wait_ms, voice, kind, late_ms in story:
        now_ns, refused, stamp_ns = bench.wait(wait_ms).now_ns, "", 0
        twist = TWISTS[voice]
        if kind == "neutral":
            bench.arbiter.require_neutral(now_ns)
            for name, one in told.items():
                told[name] = Told()
                told[name].sign_ns = one.sign_ns
            assert bench.driver() == ""
            continue
        if kind == "unreadable":
            bench.unreadable(HIGH, voice)
            refused = kind
        elif kind == "stamped":
            stamp_ns = now_ns + bench.offset_ns - late_ms * MS
            refused = bench.stamped(HIGH, late_ms, sender=voice, twist=twist, voice=voice)
        elif kind == "cancelled":
            bench.arbiter.accept(Command("high", REST, now_ns, voice=voice, cancelled=True))
        else:
            given_twist = {"go": twist, "zero": REST, "nan": Twist(math.nan, 0.0)}[kind]
            refused = bench.send(HIGH, given_twist, voice)
        told[voice].sent(now_ns, stamp_ns, bool(refused), kind == "zero")
        followed = bench.choice().twist
        if followed == REST:
            assert told["a"].zero or told["a"].paused or told["b"].zero or told["b"].paused
        for name, mark in TWISTS.items():
            if followed == mark:
                assert told[name].zero or told[name].paused, name


# the age of stamped commands


def test_a_prompt_stamp_is_accepted_whatever_the_clocks_say() -> None:
    for offset_ns in (0, HOUR_NS, -HOUR_NS, -1_800_000_000 * NS_PER_S, 1 << 62):
        bench = Bench(HIGH)
        bench.offset_ns = offset_ns
        for _ in range(10):
            assert bench.stamped(HIGH) == ""
            bench.wait(50)
        assert bench.driver() == "high"


def test_a_command_later_than_the_promptest_by_more_than_the_timeout_is_stale() -> None:
    bench = Bench(HIGH)
    assert bench.stamped(HIGH) == ""
    assert bench.stamped(HIGH, late_ms=250) == ""
    assert bench.stamped(HIGH, late_ms=250.000001) == "stale"


@pytest.mark.parametrize("source", [SLOW, Source("quick", 1, timeout=0.02)])
def test_how_late_is_stale_depends_on_the_source(source: Source) -> None:
    bench = Bench(source)
    bench.stamped(source)
    assert bench.stamped(source, late_ms=source.timeout * 1000) == ""
    assert bench.stamped(source, late_ms=source.timeout * 1000 + 1) == "stale"


def test_a_stale_command_refreshes_nothing() -> None:
    bench = Bench(HIGH)
    bench.stamped(HIGH)
    for _ in range(5):
        bench.wait(51)
        assert bench.stamped(HIGH, late_ms=5000) == "stale"
    assert bench.driver() == ""


def test_a_backlog_is_not_obeyed_and_what_is_fresh_again_is() -> None:
    bench = Bench(HIGH)
    bench.stamped(HIGH)
    bench.wait(3000)
    ages = [float(age) for age in range(3000, -1, -50)]
    answers = [bench.stamped(HIGH, late_ms=age) for age in ages]
    # the sender has been silent for 3 s: its minimum may have risen by 3 s x 2e-4 = 0.6 ms
    assert answers == ["stale" if age > 250.6 else "" for age in ages]


def test_a_promptest_command_makes_the_later_ones_late() -> None:
    bench = Bench(HIGH)
    assert bench.stamped(HIGH, late_ms=400) == ""
    assert bench.stamped(HIGH, late_ms=0) == ""
    assert bench.stamped(HIGH, late_ms=400) == "stale"


def test_each_sender_has_its_own_clock() -> None:
    bench = Bench(HIGH, LOW)
    bench.stamped(HIGH, sender="alice")
    bench.offset_ns -= HOUR_NS
    assert bench.stamped(HIGH, sender="bob") == ""
    assert bench.stamped(HIGH, sender="alice") == "stale"


def test_a_sender_is_known_by_its_source_when_it_has_no_name() -> None:
    bench = Bench(HIGH, LOW)
    bench.stamped(HIGH)
    bench.offset_ns -= HOUR_NS
    assert bench.stamped(LOW) == ""
    assert bench.stamped(HIGH) == "stale"


def test_one_sender_has_one_clock_on_all_its_sources() -> None:
    bench = Bench(HIGH, LOW)
    bench.stamped(HIGH, sender="alice")
    assert bench.stamped(LOW, late_ms=300, sender="alice") == "stale"


def test_a_command_without_a_stamp_is_as_old_as_its_arrival() -> None:
    bench = Bench(HIGH)
    bench.stamped(HIGH)
    assert bench.wait(5000).send(HIGH) == ""


@pytest.mark.parametrize("offset_s", [1_800_000_000, -1_800_000_000])
def test_a_sender_that_was_silent_for_long_may_have_set_its_clock(offset_s: int) -> None:
    bench = Bench(HIGH)
    bench.offset_ns = offset_s * NS_PER_S
    bench.stamped(HIGH)
    bench.offset_ns -= HOUR_NS
    bench.wait(10_000)
    assert bench.stamped(HIGH) == "stale"
    bench.wait(10_001)
    refused = [bench.wait(100).stamped(HIGH) for _ in range(25)]
    assert refused == ["stale"] * 20 + [""] * 5  # steady delays prove it in 2 s


def test_a_sender_that_was_silent_for_just_ten_seconds_may_not() -> None:
    bench = Bench(HIGH)
    bench.stamped(HIGH)
    bench.offset_ns -= HOUR_NS
    bench.wait(9_900)
    assert {bench.wait(100).stamped(HIGH) for _ in range(50)} == {"stale"}


def test_what_a_network_held_for_longer_than_that_is_not_taken_for_a_clock_that_was_set() -> None:
    bench = Bench(HIGH)
    bench.stamped(HIGH)
    bench.offset_ns -= 15 * NS_PER_S
    bench.wait(15_000)
    for _ in range(200):  # a backlog that catches up by a tenth of the time it takes
        assert bench.wait(50).stamped(HIGH) == "stale"
        bench.offset_ns += 5 * MS


@pytest.mark.parametrize("drift", [1e-4, -1e-4])
def test_an_hour_with_a_drifting_clock_loses_no_command(drift: float) -> None:
    # 1e-4 x 3600 s = 360 ms: more than the timeout, if nothing followed it
    bench = Bench(HIGH)
    for _ in range(3600 * 5):
        bench.offset_ns -= int(drift * 200 * MS)
        assert bench.wait(200).stamped(HIGH) == ""


def test_a_delay_that_creeps_up_is_noticed_all_the_same() -> None:
    # 1 ms more with each command; in the 50 ms between two the minimum may rise 0.01 ms: late by
    # 0.99 k ms, which is over 250 ms from k = 253
    bench = Bench(HIGH)
    answers = [bench.wait(50).stamped(HIGH, late_ms=late) for late in range(300)]
    assert answers == [""] * 253 + ["stale"] * 47


def test_the_extra_delay_is_measured_from_the_promptest_command() -> None:
    freshness = Freshness()
    assert freshness.extra_delay_ns("a", 1000, 5000) == 0.0  # the first: delay 4000
    assert freshness.extra_delay_ns("a", 1000, 5500) == pytest.approx(500, abs=1)
    assert freshness.extra_delay_ns("a", 3000, 6000) == 0.0  # prompter: delay 3000
    assert freshness.extra_delay_ns("a", 3000, 7000) == pytest.approx(1000, abs=1)


def test_the_minimum_rises_with_time_by_the_drift_allowed() -> None:
    freshness = Freshness()
    freshness.extra_delay_ns("a", 0, 0)
    silence = 10 * NS_PER_S
    late = freshness.extra_delay_ns("a", 0, silence)
    assert late == pytest.approx(silence - 2e-4 * silence)


def test_only_so_many_clocks_are_remembered_and_the_longest_unheard_goes_first() -> None:
    freshness = Freshness()
    for number in range(1024):
        freshness.extra_delay_ns(f"sender {number}", 0, 0)
    freshness.extra_delay_ns("sender 0", 0, 0)  # heard again: now number 1 is the oldest
    freshness.extra_delay_ns("one more", 0, 0)
    assert freshness.extra_delay_ns("sender 0", 0, 1000) > 0.0
    assert freshness.extra_delay_ns("sender 2", 0, 1000) > 0.0
    assert freshness.extra_delay_ns("sender 1", 0, 1000) == 0.0


@given(
    jitter=st.lists(st.floats(0.0, 249.0), min_size=1, max_size=50),
    offset_s=st.floats(-1e9, 1e9),
)
def test_no_command_within_the_timeout_is_ever_stale(jitter: list[float], offset_s: float) -> None:
    bench = Bench(HIGH)
    bench.offset_ns = int(offset_s * NS_PER_S)
    for late in jitter:
        assert bench.wait(50).stamped(HIGH, late_ms=late) == ""


# what state shows


def test_the_sources_are_listed_by_priority() -> None:
    statuses = Bench(LOW, HIGH, LEFT).arbiter.sources(0)
    assert [(s.name, s.priority) for s in statuses] == [("high", 100), ("left", 50), ("low", 10)]


def test_a_source_that_was_never_heard_has_no_age_and_waits_for_a_command() -> None:
    bench = Bench(HIGH, armed=False)
    assert bench.status(HIGH) == SourceStatus("high", 100, None, "a command")


def test_the_age_is_that_of_the_last_accepted_command() -> None:
    bench = Bench(HIGH)
    bench.send(HIGH)
    bench.wait(100).send(HIGH, Twist(math.nan, 0.0))
    assert bench.status(HIGH).age_s == 0.1


def test_a_command_that_arrived_just_now_or_while_the_step_ran_has_no_age() -> None:
    bench = Bench(HIGH)
    bench.send(HIGH)
    assert bench.status(HIGH).age_s == 0.0
    assert bench.wait(-1).status(HIGH).age_s == 0.0


def test_the_source_that_drives_waits_for_nothing() -> None:
    bench = Bench(HIGH, LOW)
    bench.send(HIGH)
    assert bench.driver() == "high"
    assert bench.status(HIGH).waits_for == ""


def test_a_source_that_may_drive_waits_for_nothing_before_anyone_was_chosen() -> None:
    bench = Bench(HIGH)
    bench.arbiter.require_neutral()
    bench.send(HIGH, REST)
    assert bench.status(HIGH).waits_for == ""


def test_a_silent_source_waits_for_a_command() -> None:
    bench = Bench(HIGH)
    bench.send(HIGH)
    bench.wait(251).choice()
    assert bench.status(HIGH).waits_for == "a command"


def test_a_source_that_was_not_neutral_says_how_to_become_so() -> None:
    bench = Bench(SLOW, armed=False)
    bench.send(SLOW)
    bench.choice()
    assert bench.status(SLOW).waits_for == (
        "neutral first: slow must send a zero, or pause for 1 s, before it can drive"
    )


def test_a_lower_source_is_told_who_is_above_it() -> None:
    bench = Bench(HIGH, LOW)
    bench.send(HIGH)
    bench.send(LOW)
    bench.choice()
    assert bench.status(LOW).waits_for == "high has the higher priority: until it is silent"


def test_an_equal_source_is_told_who_came_first() -> None:
    bench = Bench(LEFT, RIGHT)
    bench.send(RIGHT)
    bench.choice()
    bench.wait(10).send(LEFT)
    bench.choice()
    assert bench.status(LEFT).waits_for == (
        "right, of the same priority, came first: until it is silent"
    )


def test_holes_that_each_add_a_little_delay_do_not_add_up() -> None:
    bench = Bench(HIGH)
    bench.stamped(HIGH)
    bench.wait(10_100)
    assert bench.stamped(HIGH, late_ms=99.0) == ""
    bench.wait(10_100)
    assert bench.stamped(HIGH, late_ms=297.0) == "stale"

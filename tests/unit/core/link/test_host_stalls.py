"""A silence is reported as the board's or as that of a computer that did not run."""

from __future__ import annotations

from acsard.core.link.host_stalls import Lateness, is_ours
from acsard.core.link.link_state import WORDS

MS = 1_000_000
QUIET_NS = 100 * MS


def after(*steps_ms: int, good: bool = False, simulated: bool = False) -> Lateness:
    """Look after each of these steps, beginning with a good line at 0.

    `good` tells whether the last step brings a good line.
    """
    lateness = Lateness(simulated, QUIET_NS)
    now_ns = 0
    lateness.look(now_ns, good=True)
    for number, step_ms in enumerate(steps_ms, 1):
        now_ns += step_ms * MS
        lateness.look(now_ns, good=good and number == len(steps_ms))
    return lateness


def test_a_board_that_does_not_answer_steps_in_time_is_silent() -> None:
    assert after(*[10] * 11).words("stale") == WORDS["stale"]
    assert after(*[49] * 3).late_s == 0.0


def test_a_computer_that_did_not_run_is_told_with_how_long() -> None:
    for steps in ((800,), (10, 800, 10), (60, 800)):
        told = after(*steps).words("stale")
        assert told.startswith("this computer did not run for 0.80 s")
        assert "which other program" in told


def test_a_good_line_ends_it() -> None:
    assert after(800, 10, good=True).late_s == 0.0
    assert after(800, good=True).words("stale") == WORDS["stale"]


def test_a_simulator_that_is_late_is_no_silent_microcontroller() -> None:
    assert "simulator" in after(10, 10, simulated=True).words("stale")
    assert after(800, simulated=True).words("stale").startswith("this computer")


def test_a_link_that_is_up_or_closed_is_told_as_it_is() -> None:
    late = after(800)
    assert [late.words(state) for state in ("up", "booting", "down")] == [
        WORDS["up"], WORDS["booting"], WORDS["down"]
    ]  # fmt: skip


def test_words_of_a_silence_say_whose_it_is() -> None:
    ours = [after(800), after(800, simulated=True), after(10, simulated=True)]
    assert all(is_ours(lateness.words("stale")) for lateness in ours)
    assert not any(is_ours(words) for words in (WORDS["stale"], "", after(800).words("down")))

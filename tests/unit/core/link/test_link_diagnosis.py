"""The daemon explains a link that is down by the received bytes, or by a delay of this computer.

It reports a link that loses lines once, in whichever direction they are lost.
"""

from __future__ import annotations

import pytest

from acsard.core.config.settings import McuConfig
from acsard.core.link.lines import LineReader
from acsard.core.link.link_diagnosis import (
    FIRST_DIAGNOSIS_NS,
    MAX_UNANSWERED_FRACTION,
    WINDOW_LINES,
    Heard,
    Lateness,
    SilenceDiagnosis,
    UnansweredLines,
)
from acsard.core.link.link_setup import LinkSetup
from tests.unit.core.link.test_session import GOOD, Bench

MS = 1_000_000
SIMULATED, REAL = (LinkSetup.of(McuConfig(port=port), 100.0) for port in ("sim", "/dev/board"))

STILL = b"ap00.00,bp00.00,cp00.00,dp00.00\r\n"

HEARD: dict[str, tuple[bytes, str, str]] = {
    "mute": (b"", "nothing", "nothing was received"),
    "half lines": (
        b"ap00.00,bp00.00,c" * 9,
        "cut",
        "153 bytes received but no line end; the last bytes are `",
    ),
    "cut lines": (b"ap00.00,bp0\r\n" * 4, "cut", "none good, the last one is `ap00.00,bp0`"),
    "noise": (
        (b"\x00\xff~" + STILL) * 144,
        "foreign",
        r"lines received, none good, the last one is `\x00\xff~ap00.00,bp00.00,cp00.00,dp00.00`",
    ),
    "wrong baud rate": (b"\xf8\x00\xe6\n\x9e" * 3, "garbage", "3 lines received, none good"),
    "no end": (
        b"\xf8\x00\xe6" * 3, "garbage", r"the last bytes are `\xf8\x00\xe6\xf8\x00\xe6\xf8\x00\xe6`"
    ),
    "some good": (
        STILL + b"ap?\r\n", "few", "2 lines received, only 1 good, the last bad one is `ap?`"
    ),
    "all good": (STILL * 2, "sparse", "2 lines received, all of them good, but too few for a link"),
}  # fmt: skip


def test_a_board_that_only_prints_noise_is_reported_with_its_noise() -> None:
    bench = Bench().open()
    codes = []
    for tick in range(500):
        bench.wait(10, *([b"\x00\xff~" + GOOD] if tick % 2 else []))
        codes += [event.code for event in bench.session.events if event.name == "link_booting"]
    assert codes.count("received_foreign") == 1
    assert bench.why().code == "received_foreign"
    bench.wait(10, GOOD * 3)
    assert bench.why().code == "link_up"


def test_a_silent_link_is_reported_first_and_the_received_data_later() -> None:
    bench = Bench().up()
    for _ in range(20):
        bench.wait(10)
    assert bench.why().code == "simulator_fault"
    for _ in range(302):
        bench.wait(10)
    assert bench.why().code == "received_nothing"


@pytest.mark.parametrize(
    ("apart", "longest", "code"),
    [
        (20, 0.25, "reply_period"),
        (20, 0.15, "lines_too_rare"),
        (74, 0.25, "lines_too_rare"),
        (136, 0.25, "lines_too_rare"),
    ],
)
def test_lines_too_far_apart_are_reported_with_a_setting_only_if_it_is_valid(
    apart: int, longest: float, code: str
) -> None:
    bench = Bench(McuConfig(port="/dev/board"), longest_reply=longest).open()
    for tick in range(600):
        bench.wait(10, *([] if tick % apart else [GOOD]))
    assert bench.why().code == code


def test_a_single_silence_does_not_suggest_a_reply_period() -> None:
    bench = Bench(McuConfig(port="/dev/board")).up()
    for _ in range(20):
        bench.wait(10)
    bench.wait(10, GOOD)
    assert (bench.link(), bench.why().code) == ("stale", "link_silent")


@pytest.mark.parametrize("port", ["sim", "/dev/board"])
def test_lines_that_the_host_read_late_give_no_advice_about_the_board(port: str) -> None:
    bench = Bench(McuConfig(port=port)).up()
    codes = set()
    for _ in range(20):  # this computer runs a step late and finds the bytes that arrived meanwhile
        bench.wait(300)
        codes.add(bench.why().code)
        bench.wait(10, GOOD)
        codes.add(bench.why().code)
    assert codes == {"host_late", "simulator_fault" if port == "sim" else "link_silent"}


def after(*steps_ms: int, good: bool = False, simulated: bool = False) -> Lateness:
    """Check the lateness after each of these time steps. A good line arrives at time 0.

    `good` says whether another good line arrives in the last step.
    """
    lateness, setup = Lateness(), SIMULATED if simulated else REAL
    now_ns = 0
    lateness.record_step(setup, now_ns, good=True)
    for number, step_ms in enumerate(steps_ms, 1):
        now_ns += step_ms * MS
        lateness.record_step(setup, now_ns, good=good and number == len(steps_ms))
    return lateness


def test_silence_during_punctual_steps_is_blamed_on_the_board() -> None:
    assert after(*[10] * 11).describe(REAL, "stale").code == "link_silent"
    assert after(*[49] * 3).late_s == 0.0


def test_a_host_stall_is_reported_with_its_length() -> None:
    for steps in ((800,), (10, 800, 10), (60, 800)):
        assert after(*steps).describe(REAL, "stale").code == "host_late"
        assert after(*steps).late_s == 0.8


def test_a_good_line_ends_the_host_stall() -> None:
    assert after(800, 10, good=True).late_s == 0.0
    assert after(800, good=True).describe(REAL, "stale").code == "link_silent"


def test_a_late_simulator_is_not_reported_as_a_silent_microcontroller() -> None:
    assert after(10, 10, simulated=True).describe(SIMULATED, "stale").code == "simulator_fault"
    assert after(800, simulated=True).describe(SIMULATED, "stale").code == "host_late"


def test_a_link_that_is_not_stale_is_reported_unchanged_despite_a_host_stall() -> None:
    late = after(800)
    codes = [late.describe(REAL, state).code for state in ("up", "booting", "down")]
    assert codes == ["link_up", "booting", "port_closed"]


def diagnosis_of(data: bytes) -> Heard:
    diagnosis = Heard()
    diagnosis.take(data)
    for line, _ in LineReader().feed(data):
        diagnosis.line(line, line + b"\r\n" == STILL)
    return diagnosis


@pytest.mark.parametrize(("data", "looks", "counted"), HEARD.values(), ids=HEARD)
def test_the_diagnosis_says_what_was_received_how_it_looks_and_what_to_do(
    data: bytes, looks: str, counted: str
) -> None:
    diagnosis = diagnosis_of(data)
    assert diagnosis.code == f"received_{looks}"
    assert counted in diagnosis.counted
    assert diagnosis.diagnosis().code == f"received_{looks}"
    assert diagnosis.counted in diagnosis.diagnosis().text


def test_the_diagnosis_comes_after_three_seconds_and_again_only_when_it_changes() -> None:
    hearing, reports = SilenceDiagnosis(), []
    for tick in range(100):
        now_ns = tick * FIRST_DIAGNOSIS_NS // 10
        if tick > 50:
            hearing.now.take(b"\x00")
        if hearing.judge(now_ns):
            assert hearing.heard is not None
            reports.append((tick, hearing.heard.code))
    assert reports == [(10, "received_nothing"), (60, "received_garbage")]
    hearing.forget()
    assert hearing.heard is None
    assert not hearing.judge(10 * FIRST_DIAGNOSIS_NS)


def sparse(bench: Bench) -> Heard:
    """Return the first diagnosis of a board that sends three good lines and then nothing."""
    for tick in range(3 * 100 + 2):
        bench.wait(10, *([GOOD] if tick % 20 == 1 and tick < 50 else []))
    diagnosis = bench.session._hearing.heard
    assert diagnosis is not None
    assert diagnosis.code == "received_sparse"
    return diagnosis


def test_a_stall_while_the_link_was_up_does_not_explain_later_sparse_lines() -> None:
    bench = Bench(McuConfig(port="/dev/board")).up()
    bench.wait(2000, GOOD * 3)
    for _ in range(500):
        bench.wait(10, GOOD)
    assert bench.link() == "up"
    for _ in range(11):
        bench.wait(10)
    assert bench.link() == "stale"
    assert sparse(bench).diagnosis().code == "received_sparse"


def test_a_closed_port_is_not_a_host_stall() -> None:
    bench = Bench(McuConfig(port="/dev/board")).up().close()
    for _ in range(500):
        bench.wait(10)
    assert sparse(bench.open()).diagnosis().code == "received_sparse"


def test_a_stall_within_the_time_of_the_sparse_lines_explains_them() -> None:
    bench = Bench(McuConfig(port="/dev/board")).open()
    bench.wait(10)
    bench.wait(800)
    assert sparse(bench).diagnosis().code == "host_late"


def test_lines_that_came_while_the_output_was_blocked_are_not_counted_afterwards() -> None:
    hearing = SilenceDiagnosis()
    hearing.now.line(STILL, good=True)
    hearing.forget()
    assert hearing.now == Heard()


def events_of(every: int, windows: int = 3, period: float = 0.0, linked: bool = True) -> list[str]:
    """Return the events of a link that loses every n-th line."""
    answered = UnansweredLines()
    events = [
        answered.check(sent, sent - sent // every if every else sent, linked, period)
        for sent in range(windows * WINDOW_LINES + 1)
    ]
    return [event.text for event in events if event is not None]


def test_a_loss_of_a_fifth_of_the_lines_is_reported_once_with_its_figures() -> None:
    (text,) = events_of(5)
    assert f"answered only {WINDOW_LINES * 4 // 5} of {WINDOW_LINES} lines" in text


def test_the_few_losses_of_a_sound_link_are_not_reported() -> None:
    assert events_of(0) == events_of(int(1 / MAX_UNANSWERED_FRACTION) + 1) == []


def test_losses_are_not_judged_for_a_free_running_board_or_without_a_link() -> None:
    assert events_of(5, period=0.1) == events_of(5, linked=False) == []


def test_losses_are_reported_again_after_the_link_was_down() -> None:
    answered, events = UnansweredLines(), []
    for sent in range(3 * WINDOW_LINES):
        events.append(answered.check(sent, sent // 2, sent != WINDOW_LINES + 10, 0.0))
    assert len([event for event in events if event]) == 2

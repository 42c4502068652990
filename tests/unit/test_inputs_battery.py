"""The battery: levels, hysteresis, averaged voltage, and a board that falls silent."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from acsard.core.config.settings import BatteryConfig, Config
from acsard.core.link.board_status import BoardStatus
from acsard.core.motion.battery import (
    SILENCE_TIMEOUT_S,
    SILENT_REASON,
    TIME_CONSTANT_S,
    BatteryInput,
    status_text,
)
from acsard.core.motion.latches import after_restart
from acsard.core.values import BatteryLevel, BatteryStatus
from tests.each import each
from tests.unit.rig import Rig

MS = 1_000_000
CONFIG = BatteryConfig(warning_below=21.5, stop_below=21.0)
ORDER = ("ok", "warning", "stop")


class Pack:
    """A battery monitor with a simulated time. The first step is at 10 s."""

    def __init__(self, config: BatteryConfig = CONFIG) -> None:
        self.battery, self.config, self.now_ms, self.linked = BatteryInput(), config, 10_000, True
        self.events: list[tuple[str, str]] = []
        self.stops = 0

    def step(self, *lines: BoardStatus, ms: int = 100) -> BatteryLevel | None:
        """Process these status lines `ms` after the last step, and return the level."""
        self.now_ms += ms
        reports = [(self.now_ms * MS, line) for line in lines]
        events = self.battery.process_reports(reports, self.now_ms * MS, self.linked, self.config)
        self.events += [(event.name, event.text) for event in events]
        self.stops += self.battery.stopped_now
        return self.battery.level or None

    def at(self, volts: float, seconds: float, ms: int = 100) -> BatteryLevel | None:
        """Report this voltage for this time, once every `ms`."""
        count = round(seconds * 1000 / ms)
        return [self.step(BoardStatus(volts=volts), ms=ms) for _ in range(count)][-1]

    def quiet(self, seconds: float) -> BatteryLevel | None:
        return [self.step() for _ in range(round(seconds * 10))][-1]

    @property
    def status(self) -> BatteryStatus:
        assert self.battery.status is not None
        return self.battery.status

    @property
    def mean(self) -> float:
        assert self.status.mean is not None
        return self.status.mean


def test_without_thresholds_or_reports_there_is_no_level_to_act_on() -> None:
    pack = Pack()
    assert pack.quiet(20.0) is pack.step(BoardStatus(estop=False, amps=-1.0)) is None
    assert (pack.events, pack.stops, pack.battery.refuses_clear) == ([], 0, False)
    pack = Pack(BatteryConfig())
    assert pack.step(BoardStatus(volts=3.0, amps=-1.25, charge=0.29)) == "ok"
    assert pack.status == BatteryStatus("ok", pack.now_ms * MS, 3.0, 29.0, -1.25, 3.0)
    assert pack.events == [("battery", "3.00 V, 29 %, -1.25 A")]


@each(
    ("volts", "level"),
    [
        (25.0, "ok"), (21.5, "ok"), (21.49, "warning"),
        (21.0, "warning"), (20.99, "stop"), (0.0, "stop"),
    ],
)  # fmt: skip
def test_a_steady_voltage_has_its_level_after_3_s(volts: float, level: BatteryLevel) -> None:
    pack = Pack()
    assert pack.at(volts, 3.0) == "unknown"
    assert pack.events == []
    assert status_text(CONFIG, pack.status).endswith("3 s")
    assert pack.at(volts, 0.1) == pack.at(volts, 60.0) == level
    assert [name for name, _ in pack.events] == ["battery_stop" if level == "stop" else "battery"]


def test_thresholds_in_per_cent_compare_the_charge() -> None:
    for charge, level in ((0.3, "ok"), (0.29, "warning"), (0.0, "warning")):
        pack = Pack(BatteryConfig("percent", warning_below=30.0))
        for _ in range(100):
            pack.step(BoardStatus(charge=charge))
        assert (pack.status.level, pack.stops) == (level, 0)


def test_a_level_ends_above_its_threshold_by_the_hysteresis() -> None:
    pack = Pack()
    path = (21.4, 21.99, 22.01, 20.9, 21.49, 21.51, 21.9, 22.1)
    assert [pack.at(volts, 60.0) for volts in path] == [
        "warning", "warning", "ok", "stop", "stop", "warning", "warning", "ok",
    ]  # fmt: skip
    assert pack.stops == 1


@settings(max_examples=100)
@given(st.lists(st.floats(15.0, 30.0), min_size=40, max_size=60))
def test_while_the_mean_falls_the_level_never_gets_better(volts: list[float]) -> None:
    pack = Pack()
    before: tuple[float, str] | None = None
    for value in volts:
        pack.step(BoardStatus(volts=value))
        level, mean = pack.status.level, pack.mean
        assert min(volts) - 1e-9 <= mean <= max(volts) + 1e-9
        if level == "unknown":
            continue
        if before and mean <= before[0]:
            assert ORDER.index(level) >= ORDER.index(before[1])
        before = mean, level


# motor starts


@each("start_ms", range(0, 1000, 250))
@each("ms", [20, 100, 250])
def test_a_motor_start_does_not_change_the_level(start_ms: int, ms: int) -> None:
    """The voltage is 0.1 V above the level that stops; a motor lowers it by 2 V for 0.3 s."""
    pack = Pack()
    pack.at(21.1, 30.0, ms=ms)
    for at_ms in range(0, 5000, ms):
        sags = start_ms <= at_ms < start_ms + 300
        pack.step(BoardStatus(volts=19.1 if sags else 21.1), ms=ms)
        assert pack.status.level == "warning"
        # A board that reports every 250 ms may show the drop for 0.5 s.
        assert pack.mean > 21.1 - (0.1 if ms == 250 else 0.07)
    assert pack.stops == 0


def test_what_lasts_counts_by_its_mean() -> None:
    seldom = Pack()
    seldom.at(21.1, 60.0, ms=1000)
    seldom.at(19.1, 1.0, ms=1000)
    assert seldom.status.level == "warning"
    assert seldom.mean == pytest.approx(21.04)
    often = Pack()  # motors that start every two seconds
    often.at(21.6, 30.0)
    for _ in range(30):
        often.at(19.6, 0.3)
        often.at(21.6, 1.7)
    assert (often.status.level, often.stops) == ("warning", 0)
    assert often.mean == pytest.approx(21.6 - 0.3, abs=0.06)
    drop = Pack()
    drop.at(24.0, 30.0)
    drop.at(20.0, TIME_CONSTANT_S)
    assert drop.mean == pytest.approx(20.0 + 4.0 / 2.718, abs=0.02)
    assert drop.status.level == "warning"
    assert drop.at(20.0, TIME_CONSTANT_S) == "stop"
    gap = Pack()  # one line after it counts no longer than a motor start
    gap.at(24.0, 30.0)
    gap.quiet(4.0)
    gap.at(22.0, 0.1)
    assert gap.mean == pytest.approx(23.94)
    burst = Pack()  # the lines of one read count once
    burst.step(BoardStatus(volts=24.0), BoardStatus(volts=20.0))
    assert burst.mean == 24.0
    burst.at(24.0, 30.0)
    burst.step(*[BoardStatus(volts=20.0)] * 50)
    assert burst.mean == pytest.approx(23.96)


# silence


def test_the_level_of_a_silent_board_is_unknown_and_stops_nothing() -> None:
    pack = Pack()
    pack.at(24.0, 10.0)
    assert pack.quiet(SILENCE_TIMEOUT_S) == "ok"
    assert pack.step(BoardStatus(estop=False)) == "unknown"
    assert pack.status == BatteryStatus("unknown")
    assert pack.quiet(600.0) == "unknown"
    assert pack.events == [("battery", "24.00 V"), ("battery", SILENT_REASON)]
    assert (pack.stops, pack.battery.refuses_clear) == (0, False)
    assert (pack.at(24.0, 3.0), pack.at(24.0, 0.1)) == ("unknown", "ok")
    assert pack.events[2:] == [("battery", "24.00 V")]


def test_a_silence_with_a_link_ends_the_refusal_of_clear() -> None:
    pack = Pack()
    pack.at(20.0, 10.0)
    pack.linked = False
    pack.quiet(600.0)
    assert pack.battery.refuses_clear
    pack.linked = True
    pack.quiet(SILENCE_TIMEOUT_S)
    assert pack.battery.refuses_clear
    assert pack.quiet(0.2) == "unknown"
    assert not pack.battery.refuses_clear
    assert pack.at(20.0, 10.0) == "stop"
    # A `clear` may have released the first stop.
    assert (pack.stops, pack.battery.refuses_clear) == (2, True)


@each(
    ("measure", "line", "text"),
    [
        ("volts", BoardStatus(charge=0.5), '50 %; battery.measure = "volts", but the board reports '
         "no voltage"),
        ("percent", BoardStatus(volts=24.5), '24.50 V; battery.measure = "percent", but the board '
         "reports no charge"),
    ],
)  # fmt: skip
def test_a_board_that_does_not_report_the_measure_is_named(
    measure: str, line: BoardStatus, text: str
) -> None:
    pack = Pack(BatteryConfig(measure, stop_below=20.0))  # type: ignore[arg-type]
    assert {pack.step(line) for _ in range(100)} == {"unknown"}
    assert pack.events == [("battery", text)]
    assert status_text(pack.config, pack.status) == text
    pack = Pack()  # also if it did before
    for _ in range(50):
        pack.step(BoardStatus(volts=24.0, charge=0.5))
    for _ in range(60):
        pack.step(BoardStatus(charge=0.5))
    assert pack.status == BatteryStatus("unknown", pack.now_ms * MS, None, 50.0)


def test_a_stop_level_is_forgotten_unless_the_new_board_reports_the_measure() -> None:
    pack = Pack()
    pack.at(19.0, 20.0)
    for line, refuses in ((BoardStatus(volts=19.0), True), (BoardStatus(charge=0.9), False)):
        pack.battery.reopen()
        pack.step(line)
        pack.battery.forget(pack.config)
        assert pack.battery.refuses_clear == refuses
    assert pack.step(BoardStatus(charge=0.9)) == "unknown"
    pack.quiet(6.0)
    pack.battery.reopen()
    pack.battery.forget(pack.config)
    assert pack.quiet(1.0) is None
    assert pack.at(24.0, 5.0) == "ok"
    assert pack.stops == 1


# what the robot does

FULL, EMPTY = b"!status volts=24.00\r\n", b"!status volts=19.00\r\n"
GUARDED = Config(battery=BatteryConfig(warning_below=22.0, stop_below=21.0))


def test_after_a_restart_clear_waits_for_a_report() -> None:
    latches = after_restart(Rig(GUARDED, status=EMPTY).run(400).latches)
    rig = Rig(GUARDED, latches).linked()
    assert not rig.answer("clear").success
    rig.board(FULL).run(310)
    assert rig.answer("clear").success

"""The firmware's debounced contacts, measurements and status lines, compiled for this machine."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsard.core.link.board_status import BoardStatus, decode_status
from tests.firmware.board import Library
from tests.firmware.conftest import ALL_INPUTS

pytestmark = pytest.mark.slow

CLOSED = 0b100000
"""Levels of the pins when nothing is pressed: contacts to ground, and no fault."""

Build = Callable[..., Library]


class Inputs:
    """The firmware's functions for inputs after a boot of the board."""

    def __init__(self, library: Library) -> None:
        self._library, self._c = library, library.c
        self._status = library.new("status")
        self._c.status_start(self._status)
        self.milliseconds = 0

    @property
    def stopped(self) -> bool:
        """Whether the emergency stop is pressed."""
        return bool(self._c.status_stopped(self._status))

    def sample(self, levels: int, readings: Sequence[int] = ()) -> BoardStatus | None:
        """Read the inputs once and advance the time by 1 ms. Return the line due then, if any."""
        self.milliseconds += 1
        for analog, value in enumerate(readings):
            self._c.status_reading(self._status, analog, value)
        self._c.status_contacts(self._status, levels)
        return self.line()

    def line(self) -> BoardStatus | None:
        """Return the fields of the status line that is due now, or None."""
        write = self._c.status_line
        line = self._library.text(lambda out: write(self._status, self.milliseconds, out))
        if not line:
            return None
        assert line.endswith(b"\r\n")
        assert len(line) <= 52
        return decode_status(line[:-2], True)

    def lines(self, levels: int, length_ms: int, readings: Sequence[int] = ()) -> list[BoardStatus]:
        """Keep these inputs for `length_ms`, and return the status lines of that time."""
        every = [self.sample(levels, readings) for _ in range(length_ms)]
        return [status for status in every if status is not None]


@pytest.fixture
def inputs(build: Build) -> Inputs:
    """The library with every input."""
    return Inputs(build(*ALL_INPUTS))


def test_firmware_as_delivered_never_sends_a_status_line(library: Library) -> None:
    inputs = Inputs(library)
    assert inputs.lines(0xFF, 3000, (1023, 1023)) == []
    assert not inputs.stopped


def test_contacts_are_reported_ten_times_a_second_and_values_once(inputs: Inputs) -> None:
    statuses = inputs.lines(CLOSED, 10_000, (512, 512))
    assert (
        98
        <= sum(status.estop is False and status.bumpers is not None for status in statuses)
        <= 100
    )
    values = BoardStatus(driver_fault=False, volts=16.5, amps=0.0)
    assert [status for status in statuses if status.estop is None] == [values] * 10


@given(st.lists(st.tuples(st.booleans(), st.integers(1, 25)), max_size=12))
def test_a_contact_is_released_only_by_20_free_samples_and_pressed_by_three(
    build: Build, runs: list[tuple[bool, int]]
) -> None:
    """Three pressed samples press a contact if no run of 20 free samples is between them."""
    inputs = Inputs(build(*ALL_INPUTS))
    inputs.lines(CLOSED, 25)
    samples: list[bool] = [False] * 25
    for pressed, length in runs:
        for _ in range(length):
            samples.append(pressed)
            inputs.sample(CLOSED | pressed)
            since = len(samples)
            free = 0
            while since and free < 20:
                since -= 1
                free = 0 if samples[since] else free + 1
            assert inputs.stopped == (sum(samples[since:]) >= 3), samples


@pytest.mark.slow
@pytest.mark.parametrize(
    ("defines", "free", "pressed"),
    [
        (("-DBUMPER_INPUTS=2",), 0b000000, 0b000110),
        (("-DBUMPER_INPUTS=2", "-DBUMPERS_CLOSE=1"), 0b000110, 0b000000),
    ],
)
def test_bumpers_open_or_close_when_pressed(
    build: Build, defines: tuple[str, ...], free: int, pressed: int
) -> None:
    inputs = Inputs(build(*defines))
    assert inputs.lines(free, 25) == [BoardStatus(bumpers=(False, False))]
    assert inputs.lines(pressed, 5) == [BoardStatus(bumpers=(True, True))]
    assert not inputs.stopped


@pytest.mark.parametrize("length_ms", [3, 40, 500])
def test_even_a_short_driver_fault_is_reported_within_110_ms(build: Build, length_ms: int) -> None:
    inputs = Inputs(build("-DDRIVER_INPUT=1"))
    inputs.lines(CLOSED, 1200)
    begun = inputs.milliseconds
    while (
        report := inputs.sample(0 if inputs.milliseconds < begun + length_ms else CLOSED)
    ) is None:
        pass
    assert report.driver_fault
    assert inputs.milliseconds - begun <= 110
    assert [status.driver_fault for status in inputs.lines(CLOSED, 1000)] == [False]


def test_a_press_is_reported_before_the_fault_of_a_driver_that_lost_its_supply_a_little_earlier(
    inputs: Inputs,
) -> None:
    inputs.lines(CLOSED, 1200, (600, 512))
    statuses = inputs.lines(0, 50, (600, 512)) + inputs.lines(1, 100, (600, 512))
    pressed = next(i for i, status in enumerate(statuses) if status.estop)
    assert [i for i, status in enumerate(statuses) if status.driver_fault] > [pressed]


@pytest.mark.slow
@pytest.mark.parametrize("high", [0, 1])
def test_the_driver_fault_input_can_be_active_low_or_active_high(build: Build, high: int) -> None:
    inputs = Inputs(build("-DDRIVER_INPUT=1", f"-DDRIVER_FAULT_HIGH={high}"))
    fault = 0b100000 if high else 0
    assert inputs.lines(fault ^ 0b100000, 1000) == [BoardStatus(driver_fault=False)]
    assert inputs.lines(fault, 1000) == [BoardStatus(driver_fault=True)]


def test_the_volts_are_the_mean_of_a_second(build: Build) -> None:
    inputs = Inputs(build("-DBATTERY_TOP_OHM=56000L"))
    for _ in range(999):
        assert inputs.sample(0, (700 + 40 * (inputs.milliseconds % 2),)) is None
    status = inputs.sample(0, (720,))
    assert status is not None
    assert status.volts == pytest.approx(720 * 5 / 1024 * 6.6, abs=0.02)


def test_values_that_do_not_fit_the_line_are_clamped(build: Build) -> None:
    wide = Inputs(build("-DBATTERY_TOP_OHM=188000L", "-DCURRENT_UV_PER_A=1000L"))
    status = wide.lines(0, 1000, (1023, 1023))[-1]
    assert status.volts == pytest.approx(98.9, abs=0.01)
    assert status.amps == 999.99
    assert wide.lines(0, 1000, (0, 0))[-1] == BoardStatus(volts=0.0, amps=-999.99)


def test_a_sensor_that_is_wired_the_other_way_round_has_a_negative_setting(build: Build) -> None:
    inputs = Inputs(build("-DCURRENT_UV_PER_A=-100000L"))
    assert inputs.lines(0, 1000, (0, 0))[-1] == BoardStatus(amps=25.0)
    assert inputs.lines(0, 1000, (0, 512))[-1] == BoardStatus(amps=0.0)

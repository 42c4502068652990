"""The mode table, cell by cell."""

from __future__ import annotations

import pytest

from acsard.drive.modes import REFUSALS, TABLE, Mode, RefusedError, Trigger, next_mode

CELLS = {(mode, trigger) for mode in Mode for trigger in Trigger}

FACTS = {
    Trigger.LINK_UP,
    Trigger.LINK_LOST,
    Trigger.COMMAND,
    Trigger.NO_COMMAND,
    Trigger.FAULT,
    Trigger.LEAVE,
}

LATCHED = {Mode.STOPPED, Mode.FAULT}

# The whole table once more, drawn by hand as DESIGN and SAFETY tell it. A capital letter is the
# mode it leads to, "." stays, "-" is refused.
#
#            link_up link_lost command no_command fault leave stop clear activate deactivate
DRAWN = """
    inactive    .       .        .        .        F     L     S     .      W         .
    waiting     R       .        .        .        F     L     S     .      .         I
    ready       .       W        D        .        F     L     S     .      .         I
    driving     .       W        .        R        F     L     S     .      .         I
    stopped     .       .        .        .        F     L     .     I      -         -
    fault       .       .        .        .        .     L     .     I      -         -
    leaving     .       .        .        .        .     .     .     -      -         -
"""

LETTERS = {mode.value[0].upper(): mode for mode in Mode}


def drawn() -> dict[tuple[Mode, Trigger], str]:
    rows = [line.split() for line in DRAWN.strip().splitlines()]
    return {
        (Mode(mode), trigger): cell
        for mode, *cells in rows
        for trigger, cell in zip(Trigger, cells, strict=True)
    }


def test_every_mode_has_its_own_letter_in_the_drawing() -> None:
    assert len(LETTERS) == len(Mode)
    assert set(drawn()) == CELLS


@pytest.mark.parametrize(("mode", "trigger"), sorted(CELLS))
def test_a_trigger_leads_where_the_drawing_says(mode: Mode, trigger: Trigger) -> None:
    cell = drawn()[mode, trigger]
    if cell == "-":
        with pytest.raises(RefusedError):
            next_mode(mode, trigger)
    else:
        assert next_mode(mode, trigger) is (mode if cell == "." else LETTERS[cell])


def test_the_table_and_the_refusals_share_no_cell() -> None:
    assert not set(TABLE) & set(REFUSALS)


def test_the_table_and_the_refusals_fill_every_cell() -> None:
    assert set(TABLE) | set(REFUSALS) == CELLS


@pytest.mark.parametrize(("mode", "trigger"), sorted(REFUSALS))
def test_a_refusal_says_why(mode: Mode, trigger: Trigger) -> None:
    with pytest.raises(RefusedError) as caught:
        next_mode(mode, trigger)
    assert str(caught.value) == REFUSALS[mode, trigger]
    assert len(str(caught.value)) > 10


@pytest.mark.parametrize(("mode", "trigger"), sorted(REFUSALS))
def test_a_refusal_of_a_latched_mode_names_the_way_out(mode: Mode, trigger: Trigger) -> None:
    assert ("srv/clear" in REFUSALS[mode, trigger]) == (mode in LATCHED)


def test_a_fact_is_never_refused() -> None:
    assert {trigger for _, trigger in REFUSALS} == {
        Trigger.CLEAR,
        Trigger.ACTIVATE,
        Trigger.DEACTIVATE,
    }
    assert not FACTS & {trigger for _, trigger in REFUSALS}


def test_a_stop_is_never_refused() -> None:
    assert all((mode, Trigger.STOP) in TABLE for mode in Mode)


def test_only_a_command_in_ready_begins_driving() -> None:
    begins = {cell for cell, to in TABLE.items() if to is Mode.DRIVING} - {
        (Mode.DRIVING, trigger) for trigger in Trigger
    }
    assert begins == {(Mode.READY, Trigger.COMMAND)}


def test_only_a_command_a_link_and_a_needless_clear_or_activate_leave_driving_as_it_is() -> None:
    stays = {trigger for trigger in Trigger if TABLE.get((Mode.DRIVING, trigger)) is Mode.DRIVING}
    assert stays == {Trigger.COMMAND, Trigger.LINK_UP, Trigger.CLEAR, Trigger.ACTIVATE}


def test_a_latched_mode_is_left_only_by_clear_a_fault_or_leaving() -> None:
    exits = {trigger for (mode, trigger), to in TABLE.items() if mode in LATCHED and to is not mode}
    assert exits == {Trigger.CLEAR, Trigger.FAULT, Trigger.LEAVE}


def test_a_fault_is_left_only_by_clear_or_leaving() -> None:
    exits = {
        trigger for (mode, trigger), to in TABLE.items() if mode is Mode.FAULT and to is not mode
    }
    assert exits == {Trigger.CLEAR, Trigger.LEAVE}


def test_leaving_is_for_good() -> None:
    assert {to for (mode, _), to in TABLE.items() if mode is Mode.LEAVING} == {Mode.LEAVING}


def test_clear_never_leads_straight_to_motion() -> None:
    assert {
        to for (mode, trigger), to in TABLE.items() if trigger is Trigger.CLEAR and to is not mode
    } == {Mode.INACTIVE}


@pytest.mark.parametrize("mode", Mode)
def test_without_a_link_nothing_is_driving_or_ready(mode: Mode) -> None:
    assert next_mode(mode, Trigger.LINK_LOST) not in (Mode.READY, Mode.DRIVING)

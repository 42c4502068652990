"""Tests of the doctor's findings about a link that is down or loses lines."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from acsard.config.settings import Config, McuConfig
from acsard.doctor.finding import Finding
from acsard.doctor.link import gone, link, lost, refused
from acsard.doctor.running import Running
from tests.unit.doctor.test_running import INFO, STATE

CONFIG = Config(mcu=McuConfig(port="/dev/ttyX"))


def found(before: dict[str, int], after: dict[str, int], **state: str) -> list[Finding]:
    one, two = replace(STATE, counters=before), replace(STATE, counters=after, **state)
    return list(link(Running(INFO, CONFIG, one, two, 0)))


def test_a_sound_link_is_one_ok() -> None:
    (finding,) = found({"lines": 5, "lines_sent": 900}, {"lines": 104, "lines_sent": 1000})
    assert (finding.subject, finding.level) == ("link", "ok")


@pytest.mark.parametrize("state", ["booting", "stale"])
def test_no_link_is_a_failure_with_what_was_heard_and_the_check(state: str) -> None:
    (finding,) = found({}, {}, link=state, mode="waiting", reason="nothing at all heard")
    assert finding.level == "failure"
    assert "nothing at all heard" in finding.text
    assert "acsard mcu check --port /dev/ttyX" in finding.mend
    assert "kill 77" in finding.mend


def test_a_port_that_is_closed_is_mended_at_the_port() -> None:
    (finding,) = found({}, {}, link="down", mode="waiting", reason="no such device")
    assert "port above" in finding.mend


def test_lines_that_are_not_answered_are_a_warning() -> None:
    (finding,) = found({"lines": 80, "lines_sent": 100}, {"lines": 160, "lines_sent": 200})
    assert finding.level == "warning"
    assert "of 100 lines that were sent in a second 80 were answered" in finding.text
    assert "mcu check" in finding.mend


@pytest.mark.parametrize(
    ("sent", "came", "period", "told"),
    [(100, 100, 0.0, 0), (100, 98, 0.0, 0), (100, 97, 0.0, 0), (100, 96, 0.0, 1),
     (100, 130, 0.0, 0), (10, 0, 0.0, 0), (100, 10, 0.1, 0)],
)  # fmt: skip
def test_what_is_no_loss_is_not_told(sent: int, came: int, period: float, told: int) -> None:
    config = Config(mcu=McuConfig(reply_period=period))
    assert len(list(lost({"lines_sent": sent, "lines": came}, config))) == told


def test_lines_that_did_not_count_are_told_by_kind_above_one_in_fifty() -> None:
    assert not list(refused({"lines": 1000, "line_malformed": 20, "lines_sent": 9}))
    (text,) = refused({"lines": 1000, "line_malformed": 12, "line_wrong_check": 30})
    assert "12 malformed, 30 wrong check" in text


def test_a_link_that_went_because_this_computer_was_late_is_not_blamed_on_the_board() -> None:
    (late,) = found({}, {"link_lost": 3, "link_lost_late": 3})
    assert "lost 3 times" in late.text
    assert "this computer" in late.text
    assert "mcu check" not in late.mend
    late, board = found({}, {"link_lost": 5, "link_lost_late": 3})
    assert "lost 2 times" in board.text
    assert "mcu check" in board.mend
    states = replace(STATE, counters={"link_lost": 2})
    (sim,) = link(Running(INFO, Config(), STATE, states, 0))
    assert "this computer" in sim.text
    assert "mcu check" not in sim.mend
    why = "this computer did not run for 0.80 s, and heard nothing"
    (finding,) = found({}, {}, link="stale", mode="waiting", reason=why)
    assert why in finding.text
    assert "mcu check" not in finding.mend


def test_a_wheel_that_is_left_out_is_told() -> None:
    *_, finding = found({}, {}, doubt="rear left: its encoder stands")
    assert (finding.subject, finding.level) == ("wheels", "warning")


DAYS_40 = {"lines": 340_000_000, "lines_sent": 345_600_000}
"""Line counters after 40 days at 100 Hz."""


def test_after_months_what_is_wrong_now_is_told_and_no_old_accident() -> None:
    (finding,) = found(DAYS_40, DAYS_40 | {"link_lost": 40})
    assert finding.level == "ok"
    assert "lost 40 times" in finding.text
    (finding,) = found(DAYS_40, DAYS_40 | {"link_lost": 41})
    assert finding.level == "warning"
    now = {"lines": DAYS_40["lines"] + 90, "lines_sent": DAYS_40["lines_sent"] + 100}
    _, finding = found(DAYS_40, now | {"line_malformed": 10})
    assert finding.level == "warning"
    assert "10 malformed" in finding.text


def test_a_link_that_went_is_told_with_how_often() -> None:
    assert not gone({"lines": 9})
    (finding,) = found({}, {"link_lost": 4})
    assert finding.level == "warning"
    assert "lost 4 times" in finding.text

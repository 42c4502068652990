"""What the doctor makes of two clocks."""

from __future__ import annotations

import pytest

from acsard.doctor.daemon import clocks, gyro

NOW = 1_800_000_000_000_000_000
S = 10**9


@pytest.mark.parametrize("apart", [0.0, 0.3, -0.3])
def test_clocks_that_agree_are_no_finding(apart: float) -> None:
    assert list(clocks(NOW + int(apart * S), NOW, {"commands": 7})) == []


@pytest.mark.parametrize(
    ("apart", "words"), [(3600.0, "3600.0 s ahead of"), (-0.5, "0.5 s behind")]
)
def test_clocks_that_do_not_are_a_warning_with_its_mend(apart: float, words: str) -> None:
    (finding,) = clocks(NOW + int(apart * S), NOW, {})
    assert (finding.subject, finding.level) == ("clock", "warning")
    assert words in finding.text
    assert "timedatectl" in finding.mend


def test_stamps_that_were_replaced_are_told() -> None:
    (finding,) = clocks(NOW, NOW, {"stamps_replaced": 12})
    assert "12 commands" in finding.text


@pytest.mark.parametrize("does", ["off", "used", "waiting for rest"])
def test_a_gyro_that_does_what_it_should_is_no_warning(does: str) -> None:
    assert [one.level for one in gyro(does, {})] == ([] if does == "off" else ["ok"])


@pytest.mark.parametrize("does", ["silent", "disagrees", "not believed", "what a later one does"])
def test_a_gyro_that_does_not_is_a_warning_with_its_mend(does: str) -> None:
    (finding,) = gyro(does, {})
    assert (finding.subject, finding.level) == ("gyro", "warning")
    assert finding.text
    assert finding.mend


def test_samples_of_a_gyro_that_do_not_count_are_told_by_their_reasons() -> None:
    counters = {"imu_absurd": 3, "imu_second_sender": 12, "imu_not_finite": 0, "lines": 9}
    _, finding = gyro("used", counters)
    assert finding.level == "warning"
    assert "12 second sender, 3 absurd" in finding.text
    assert finding.mend

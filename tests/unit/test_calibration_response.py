"""The response time is found, and written if the configured one is too short."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from msgspec import structs

from acsard.calibration.log import Log, LogError, Run
from acsard.calibration.response import response_time
from acsard.calibration.result import calibrate
from acsard.core.config.settings import Config, DriveConfig, FeedbackConfig
from tests.unit.calibration_logs import run, usual


@cache
def whole() -> Run:
    return run(usual(), places=False)


def commanded(lag: float, fastest: float = 99.0, cut: bool = False) -> Run:
    """Return a drive whose wheels follow steps of the command behind a lag."""
    t = np.arange(0, 60, 0.02)
    wish = 0.3 * np.sign(np.sin(t / 3)) * (np.sin(t) > -0.5)
    speed = np.zeros(len(t))
    for i in range(1, len(t)):
        limited = np.clip(wish[i] / 0.05, -fastest, fastest)
        speed[i] = speed[i - 1] + (limited - speed[i - 1]) * (0.02 / (lag + 0.02))
    angle = np.cumsum(speed) * 0.02
    kept = (t % 20 < 10) if cut else np.ones(len(t), dtype=bool)
    commands = np.column_stack((wish, np.zeros(len(t))))[kept]
    return structs.replace(
        whole(), t=t, left=angle, right=angle, commands_t=t[kept], commands=commands
    )


@pytest.mark.parametrize("lag", [0.05, 0.3, 1.3])
@pytest.mark.parametrize("kind", ["", "slow motors", "gaps"])
def test_the_lag_is_found(lag: float, kind: str) -> None:
    made = commanded(lag, 4.0 if kind == "slow motors" else 99.0, kind == "gaps")
    assert response_time([made], DriveConfig()) == pytest.approx(lag, rel=0.25)


def test_a_log_without_commands_or_whose_wheels_do_not_follow_shows_none() -> None:
    assert response_time([run(usual())], DriveConfig()) is None
    made = commanded(0.2)
    backwards = structs.replace(made, left=-made.left, right=-made.right)
    assert response_time([backwards], DriveConfig()) is None


@pytest.mark.parametrize(("present", "written"), [(0.2, True), (0.5, False)])
def test_a_longer_response_time_is_written_and_a_shorter_one_is_not(
    present: float, written: bool
) -> None:
    trip = run(usual(), places=False)
    slow = commanded(0.45)
    none = np.zeros(0)
    slow = structs.replace(slow, gyro_t=none, rate=none, turned=none)
    config = structs.replace(Config(), feedback=FeedbackConfig(response_time=present))
    result = calibrate(Log((trip, slow), ()), config, "a.csv")
    assert ("feedback.response_time" in result.settings) == written
    assert any("response time of 0.4" in sentence for sentence in result.decisions)


def test_a_log_that_shows_nothing_better_is_refused_with_its_decisions() -> None:
    trip = usual()
    first = calibrate(Log((run(trip, places=False),), ()), Config(), "a.csv")
    tables: dict[str, dict[str, float]] = {}
    for key, value in first.settings.items():
        section, _, name = key.partition(".")
        tables.setdefault(section, {})[name] = value
    config = structs.replace(
        Config(), drive=structs.replace(Config().drive, **tables["drive"]),
        odometry=structs.replace(Config().odometry, **tables["odometry"]),
    )  # fmt: skip
    with pytest.raises(LogError, match=r"nothing to write\.\n.* stay as configured"):
        calibrate(Log((run(trip, places=False),), ()), config, "a.csv")


def stepped(seconds: float, lag: float = 0.4, turns: bool = False, wobble: float = 0.0) -> Run:
    """Return steps of the command each 2 s that the wheels follow exactly, or wobble, rad/s."""
    t = np.arange(0, seconds + 0.001, 0.02)
    wish = np.where(t // 2 % 2 < 1, 1.0, -0.5)
    # As configured: wheels of 0.05 m that are 0.3 m apart.
    sides = wish / 0.05 * (np.array([-0.15, 0.15]) if turns else np.array([1.0, 1.0]))[:, None]
    speeds = np.zeros(sides.shape)
    for n in range(1, len(t)):
        speeds[:, n] = speeds[:, n - 1] + (sides[:, n] - speeds[:, n - 1]) * 0.02 / (lag + 0.02)
    angles = np.cumsum(speeds + wobble * np.sin(44 * t), axis=1) * 0.02
    return structs.replace(
        whole(), t=t, left=angles[0], right=angles[1], commands_t=t,
        commands=np.column_stack((0 * wish, wish) if turns else (wish, 0 * wish)),
    )  # fmt: skip


@pytest.mark.parametrize("turns", [False, True])
def test_the_lag_of_wheels_that_follow_exactly_is_found_within_a_step(turns: bool) -> None:
    """The tried times are 11 % apart."""
    for lag in (0.1, 0.4):
        found = response_time([stepped(20.0, lag, turns)], DriveConfig())
        assert found == pytest.approx(lag, rel=0.06)


def test_a_response_time_needs_4_s_of_commands_that_explain_half_of_the_motion() -> None:
    for seconds, shown in ((3.9, False), (4.1, True)):
        assert (response_time([stepped(seconds)], DriveConfig()) is not None) is shown
    for share, shown in ((0.45, True), (0.55, False)):
        wobble = np.sqrt(2 * 245 * share / (1 - share))
        found = response_time([stepped(20.0, 0.05, wobble=wobble)], DriveConfig())
        assert (found is not None) is shown


def test_a_command_counts_for_half_a_second() -> None:
    exact = stepped(20.0, 0.4)
    thin = structs.replace(exact, commands_t=exact.commands_t[::25], commands=exact.commands[::25])
    assert response_time([thin], DriveConfig()) == pytest.approx(0.4, rel=0.06)

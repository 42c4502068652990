"""A viewer's parameters are exactly the live settings.

Their values are updated while a viewer is subscribed.
"""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, cast

import pytest
from foxglove import Parameter
from foxglove.websocket import Client as Viewer

from acsard.client import Client
from acsard.core.config.live import LIVE
from acsard.core.config.parsing import effective
from acsard.core.config.settings import Config
from acsard.core.messages.schema import ServiceReply
from acsard.core.values import AcsardError
from acsard.foxglove.drives import DrivingViewers
from acsard.foxglove.notices import Notices
from acsard.foxglove.server import (
    MAX_WAITING_CHANGES,
    POLL_PERIOD_NS,
    Listener,
    Settings,
    ShownTopics,
    changes,
    live_settings,
)
from acsard.host import clock

KEY, OTHER = "rates.odom", "rates.joint_states"

NOW = live_settings(effective(Config()))


class Robot:
    """A client of a robot of which another client has changed a setting."""

    def __init__(self) -> None:
        self.asked: list[dict[str, Any]] = []
        """The changes that the daemon was asked for."""

    def set(self, wishes: dict[str, Any]) -> ServiceReply:
        self.asked.append(wishes)
        if wishes[KEY] > 100:
            raise AcsardError("no answer from the daemon")
        return ServiceReply(True, "set")

    def get(self, key: str) -> Any:
        tables: Any = effective(Config())
        tables["rates"]["odom"] = 7.0
        return tables


def of_robot(robot: Robot) -> tuple[Settings, Callable[[], list[str]]]:
    """Return the settings of a robot, and a function that returns the updates to the viewers."""
    updates = list[str]()
    notices = Notices(updates.append, lambda: None)

    def words() -> list[str]:
        server: Any = SimpleNamespace(publish_status=lambda *_: None)
        notices.send(server, lambda _: None, newcomers=False)
        return updates

    return Settings(cast(Client, robot), notices, effective(Config()), lambda: None), words


def settings_after(monkeypatch: pytest.MonkeyPatch, *calls: tuple[str, list[str]]) -> Settings:
    """Return the settings after these calls of the server, at a time at which a poll is due."""
    made, _ = of_robot(Robot())
    listener = Listener(ShownTopics(lambda: None), cast(DrivingViewers, None), made)
    for name, keys in calls:
        getattr(listener, f"on_parameters_{name}")(keys)
    later_ns = clock.mono_ns() + 2 * POLL_PERIOD_NS
    monkeypatch.setattr(clock, "mono_ns", lambda: later_ns)
    return made


def test_a_change_reaches_a_viewer_that_follows_a_parameter(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert settings_after(monkeypatch, ("subscribe", [KEY])).refresh(here=True) == {KEY: 7.0}


def test_a_change_waits_for_the_daemon_outside_the_threads_that_carry_stops() -> None:
    robot = Robot()
    made, words = of_robot(robot)
    assert made.set({KEY: 7.0}) == {KEY: NOW[KEY]}
    assert not robot.asked
    assert made.refresh(here=True) == {KEY: 7.0}
    assert robot.asked == [{KEY: 7.0}]
    assert made.refresh(here=True) == {}
    assert words() == ["set"]


def test_a_late_reply_does_not_replace_the_settings_of_a_restarted_daemon() -> None:
    robot = Robot()
    made, _ = of_robot(robot)
    reply, newest = robot.get("config"), effective(Config())
    newest["rates"]["odom"] = 3.0  # type: ignore[index]

    def restarted(key: str) -> Any:
        # The main thread reads the settings of the new daemon before the late reply arrives.
        made.learn(newest)
        return reply

    robot.get = restarted  # type: ignore[method-assign]
    made.set({KEY: 7.0})
    made.refresh(here=True)
    assert made.get([KEY]) == {KEY: 3.0}


def test_a_change_that_fails_gives_the_viewers_the_present_value_and_the_reason() -> None:
    made, words = of_robot(Robot())
    made.set({KEY: 999.0})
    assert made.refresh(here=False) == {KEY: NOW[KEY]}
    assert words() == ["not set: no answer from the daemon"]


def test_a_request_with_one_parameter_twice_changes_nothing_and_names_the_parameter() -> None:
    robot = Robot()
    made, words = of_robot(robot)
    listener = Listener(ShownTopics(lambda: None), cast(DrivingViewers, None), made)
    asked: list[tuple[str, Any]] = [(KEY, 7.0), ("log.level", "debug"), (KEY, 8.0)]
    parameters = [Parameter(name, value=value) for name, value in asked]
    answer = listener.on_set_parameters(cast(Viewer, None), parameters)
    assert {shown.name: shown.get_value() for shown in answer} == {
        name: NOW[name] for name, _ in asked
    }
    made.refresh(here=True)
    assert not robot.asked
    assert words() == [f"not set: {KEY} is in the request twice"]


def test_changes_beyond_the_limit_are_refused_with_a_reason() -> None:
    robot = Robot()
    made, words = of_robot(robot)
    for _ in range(MAX_WAITING_CHANGES + 1):
        made.set({KEY: 7.0})
    assert words() == [
        f"not set: {MAX_WAITING_CHANGES} earlier changes wait for the daemon; try again"
    ]
    for number in range(1, MAX_WAITING_CHANGES + 1):
        made.refresh(here=True)
        # Each round of the bridge makes one change, because each may wait for the daemon.
        assert len(robot.asked) == number


def test_the_end_of_one_subscription_does_not_end_the_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made = settings_after(
        monkeypatch, ("subscribe", [KEY]), ("subscribe", [OTHER]), ("unsubscribe", [OTHER])
    )
    assert made.refresh(here=True) == {KEY: 7.0}


def test_without_a_follower_the_robot_is_not_queried(monkeypatch: pytest.MonkeyPatch) -> None:
    made = settings_after(
        monkeypatch, ("subscribe", [KEY, OTHER]), ("unsubscribe", [OTHER]), ("unsubscribe", [KEY])
    )
    assert made.refresh(here=True) == {}


def test_the_parameters_are_exactly_the_settings_that_may_be_set() -> None:
    single = {key for key in LIVE if "*" not in key}
    timeouts = {
        f"commands.sources.{name}.timeout"
        for name in ("teleop", "app", "dock", "nav", "ros2_control")
    }
    assert set(NOW) == single | timeouts


def test_parameter_values_have_only_types_of_the_protocol() -> None:
    assert {type(value) for value in NOW.values()} <= {float, int, str, bool, list}


@pytest.mark.parametrize(
    ("names", "parameters"),
    [
        ([], set(NOW)),
        (["rates.odom"], {"rates.odom"}),
        (["rates.odom", "no.such"], {"rates.odom"}),
    ],
)
def test_a_request_gets_the_named_parameters_or_all(names: list[str], parameters: set[str]) -> None:
    settings, _ = of_robot(Robot())
    assert set(settings.get(names)) == parameters


def test_changes_are_only_settings_with_another_value() -> None:
    later = NOW | {"rates.odom": 50.0, "log.level": "debug"}
    assert changes(NOW, later) == {"rates.odom": 50.0, "log.level": "debug"}
    assert changes(later, later) == {}
    assert changes({}, later) == later

"""A viewer's parameters are exactly the live settings."""

from __future__ import annotations

import pytest

from acsard.core.config.live import LIVE
from acsard.core.config.parsing import effective
from acsard.core.config.settings import Config
from acsard.foxglove.parameters import asked, news, values

NOW = values(effective(Config()))


def test_they_are_the_settings_that_may_be_set_and_no_others() -> None:
    single = {key for key in LIVE if "*" not in key}
    timeouts = {
        f"commands.sources.{name}.timeout" for name in ("teleop", "app", "nav", "ros2_control")
    }
    assert set(NOW) == single | timeouts


def test_lists_are_lists_as_the_protocol_wants_them() -> None:
    assert {type(value) for value in NOW.values()} <= {float, int, str, bool, list}


@pytest.mark.parametrize(
    ("names", "found"),
    [
        ([], set(NOW)),
        (["rates.odom"], {"rates.odom"}),
        (["rates.odom", "no.such"], {"rates.odom"}),
    ],
)
def test_who_names_none_gets_all(names: list[str], found: set[str]) -> None:
    assert set(asked(NOW, names)) == found


def test_news_are_what_has_another_value() -> None:
    later = NOW | {"rates.odom": 50.0, "log.level": "debug"}
    assert news(NOW, later) == {"rates.odom": 50.0, "log.level": "debug"}
    assert news(later, later) == {}
    assert news({}, later) == later

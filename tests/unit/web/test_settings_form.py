"""The page can set exactly the keys that `srv/set` accepts, with their ranges."""

from __future__ import annotations

from acsard.core.config.live import LIVE
from acsard.core.config.parsing import effective
from acsard.core.config.settings import Config
from acsard.web.settings_form import rows

ROWS = {row.key: row for row in rows(effective(Config()))}


def test_each_setting_that_may_change_has_a_row_and_no_other() -> None:
    sources = {f"commands.sources.{one.name}.timeout" for one in Config().commands.sources}
    assert set(ROWS) == (set(LIVE) - {"commands.sources.*.timeout"}) | sources


def test_a_row_has_its_value_its_range_and_when_it_may_change() -> None:
    row = ROWS["limits.linear_speed"]
    assert row.value == Config().limits.linear_speed
    assert isinstance(row.low, float)
    assert isinstance(row.high, float)
    assert row.low <= row.value <= row.high
    assert row.when == "at any time"
    assert "stands" in ROWS["limits.wheel_speed"].when


def test_what_is_one_of_some_words_names_them() -> None:
    row = ROWS["log.level"]
    assert isinstance(row.choices, list)
    assert row.value in row.choices
    assert len(row.choices) > 2

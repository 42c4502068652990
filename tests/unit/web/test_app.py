"""The page's server lists the settings, and keeps its clients while it is short of threads."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest
from aiohttp import web
from aiohttp.test_utils import make_mocked_request
from msgspec.structs import replace

from acsard.core.config.live import LIVE
from acsard.core.config.parsing import effective
from acsard.core.config.settings import Config
from acsard.core.values import NS_PER_S
from acsard.host import clock
from acsard.host.threads import NoThreadError
from acsard.web import app
from acsard.web.acceptor import Acceptor
from acsard.web.admission import IDENTITY_KEY
from acsard.web.app import Page, settings_in
from acsard.web.camera import Camera
from acsard.web.guide import Guide, Reach
from acsard.web.metrics import Counts
from acsard.web.tokens import Vault
from acsard.web.viewer import Parts
from tests.each import each
from tests.unit.web.test_callers import MAINTAINER
from tests.unit.web.test_fleet_rows import robots


def fails(error: Exception) -> Callable[..., Awaitable[Any]]:
    async def in_thread(*_: object) -> None:
        raise error

    return in_thread


class Phone:
    """A viewer with a token."""

    who = replace(MAINTAINER, token="lent")

    def __init__(self, ends: list[str]) -> None:
        self.end = ends.append


@each("error", [NoThreadError("no thread"), TimeoutError()])
async def test_a_phone_stays_if_no_thread_can_read_the_tokens_and_leaves_if_the_disk_hangs(
    error: Exception, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    counts, ends = Counts(), list[str]()
    parts = Parts(robots(None), Guide(Reach("", "", "", ""), ""), counts)
    page = Page(parts, Vault(tmp_path, "acsar"), frozenset(), Acceptor(counts))
    page._viewers.add(Phone(ends))  # type: ignore[arg-type]
    monkeypatch.setattr(app, "in_thread", fails(error))
    await page.tidy()
    assert bool(ends) != isinstance(error, NoThreadError)


async def test_the_age_of_a_picture_counts_a_suspend(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The monotonic clock stands still in a suspend."""
    counts, headers = Counts(), dict[str, str]()
    parts = Parts(robots(None), Guide(Reach("", "", "", ""), ""), counts)
    page = Page(parts, Vault(tmp_path, "acsar"), frozenset(), Acceptor(counts))
    page._camera = Camera("http://127.0.0.1:1/")

    async def sent(request: web.Request, body: bytes, told: dict[str, str], *_: object) -> None:
        headers.update(told)

    monkeypatch.setattr(app, "sent_in_pieces", sent)
    page._camera._take(b"picture")
    slept_ns = clock.asleep_ns() + 3600 * NS_PER_S
    monkeypatch.setattr(clock, "asleep_ns", lambda: slept_ns)
    request = make_mocked_request("GET", "/api/camera")
    request[IDENTITY_KEY] = MAINTAINER
    await page.picture(request)
    page._camera.close()
    assert int(headers["Age-Ms"]) >= 3_600_000
    assert int(headers["Waited-Ms"]) < 60_000


ROWS = {row.key: row for row in settings_in(effective(Config()))}


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


def test_a_setting_with_fixed_choices_lists_them() -> None:
    row = ROWS["log.level"]
    assert isinstance(row.choices, list)
    assert row.value in row.choices
    assert len(row.choices) > 2

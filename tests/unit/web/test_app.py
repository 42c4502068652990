"""The page's server keeps its clients while the machine is short of threads."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from acsard.host.threads import NoThreadError
from acsard.web import app
from acsard.web.acceptor import Acceptor
from acsard.web.app import Page
from acsard.web.callers import MAINTAINER
from acsard.web.calls import Calls
from acsard.web.commands import Hand
from acsard.web.counts import Counts
from acsard.web.fleet import Fleet
from acsard.web.guide import Guide
from acsard.web.jobs import Reach
from acsard.web.tokens import Vault
from tests.each import each
from tests.unit.web.test_fleet import robots


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
def test_a_phone_stays_if_no_thread_can_read_the_tokens_and_leaves_if_the_disk_hangs(
    error: Exception, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def story() -> list[str]:
        counts, ours, ends = Counts(), robots(None), list[str]()
        page = Page(
            ours, Hand(lambda: None, counts), Calls(ours), Fleet(ours), counts,
            Vault(tmp_path, "acsar"), frozenset(), Acceptor(counts),
            Guide(Reach("", "", "", ""), ""),
        )  # fmt: skip
        page._viewers.add(Phone(ends))  # type: ignore[arg-type]
        monkeypatch.setattr(app, "in_thread", fails(error))
        await page.tidy()
        return ends

    assert bool(asyncio.run(story())) != isinstance(error, NoThreadError)

"""Tests of the calls that the parts of the daemon receive when it ends."""

from __future__ import annotations

import asyncio
from contextlib import AsyncExitStack
from pathlib import Path

import pytest
from msgspec.structs import replace

from acsard.core.config.settings import Config, RecordConfig
from acsard.daemon.daemon import _recorder
from acsard.recording import recorder
from acsard.recording.end_record import read_end
from tests.scenarios.world import World


@pytest.mark.parametrize(
    ("error", "cut"),
    [
        (ExceptionGroup("of tasks", [ValueError("a fault of our own")]), "bug"),
        (asyncio.CancelledError(), ""),
    ],
)
def test_the_recording_ends_with_the_error_of_the_daemon_and_the_error_is_raised(
    error: BaseException, cut: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder, "CLOSE_S", 20.0)
    config = replace(Config(), record=RecordConfig(str(tmp_path)))

    async def run() -> None:
        async with AsyncExitStack() as stack:
            World(config, recorder=_recorder(config, lambda event: None, 0, stack)).run(0.5)
            raise error

    with pytest.raises(type(error)) as raised:
        asyncio.run(run())
    assert cut == "" or raised.value is error
    last = read_end(next(tmp_path.glob("*.mcap")))
    assert last is not None
    assert (last.cut, last.why) == (cut, "ValueError: a fault of our own" if cut else "")

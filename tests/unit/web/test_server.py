"""The page's server reads tokens and certificates again each second, in one thread.

A disk that hangs delays none of its requests.
"""

from __future__ import annotations

import asyncio
import io
import os
from concurrent.futures import Future
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from acsard.bus import certificate_watch
from acsard.bus.tls import KEY
from acsard.core.config.settings import LogConfig
from acsard.host.logs import Log
from acsard.machine.authority import Authority
from acsard.web import server
from acsard.web.metrics import Counts
from acsard.web.server import Certificate
from acsard.web.tokens import ReadTokens, Vault
from tests.unit.web.hanging_disk import ROUNDS_S, threads_named


async def test_one_thread_waits_for_a_hanging_disk_and_then_everything_is_read_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server, "TICK_S", 0.01)
    monkeypatch.setattr(certificate_watch, "FILES_CHECK_PERIOD_NS", 0)
    authority, key = Authority.make(tmp_path, "test", 10), tmp_path / KEY
    authority.issue(tmp_path, "robot", ["192.168.0.1"], 10)
    log, vault = Log(LogConfig(), io.StringIO()), Vault(tmp_path / "state", "acsar")
    text, _ = vault.invite("viewer", "tv", 1)
    tokens, certificate = ReadTokens(vault), Certificate(str(tmp_path), log)
    before = certificate.context
    reading = asyncio.create_task(server._read_disk(tokens, certificate))
    try:
        await tokens.next_reading()
        assert tokens.owner([text]) is not None
        # A read of a named pipe blocks until another program has written to the pipe.
        key.unlink()
        os.mkfifo(key)
        await asyncio.sleep(ROUNDS_S)
        assert threads_named("read") == 1
        assert tokens.owner([text]) is not None
        vault.revoke("tv")
        hanging = os.open(key, os.O_WRONLY)
        key.unlink()
        authority.issue(tmp_path, "robot", ["192.168.0.2"], 10)
        os.close(hanging)
        async with asyncio.timeout(20.0):
            while "192.168.0.2" not in certificate.names or tokens.owner([text]):
                await asyncio.sleep(0.01)
        assert certificate.context is not before
    finally:
        reading.cancel()
        log.close()


async def test_the_connections_of_a_revoked_token_end_with_the_reading_that_misses_it(
    tmp_path: Path,
) -> None:
    log, vault = Log(LogConfig(), io.StringIO()), Vault(tmp_path, "acsar")
    text, _ = vault.invite("viewer", "tv", 1)
    tokens, valid = ReadTokens(vault), list[bool]()
    page: Any = SimpleNamespace(tidy=lambda: valid.append(tokens.owner([text]) is not None))
    ticking = asyncio.create_task(server._tick(page, tokens, Counts(), log))
    try:
        await asyncio.sleep(0)
        for revokes in (False, True):
            if revokes:
                vault.revoke("tv")
            tokens.read()
            tokens.announce()
            await asyncio.sleep(0.01)
        assert valid == [True, False]
    finally:
        ticking.cancel()
        log.close()


async def test_an_error_of_the_outbox_is_reported_even_after_its_future_was_waited_for() -> None:
    """The end of the server must not cancel the future that reports the error."""
    outbox: Any = SimpleNamespace(dead=Future())
    await server.first_ended([asyncio.sleep(0)], outbox)
    assert not outbox.dead.cancelled()
    outbox.dead.set_exception(MemoryError("no room"))
    with pytest.raises(MemoryError):
        await server.first_ended([asyncio.sleep(60)], outbox)

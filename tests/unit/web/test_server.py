"""The page's server loads renewed certificates.

While the disk hangs, it starts only one thread for this.
"""

from __future__ import annotations

import asyncio
import io
import os
import ssl
from pathlib import Path

import pytest

from acsard.bus import certificate_watch
from acsard.bus.certificate_watch import CertificateFiles
from acsard.bus.tls import KEY, files_in
from acsard.core.config.settings import LogConfig
from acsard.host.logs import Log
from acsard.machine.authority import Authority
from acsard.web import server
from tests.unit.web.hanging_disk import ROUNDS_S, threads_named


async def test_one_thread_waits_for_a_hanging_disk_and_then_the_new_certificate_is_loaded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server, "TIDY_S", 0.01)
    monkeypatch.setattr(certificate_watch, "FILES_CHECK_PERIOD_NS", 0)
    authority, key, names = Authority.make(tmp_path, "test", 10), tmp_path / KEY, set[str]()
    authority.issue(tmp_path, "robot", ["192.168.0.1"], 10)
    files, log = CertificateFiles(*files_in(str(tmp_path))), Log(LogConfig(), io.StringIO())
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    renewing = asyncio.create_task(server._renew(context, names, files, str(tmp_path), log))
    try:
        # A read of a named pipe blocks until another program has written to the pipe.
        key.unlink()
        os.mkfifo(key)
        await asyncio.sleep(ROUNDS_S)
        assert threads_named("renewed") == 1
        hanging = os.open(key, os.O_WRONLY)
        key.unlink()
        authority.issue(tmp_path, "robot", ["192.168.0.2"], 10)
        os.close(hanging)
        async with asyncio.timeout(20.0):
            while "192.168.0.2" not in names:
                await asyncio.sleep(0.01)
    finally:
        renewing.cancel()
        log.close()

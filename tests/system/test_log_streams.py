"""The daemon drives on, whatever happens to its standard streams."""

from __future__ import annotations

import fcntl
import os
import signal
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import pytest

from tests.system.harness import ZERO_LINE, Bus, Daemon, Peer, alive_at, environment, until


def opened(streams: str, stack: ExitStack) -> dict[str, Any]:
    """Return what the daemon's streams are: closed, without a reader, on a full disk, blocked."""
    if streams == "closed":
        return {"shell": "<&- >&- 2>&-"}
    reader, writer = os.pipe() if streams != "full" else (-1, os.open("/dev/full", os.O_WRONLY))
    stack.callback(os.close, writer)
    if streams == "readerless":
        os.close(reader)
    if streams == "blocked":
        stack.callback(os.close, reader)
        fcntl.fcntl(writer, fcntl.F_SETPIPE_SZ, 4096)
        os.set_blocking(writer, False)
        with suppress(BlockingIOError):
            while True:
                os.write(writer, b".")
        os.set_blocking(writer, True)
    # Run it as a user starts it, with buffered streams.
    buffered = {k: v for k, v in environment().items() if k != "PYTHONUNBUFFERED"}
    return {"stdout": writer, "stderr": writer, "env": buffered}


@pytest.mark.slow
@pytest.mark.parametrize(
    "streams",
    ["closed", "blocked"]
    + [pytest.param(name, marks=pytest.mark.nightly) for name in ("readerless", "full")],
)
def test_control_goes_on_and_ends_well_when_no_stream_can_be_written(
    tmp_path: Path, peer: Peer, streams: str
) -> None:
    with ExitStack() as stack:
        how = opened(streams, stack)
        daemon = stack.enter_context(Daemon(tmp_path, peer.path, ready=False, **how))
        alive = stack.enter_context(alive_at(daemon.endpoint, daemon))
        until(alive.try_recv, 5.0, "the alive token")
        bus = stack.enter_context(Bus(daemon.endpoint))
        bus.linked()
        with bus.commanding(0.5):
            until(lambda: peer.lines[-1].line.startswith(b"ap10.00"), 5.0, "steady driving")
        daemon.signal(signal.SIGTERM)
        assert daemon.ended(5.0) == 0
    assert peer.last_line() == ZERO_LINE
    # The motors received only lines of four wheels, whichever descriptor the streams have.
    assert {len(line) for line in peer.session.raw_lines()[1:]} == {33}

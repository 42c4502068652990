"""The daemon drives on, whatever happens to its standard streams."""

from __future__ import annotations

import os
import signal
from contextlib import ExitStack
from pathlib import Path

import pytest

from tests.system.harness import ZERO_LINE, Bus, Daemon, Peer, alive_at, until


@pytest.mark.slow
@pytest.mark.parametrize("streams", ["closed", "readerless", "full"])
def test_control_goes_on_when_no_stream_can_be_written(
    tmp_path: Path, peer: Peer, streams: str
) -> None:
    with ExitStack() as stack:
        how: dict[str, object] = {"shell": "<&- >&- 2>&-"}
        if streams != "closed":
            reader, file = os.pipe() if streams == "readerless" else (-1, os.open("/dev/full", 1))
            stack.callback(os.close, file)
            how = {"stdout": file, "stderr": file}
            if reader >= 0:
                os.close(reader)
        daemon = stack.enter_context(Daemon(tmp_path, peer.path, ready=False, **how))  # type: ignore[arg-type]
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

"""The daemon drives on, whatever happens to its standard streams."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest

from tests.system.harness import ZERO_LINE, Bus, Daemon, Peer, alive_at, until


@contextmanager
def readerless_pipe() -> Iterator[int]:
    """Provide a pipe whose reading end is closed."""
    reader, writer = os.pipe()
    os.close(reader)
    yield writer
    os.close(writer)


@contextmanager
def full_disk() -> Iterator[int]:
    """A file on a disk without room."""
    file = os.open("/dev/full", os.O_WRONLY)
    yield file
    os.close(file)


def slow(value: str) -> object:
    """Mark this value as slow, because another test tries all three standard streams at once."""
    return pytest.param(value, marks=pytest.mark.slow)


STREAMS = {"readerless pipe": readerless_pipe, "full disk": full_disk}


@pytest.mark.slow
@pytest.mark.parametrize("stream", ["readerless pipe", slow("full disk")])
@pytest.mark.parametrize("which", [slow("stdout"), slow("stderr"), "both"])
def test_control_goes_on_when_output_cannot_be_written(
    tmp_path: Path, peer: Peer, stream: str, which: str
) -> None:
    names = ("stdout", "stderr") if which == "both" else (which,)
    with ExitStack() as stack:
        how: dict[str, Any] = {name: stack.enter_context(STREAMS[stream]()) for name in names}
        daemon = stack.enter_context(Daemon(tmp_path, peer.path, ready=False, **how))
        drives_and_leaves(daemon, peer)


@pytest.mark.slow
@pytest.mark.parametrize(
    "redirection", [slow(">&-"), slow("2>&-"), slow(">&- 2>&-"), "<&- >&- 2>&-"]
)
def test_control_goes_on_when_a_stream_was_closed_before_the_start(
    tmp_path: Path, peer: Peer, redirection: str
) -> None:
    with Daemon(tmp_path, peer.path, ready=False, shell=redirection) as daemon:
        drives_and_leaves(daemon, peer)


def drives_and_leaves(daemon: Daemon, peer: Peer) -> None:
    """Check that the robot drives, and that SIGTERM ends the daemon with a zero line and exit 0."""
    with alive_at(daemon.endpoint, daemon) as alive:
        until(alive.try_recv, 5.0, "the alive token")
    with Bus(daemon.endpoint) as bus:
        bus.linked()
        with bus.commanding(0.5):
            until(lambda: peer.lines[-1].line.startswith(b"ap10.00"), 5.0, "steady driving")
        daemon.signal(signal.SIGTERM)
        assert daemon.ended(5.0) == 0
    assert peer.last_line() == ZERO_LINE
    # The motors received only lines of four wheels, whichever descriptor the streams have.
    assert {len(line) for line in peer.session.raw_lines()[1:]} == {33}

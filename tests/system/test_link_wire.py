"""An independent serial peer checks the bytes that the daemon sends."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.system.harness import (
    STANDING,
    Bus,
    Daemon,
    Peer,
    Tables,
    until,
    wheels,
)


@pytest.mark.slow
def test_a_trailing_comma_and_wired_signs_and_letters_apply_on_the_wire(
    tmp_path: Path, peer: Peer
) -> None:
    config: Tables = {
        "mcu": {"port": str(peer.path), "trailing_comma": True},
        "mcu.wheels": {
            "front_right": "-b", "front_left": "+a", "rear_left": "+c", "rear_right": "+d",
        },
    }  # fmt: skip
    with (
        Daemon(tmp_path, peer.path, config) as daemon,
        Bus(daemon.endpoint) as bus,
        bus.commanding(0.5),
    ):
        steady = b"ap10.00,bn10.00,cp10.00,dp10.00,\r\n"
        until(lambda: peer.lines[-1].line == steady, 5.0, f"{steady!r} on the wire")
        until(lambda: bus.state()["linear"] == pytest.approx(0.5), 5.0, "0.5 m/s measured")
    first, *lines = peer.session.raw_lines()
    assert first == b"\r\n"
    assert wheels(lines[0]) == STANDING
    assert {(line[-3:], len(line)) for line in lines} == {(b",\r\n", 34)}

"""A serial line that echoes, alone or beside a board, is found and never driven."""

from __future__ import annotations

from contextlib import nullcontext

import pytest
from msgspec.structs import replace

from acsard.core.config.settings import (
    Config,
    LimitsConfig,
    McuConfig,
)
from acsard.core.simulator.fake_mcu import FakeMcu
from tests.scenarios.world import World

MS = 1_000_000
ZERO = b"ap00.00,bp00.00,cp00.00,dp00.00"


def config(check: str = "on", counts: int = 0, **mcu: object) -> Config:
    return Config(mcu=McuConfig(link_check=check, encoder_counts=counts, **mcu))  # type: ignore[arg-type]


def moving(lines: list[bytes]) -> list[bytes]:
    return [line for line in lines if line.strip() and not line.startswith((ZERO, b"?"))]


class Echo(FakeMcu):
    """A port without a microcontroller, which returns all bytes after 5 ms and `extra_delay_ns`."""

    def receive(self, now_ns: int, data: bytes) -> None:
        self._schedule(now_ns + 5 * MS + self.extra_delay_ns, "sent", data)


@pytest.mark.variations(3)
@pytest.mark.parametrize(("check", "counts"), [("off", 0), ("on", 0), ("on", 3200)])
@pytest.mark.parametrize(
    ("delay_ms", "latency_ms"),
    [pytest.param(0, 0, id="prompt"), pytest.param(0, 16, id="adapter"),
     pytest.param(30, 0, id="radio"), pytest.param(60, 0, id="slow radio")],
)  # fmt: skip
def test_a_serial_line_that_echoes_is_never_driven(
    check: str, counts: int, delay_ms: int, latency_ms: int
) -> None:
    world = World(config(check, counts), plugged=False)
    echo = Echo(world.config, world.now_ns)
    echo.extra_delay_ns, echo.latency_ns = delay_ms * MS, latency_ms * MS
    world.port.plug(echo)
    world.run(0.3)
    world.drive(0.5, seconds=5.0)
    assert world.state.link == "booting"
    assert world.state.code == "echo"
    assert moving([line for _, line in world.port.sent]) == []
    (event,) = [event for event in world.events if event.name == "link_check"]
    assert (event.level, event.text) == ("error", world.state.reason)
    world.port.unplug()
    world.run(0.1)
    world.port.plug(FakeMcu(world.config, world.now_ns))
    world.drive(0.5, seconds=1.0)
    assert world.state.mode == "driving"


class HalfDuplex(FakeMcu):
    """A board behind an adapter that also returns every line of the daemon to the daemon."""

    def receive(self, now_ns: int, data: bytes) -> None:
        super().receive(now_ns, data)
        self._schedule(self._in_free_ns, "sent", data)


@pytest.mark.parametrize(
    ("period", "latency_ms"),
    [pytest.param(0.0, 0, id="answers"), pytest.param(0.0, 16, id="answers by an adapter"),
     pytest.param(0.1, 0, id="reports at 10 Hz"), pytest.param(0.01, 0, id="reports at 100 Hz"),
     pytest.param(0.1, 16, id="reports at 10 Hz by an adapter")],
)  # fmt: skip
def test_an_echo_beside_a_board_is_never_driven(period: float, latency_ms: int) -> None:
    world = World(Config(mcu=McuConfig(reply_period=period)), plugged=False)
    board = HalfDuplex(world.config, world.now_ns)
    board.latency_ns = latency_ms * MS
    world.port.plug(board)
    with board.free_running(period) if period else nullcontext():
        world.run(0.5)
        world.drive(0.5, seconds=2.0)
        assert (world.state.link, world.state.code) == ("booting", "echo")
        assert moving([line for _, line in world.port.sent]) == []


@pytest.mark.variations(4)
@pytest.mark.parametrize("kind", [Echo, HalfDuplex])
@pytest.mark.parametrize("acceleration", [1.0, 100.0])
@pytest.mark.parametrize(("check", "counts"), [("off", 0), ("on", 0), ("on", 3200)])
def test_an_echo_that_begins_during_a_drive_ends_the_link_when_the_speed_changes(
    check: str, counts: int, acceleration: float, kind: type[FakeMcu]
) -> None:
    limits = replace(LimitsConfig(), linear_acceleration=acceleration)
    world = World(replace(config(check, counts), limits=limits))
    world.run(0.5)
    world.drive(0.5, seconds=1.0)
    assert world.state.mode == "driving"
    world.mcu.__class__ = kind  # TX now touches RX
    world.drive(-0.5, seconds=1.2)
    assert world.state.link != "up"
    assert world.state.code == "echo"
    sent = len(world.port.sent)
    world.drive(0.5, seconds=10.0)
    assert world.state.code == "echo"
    assert moving([line for _, line in list(world.port.sent)[sent:]]) == []

"""The program of the page "My IMU", as written, with a simulated chip."""

from __future__ import annotations

import fcntl
import math
import random
import struct
import threading
from pathlib import Path
from typing import Any

import pytest

from acsard.client import connect
from tests.pages import blocks
from tests.system.harness import Bus, Daemon, Following, Program, acsard, until

PAGE = "deploy/manual/pages/howto/my-imu.md"

COUNTS = 65.5 * 180 / math.pi  # of a rad/s, at a range of 500 degrees/s


class Chip:
    """An MPU-6050 on a robot: registers behind an I2C bus, with noise and a bias of a degree/s."""

    def __init__(self) -> None:
        self.registers = {0x6B: 0x40, 0x1A: 0, 0x1B: 0}
        self.address, self.broken, self._pointer = 0, False, 0
        self.wheels: Following | None = None  # the robot turns as these say

    def write(self, data: bytes) -> None:
        self._pointer = data[0]
        self.registers.update(enumerate(data[1:], data[0]))

    def read(self, size: int) -> bytes:
        if self.broken or self.address != 0x68:
            raise OSError(121, "Remote I/O error")
        assert (self._pointer, size) == (0x47, 2)
        assert self.registers == {0x6B: 1, 0x1A: 3, 0x1B: 8}, "awake, 42 Hz, 500 degrees/s"
        rate = 0.0
        if self.wheels and self.wheels.seen:
            right, left = self.wheels.seen[-1].value["velocity"][:2]
            rate = (right - left) * 0.05 / 0.3
        return struct.pack(">h", round(rate * COUNTS + 65 + random.gauss(0.0, 3.0)))


@pytest.fixture
def chip(monkeypatch: pytest.MonkeyPatch) -> Chip:
    chip = Chip()
    monkeypatch.setattr(
        fcntl,
        "ioctl",
        lambda _, request, value: vars(chip).update(address=value * (request == 0x703)),
    )
    return chip


@pytest.mark.slow
def test_the_program_of_the_page_gives_the_heading(tmp_path: Path, chip: Chip) -> None:
    (program,) = [block for block in blocks("python") if block.page == PAGE]
    assert len(program.text.splitlines()) <= 30
    ended: list[OSError] = []

    def run(endpoint: str) -> None:
        text = program.text.replace("tcp/127.0.0.1:7448", endpoint)
        names: dict[str, Any] = {
            "open": lambda path, *_, **__: chip if path == "/dev/i2c-1" else None
        }
        try:
            exec(compile(text, "imu.py", "exec"), names)
        except OSError as error:
            ended.append(error)

    with Program(acsard("sim", "--link", "mcu"), tmp_path) as sim:
        sim.says("acsard run --port")
        with (
            Daemon(tmp_path, "mcu", {"odometry": {"gyro": True}}) as daemon,
            Bus(daemon.endpoint) as bus,
        ):
            bus.linked()
            thread = threading.Thread(target=run, args=(daemon.endpoint,), daemon=True)
            thread.start()
            until(lambda: bus.state()["gyro"] == "waiting for turn", 15.0, "the bias is learned")
            with connect(daemon.endpoint) as robot, bus.follow("wheel_states") as chip.wheels:
                robot.turn(180)
                until(lambda: bus.state()["gyro"] == "used", 5.0, "the gyro is used")
            chip.broken = True
            until(lambda: bus.state()["gyro"] == "silent", 5.0, "the heading is the wheels' again")
            thread.join(5.0)
    assert [error.errno for error in ended] == [121]

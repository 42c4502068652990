"""Habits of firmware that the simulated board does not have."""

from __future__ import annotations

from acsard.core.simulator.fake_mcu import FakeMcu


def turn_encoders(mcu: FakeMcu, angles: list[float]) -> None:
    """Let the wheels stand at these angles, so that their counts do not change together."""
    mcu.vehicle.angles[:] = angles
    mcu._window = (mcu._window[0], mcu._encoders())


def reports_its_last_instant(mcu: FakeMcu) -> None:
    """Let the board report the speeds of now, as firmware with windows of 10 ms does."""

    def speeds(now_ns: int) -> list[float]:
        return [sign * mcu.vehicle.speeds[motors[0]] for motors, sign in mcu._wiring]

    mcu._speeds = speeds  # type: ignore[method-assign]


def blocks(mcu: FakeMcu, every_s: float, block_s: float) -> None:
    """Let the firmware block, and then answer all lines that wait in its buffer."""
    act, every_ns, block_ns = mcu._act, int(every_s * 1e9), int(block_s * 1e9)

    def acts(now_ns: int, line: bytes) -> None:
        free_ns = now_ns // every_ns * every_ns + block_ns
        if now_ns < free_ns:
            mcu._schedule(free_ns, "act", line)
        else:
            act(now_ns, line)

    mcu._act = acts  # type: ignore[method-assign]

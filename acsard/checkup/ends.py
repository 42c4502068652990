"""What ends a check early: each end says what was seen, what it means and what to look at."""

from __future__ import annotations

from collections.abc import Sequence

from acsard.checkup.findings import LETTERS, Finding, StoppedError, motor_name
from acsard.config.settings import McuConfig


def runaway(mcu: McuConfig, motor: int, asked: float, speed: float, most: float) -> StoppedError:
    """A motor is faster than `most` rad/s, which is more than any is ever asked."""
    text = f"the encoder of {motor_name(mcu, motor)} says more than {most:g} rad/s"
    mend = "counts per turn in the firmware too low, or its control loop unstable"
    if asked * speed < 0:
        text += ", against the command: the firmware's control loop drives it away"
        mend = "swap this motor's two leads, or A and B of its encoder"
    figure = f"{LETTERS[motor]}: told {asked:.1f}, seen {speed:.1f} rad/s"
    return StoppedError(Finding("runaway", "FAIL", figure, text, mend))


def stays_turning(mcu: McuConfig, turning: Sequence[int], seconds: float) -> StoppedError:
    """Zeros of either form do not stop these motors."""
    names = ", ".join(motor_name(mcu, motor) for motor in turning) or "something"
    text = f"{names} turns on, by its encoder, whatever zeros are sent"
    mend = "cut the motors' power; does the firmware take `p00.00` for a stop?"
    return StoppedError(Finding("stop", "FAIL", f"turns {seconds:g} s after zeros", text, mend))


def silent(mcu: McuConfig, asked: Sequence[int], seconds: float) -> StoppedError:
    """The MCU has fallen silent: nobody would see a runaway."""
    names = " and ".join(motor_name(mcu, motor) for motor in asked) or "nothing"
    text = f"the microcontroller fell silent while {names} was to turn"
    mend = "does its supply dip when a motor starts, and it restarts? a loose cable?"
    return StoppedError(Finding("link", "FAIL", f"silent for {seconds:.1f} s", text, mend))

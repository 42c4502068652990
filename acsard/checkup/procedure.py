"""The check from the first zero to the last: the order of the steps, and how it ends early."""

from __future__ import annotations

from collections.abc import Callable

from acsard.checkup import counts, damage, dialect, watchdog
from acsard.checkup.bench import Bench
from acsard.checkup.findings import Finding, StoppedError, WireLostError
from acsard.checkup.outside import Operator, Wire
from acsard.checkup.turning import channels, comma_needed
from acsard.checkup.wheels import Channel, encoder_finding, wheel_map
from acsard.config.settings import Config

LIFTED = "lifted"

CONFIRM = (
    "The wheels will turn one by one, then together. They are told 3 rad/s at the most, but a "
    "wheel whose encoder is dead or reversed can reach full speed, for a second or so. Lift the "
    "robot so that none touches anything, keep a hand on the power switch, then type "
    f'"{LIFTED}":'
)

STEPS = (
    "baud rate", "identification", "reply form", "reply rate", "round trip", "checked link",
    "motors", "trailing comma", "wheel map", "encoder counts", "watchdog", "damaged lines",
)  # fmt: skip
"""In this order; what the check does not come to is said to be skipped."""

Tell = Callable[[Finding], None]


def run(wire: Wire, operator: Operator, config: Config, tell: Tell) -> None:
    """Check one microcontroller and `tell` each finding as it is made.

    Nothing but zeros goes out before the operator has confirmed that the wheels are lifted.
    Whatever happens, the last lines are zeros in both forms, then silence: the wire is closed.
    """
    told: list[str] = []

    def also(finding: Finding) -> None:
        told.append("motors" if finding.name.startswith("motor ") else finding.name)
        tell(finding)

    try:
        with Bench(wire, config.mcu, config.rate_hz) as bench:
            bench.open(config.mcu.baud_rate)
            bench.zeros()
            if operator.ask(CONFIRM, (LIFTED,)) != LIFTED:
                raise StoppedError(Finding("wheels", "FAIL", "", "not confirmed to be lifted"))
            _steps(bench, operator, also)
    except StoppedError as end:
        also(end.finding)
        why = f"the check ended early: {end.finding.name}"
    except WireLostError as lost:
        also(Finding("serial line", "FAIL", "lost", str(lost), "a loose plug? `dmesg | tail`"))
        why = "the check ended early: the serial line was lost"
    else:
        return
    for step in STEPS:
        if step not in told:
            tell(Finding(step, "SKIPPED", "", why))


def _steps(bench: Bench, operator: Operator, tell: Tell) -> None:
    tell(dialect.baud(bench))
    tell(dialect.identity(bench))
    for finding in dialect.pace(bench):
        tell(finding)
    refused = dialect.comma(bench)
    if refused is not None:
        tell(refused)
    tell(dialect.forms(bench))
    tell(dialect.check(bench))
    found, right = _motors(bench, operator, tell, comma_told=refused is not None)
    tell(wheel_map(bench.mcu, found))
    tell(counts.finding(bench, right))
    operator.say("the motors turn together, then the host falls silent, several times perhaps")
    tell(watchdog.finding(bench, right))
    operator.say("broken lines go out; nothing may turn")
    tell(damage.finding(bench, right))


def _motors(
    bench: Bench, operator: Operator, tell: Tell, comma_told: bool
) -> tuple[list[Channel], list[int]]:
    """What each motor did, and those whose encoder shows what they were told."""
    if bench.rest() == "comma":
        comma_told = True
        tell(comma_needed(bench))
    bench.armed = True
    found = []
    for channel, comma in channels(bench, operator):
        found.append(channel)
        tell(encoder_finding(bench.mcu, channel))
        if comma is not None and not comma_told:
            tell(comma)
    return found, [channel.motor for channel in found if channel.kind == "right"]

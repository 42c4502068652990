"""The inputs that the board reports in its status lines: emergency stop, bumpers and battery."""

from __future__ import annotations

from msgspec import Struct

from acsard.core.codes import Code, Reason
from acsard.core.config.settings import Config, SafetyConfig
from acsard.core.link.session import McuSession
from acsard.core.motion.battery import BatteryInput
from acsard.core.motion.bumpers import Bumpers
from acsard.core.motion.emergency_stop import DRIVER_FAULT_REASON, EmergencyStop
from acsard.core.values import Cause, Event, Latches, Ns

# Words for "wait until the board has reported ...".
INPUT_NAMES = {
    "estop": "its emergency stop",
    "bumpers": "its bumpers",
    "driver": "its motor drivers",
}

# The input that causes a latch.
INPUT_OF: dict[Code, str] = {
    "emergency_stop": "estop",
    "emergency_stop_silent": "estop",
    "bumper": "bumpers",
    "bumpers_silent": "bumpers",
    "driver_fault": "driver",
}


class BoardInputs(Struct):
    estop: EmergencyStop
    bumpers: Bumpers
    battery: BatteryInput
    # Inputs that caused a latch in an earlier run, until the board reports them: no `clear` before.
    unreported: dict[str, Cause]

    def missing(self, safety: SafetyConfig) -> bool:
        """Return whether the robot needs an input that the board has not reported."""
        if not (safety.bumpers or safety.estop == "required"):
            return False
        return self.estop.missing(safety) or self.bumpers.missing(safety)

    def reopen(self) -> None:
        """Record that the port was opened: another board may answer from now on."""
        self.estop.reopen()
        self.bumpers.reopen()
        self.battery.reopen()

    def lend(self) -> None:
        """Record that the port is lent: the board is silent on purpose."""
        self.estop.lend()
        self.bumpers.lend()

    def expects_reports(self, session: McuSession) -> bool:
        """Return whether `process_reports` has something to do."""
        status = session.status
        if status.last_ns is None and not (status.forgot or self.unreported):
            return self.battery.known == "stop"  # the board has reported nothing
        return bool(
            status.new
            or self.estop.state
            or self.bumpers.state
            or self.battery.status
            or self.unreported
            or status.forgot
            or self.battery.known == "stop"
        )

    def process_reports(self, session: McuSession, now_ns: Ns, config: Config) -> list[Event]:
        """Process the status lines of the last update, and return the events of changes."""
        statuses, safety, up = session.status.new, config.safety, session.link == "up"
        late = session.steps.is_late
        return [
            *self.estop.process_reports(statuses, now_ns, safety, up=up, late=late),
            *self.bumpers.process_reports(statuses, now_ns, safety, up=up, late=late),
            *self.battery.process_reports(statuses, now_ns, up, config.battery),
        ]

    def forget(self, config: Config) -> None:
        """Forget the inputs that only the board before the last opening of the port reported."""
        self.estop.forget()
        self.bumpers.forget()
        self.battery.forget(config.battery)
        self.unreported = {}

    def clear_refusal(self, session: McuSession, config: Config) -> Reason | None:
        """Return why the reports forbid `clear` now, or None."""
        safety, awaited = config.safety, self._awaited_report(session, config.safety)
        if self.estop.is_pressed:
            return self.estop.why(safety)
        objection = self.bumpers.clear_refusal(safety)
        if objection is not None:
            return objection
        if session.status.last.driver_fault:
            return DRIVER_FAULT_REASON
        return self.battery.refusal(config.battery) if self.battery.refuses_clear else awaited

    def _awaited_report(self, session: McuSession, safety: SafetyConfig) -> Reason | None:
        # Until the board reports an input that caused a latch in an earlier run, `clear` is
        # refused.
        if not self.unreported:
            return None
        reported = {
            "estop": self.estop.use(safety) == "off" or bool(self.estop.state),
            "bumpers": self.bumpers.use(safety) == "off" or bool(self.bumpers.state),
            "driver": session.status.last.driver_fault is not None,
        }
        for name in [name for name in self.unreported if reported[name]]:
            del self.unreported[name]
        for name, cause in self.unreported.items():
            advice = f"wait until the board has reported {INPUT_NAMES[name]}"
            return Reason(cause.code, cause.text, advice, cause.part)
        return None


def inputs_after(latches: Latches, config: Config) -> BoardInputs:
    """Return the inputs of a robot that starts with these latches."""
    causes = latches.of("fault", "stop")
    codes = {cause.code for cause in causes}
    empty = "battery_empty" in codes and config.battery.stop_below > 0.0
    return BoardInputs(
        EmergencyStop(unpowered="emergency_stop" in codes),
        Bumpers(),
        BatteryInput(known="stop" if empty else "ok"),
        {INPUT_OF[cause.code]: cause for cause in causes if cause.code in INPUT_OF},
    )

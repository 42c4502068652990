"""Monitors the battery that the board reports, and decides when an empty battery stops the robot.

The thresholds in `[battery]` apply to a running mean of the voltage or of the charge. They do not
apply to single values, because starting motors make the voltage drop for some tenths of a second.
An empty battery latches a stop, which `lifecycle.py` keeps. The call `clear` does not release the
stop until the mean has risen above the threshold by `battery.hysteresis`.

If the board stops reporting its battery, the level becomes "unknown" and the robot does not stop. A
robot that blocks the way is the greater danger, and the voltage falls slowly.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import get_args

from acsard.core.config.settings import BatteryConfig
from acsard.core.link.board_status import BoardStatus
from acsard.core.values import NS_PER_S, BatteryLevel, BatteryStatus, Event

TIME_CONSTANT_S = 10.0
"""Time constant of the running mean of the voltage or charge, s. A drop of 2 V for 0.3 s at a motor
start lowers the mean by 0.06 V. A battery takes minutes from one level to the next, so the robot
reacts soon enough."""

SETTLE_S = 3.0
"""Time that the reports of the battery must cover before their running mean decides the level, s.
The covered time is the sum of the intervals between the reports, each limited to `MAX_WEIGHT_NS`. A
silence of the board resets it to 0. A motor start in this time lowers the mean by up to a tenth of
the voltage drop."""

SILENCE_TIMEOUT_S = 5.0
"""Largest age of a reported value of the battery, s. An older value is dropped. If the board sends
one report a second, four consecutive reports may be lost without an effect."""

MAX_WEIGHT_NS = 300_000_000
"""Largest weight of one report in the running mean, ns: the duration of a motor start. The weight
of a report is the time since the previous report, up to this limit. Without the limit, a report
during a motor start would weigh too much after a gap. If the board sends only one report a second,
the limit slows the mean down to a third of its speed."""

EMPTY_REASON = "battery below "
"""First words of the text `Battery.why`, the reason for a stop by an empty battery."""

LEVELS_BY_URGENCY: tuple[BatteryLevel, ...] = get_args(BatteryLevel)[:4]
"""The battery levels from the best to the worst, except "unknown"."""

MISSING_REASON = (
    "the board has not reported its battery, but the configuration has thresholds in [battery]"
)

SILENT_REASON = f"the board has not reported its battery for {SILENCE_TIMEOUT_S:g} s"


def status_text(config: BatteryConfig, status: BatteryStatus) -> str:
    """Return a text with the battery's values and with the reason if its level is not "ok"."""
    forms = ((status.volts, "{:.2f} V"), (status.percent, "{:g} %"), (status.amps, "{:.2f} A"))
    values = [form.format(value) for value, form in forms if value is not None]
    if status.volts is None and status.percent is None:
        return SILENT_REASON
    text, level = ", ".join(values), status.level
    if level == "ok":
        return text
    if level != "unknown":
        return f"{text}; the mean of the last seconds is below {_threshold(config, level)}"
    if getattr(status, config.measure) is None:
        lacks = "voltage" if config.measure == "volts" else "charge"
        return f'{text}; battery.measure = "{config.measure}", but the board reports no {lacks}'
    settled = f"the board has reported for at least {SETTLE_S:g} s"
    return f"{text}; the level is not known until {settled}"


def _threshold(config: BatteryConfig, level: BatteryLevel) -> str:
    name = f"{level}_below"
    return f"battery.{name} = {_with_unit(config, getattr(config, name))}"


def _with_unit(config: BatteryConfig, value: float) -> str:
    return f"{value:g} {'V' if config.measure == 'volts' else '%'}"


class Battery:
    """The battery values that the board reports, and the battery level computed from them."""

    def __init__(self, config: BatteryConfig, stopped: bool = False) -> None:
        """Start without a report.

        `stopped` is true if an empty battery had stopped the robot before this daemon started.
        """
        self._config = config
        self._bounds = config.bounds
        self.status: BatteryStatus | None = None
        """Reported values and battery level; None if the board has never reported its voltage or
        charge."""
        self.stopped_now = False
        """Whether the level fell to "stop" in the last call of `process_reports`."""
        self._values: dict[str, tuple[float, int]] = {}
        """Last value of each quantity by its name ("volts", "percent", "amps"), with its monotonic
        time of arrival, ns."""
        self._awaited = True
        """True from the opening of the port until the board reports the value that
        `battery.measure` names."""
        self._known: BatteryLevel = "stop" if stopped and "stop" in self._bounds else "ok"
        """The last level other than "unknown". A silence of the board does not change it, because
        silence must not end a stop."""
        self._told: BatteryLevel | None = None
        """The level in the last log event; None before the first event."""
        self._mean: float | None = None
        self._since_ns = self._mean_ns = 0
        """Monotonic times, ns. `_since_ns` is the arrival of the first report since the last
        silence, and `_mean_ns` is the arrival of the newest report in `_mean`."""
        self._stood_ns = 0
        """Sum of the weights of all reports in `_mean`, ns (see `MAX_WEIGHT_NS`)."""

    @property
    def refuses_clear(self) -> bool:
        """Whether the call `clear` is refused, because the last known battery level is "stop"."""
        return self._known == "stop"

    @property
    def why(self) -> str:
        """Reason of a stop by an empty battery, as text without measured values."""
        return f"{EMPTY_REASON}{_threshold(self._config, 'stop')}"

    @property
    def mend(self) -> str:
        """Advice on how to end the level "stop", as text without measured values."""
        if self.refuses_clear and self._told is None:
            return "wait until the board has reported its battery for some seconds"
        config = self._config
        return f"charge the battery to {_with_unit(config, config.stop_below + config.hysteresis)}"

    def reopen(self) -> None:
        """Record that the serial port was opened. Another board may answer from now on."""
        self._awaited = True

    def forget(self) -> None:
        """Forget the battery level, unless the board on the newly opened port has reported it.

        The board has reported it if the value that `battery.measure` names has arrived since the
        serial port was opened.
        """
        if self._awaited:
            self._known, self._told, self._mean = "ok", None, None
            self._values.pop(self._config.measure, None)
            if not ("volts" in self._values or "percent" in self._values):
                self.status = None

    def process_reports(
        self, reports: Iterable[tuple[int, BoardStatus]], now_ns: int
    ) -> list[Event]:
        """Process the status lines since the last control step.

        Return a list with one log event if the level changed, otherwise an empty list. Each item of
        `reports` is a pair: the monotonic time of arrival, ns, and the status line.
        """
        self.stopped_now = False
        news = False
        for at_ns, line in reports:
            percent = None if line.charge is None else float(round(100 * line.charge))
            values = {"volts": line.volts, "percent": percent, "amps": line.amps}
            for name, value in values.items():
                if value is not None:
                    self._take(name, value, at_ns)
                    news = True
        if self.status is None and not ("volts" in self._values or "percent" in self._values):
            return []
        for name, (_, at_ns) in [*self._values.items()]:
            if now_ns - at_ns > SILENCE_TIMEOUT_S * NS_PER_S:
                del self._values[name]
                news = True
        level = self._level(now_ns)
        if not news and self.status is not None and self.status.level == (level or "unknown"):
            return []
        self.status = self._summed(level or "unknown")
        if level is None or level == self._told:
            return []
        before, self._told = self._told, level
        return [self._event(level, before)]

    def _take(self, name: str, value: float, at_ns: int) -> None:
        first = not self._values
        self._values[name] = value, at_ns
        if name != self._config.measure:
            self._since_ns = at_ns if first else self._since_ns
            return
        self._awaited = False
        if self._mean is None:
            self._mean, self._since_ns, self._mean_ns = value, at_ns, at_ns
            self._stood_ns = 0
        elif at_ns > self._mean_ns:
            # Until the weights add up to `TIME_CONSTANT_S`, this is the weighted mean of all
            # reports. After that, it is an exponential mean.
            stood_ns = min(at_ns - self._mean_ns, MAX_WEIGHT_NS)
            self._stood_ns += stood_ns
            span_ns = min(TIME_CONSTANT_S * NS_PER_S, self._stood_ns)
            self._mean += (value - self._mean) * stood_ns / span_ns
            self._mean_ns = at_ns

    def _level(self, now_ns: int) -> BatteryLevel | None:
        """Return the battery level, or None until the reports cover `SETTLE_S`.

        The method also sets `stopped_now`, which says whether the level has just fallen to "stop".
        """
        measure, values = self._config.measure, self._values
        if measure not in values:
            self._mean = None
        if not ("volts" in values or "percent" in values):
            return "unknown"
        if not self._bounds:
            return "ok"
        lasted_ns = now_ns - self._since_ns if self._mean is None else self._stood_ns
        if lasted_ns < SETTLE_S * NS_PER_S:
            return None
        if self._mean is None:
            return "unknown"
        reached = LEVELS_BY_URGENCY.index(self._known)
        new_level: BatteryLevel = "ok"
        for level, below in self._bounds.items():
            rise = self._config.hysteresis if reached >= LEVELS_BY_URGENCY.index(level) else 0.0
            if self._mean < below + rise:
                new_level = level
        self.stopped_now = new_level == "stop" != self._known
        self._known = new_level
        return new_level

    def _summed(self, level: BatteryLevel) -> BatteryStatus:
        values = {name: value for name, (value, _) in self._values.items()}
        times = [at_ns for _, at_ns in self._values.values()]
        return BatteryStatus(level, max(times, default=None), **values, mean=self._mean)

    def _event(self, level: BatteryLevel, before: BatteryLevel | None) -> Event:
        assert self.status is not None
        text = status_text(self._config, self.status)
        if level == "stop":
            return Event("battery_stop", f"{text}; {self.mend}, then call srv/clear", "error")
        if before == "stop" and level != "unknown":
            text = f"{text}; the robot stays stopped until srv/clear is called"
        return Event("battery", text, "info" if level == "ok" else "warning", kind=level)

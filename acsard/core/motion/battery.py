"""Monitors the battery that the board reports, and decides when an empty battery stops the robot.

The thresholds of `[battery]` apply to a running mean, because starting motors make the voltage drop
for some tenths of a second. An empty battery latches a stop, which `clear` releases only above the
threshold by `HYSTERESIS`. If the board stops reporting, the level is "unknown", the robot does not
stop and `clear` is not refused: one that blocks the way is the greater danger, and the voltage
falls slowly.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal, get_args

from msgspec import Struct
from msgspec.structs import replace

from acsard.core.codes import Reason, reason
from acsard.core.config.settings import HYSTERESIS, BatteryConfig
from acsard.core.link.board_status import BoardStatus
from acsard.core.values import NS_PER_S, BatteryLevel, BatteryStatus, Event, Ns

# Of the running mean. A drop of 2 V for 0.3 s at a motor start lowers it by 0.06 V, and a battery
# takes minutes from one level to the next.
TIME_CONSTANT_S = 10.0

# Reports must cover this time (each `MAX_WEIGHT_NS` at most) before the mean decides. A motor start
# in it lowers the mean by up to a tenth of the drop.
SETTLE_S = 3.0

SILENCE_TIMEOUT_S = 5.0  # at one report a second, four in a row may be lost

# Longest time for which one report counts, that of a motor start. At one report a second, the mean
# has a third of its speed.
MAX_WEIGHT_NS = 300_000_000

LEVELS_BY_URGENCY: tuple[BatteryLevel, ...] = get_args(BatteryLevel)[:3]  # without "unknown"

MISSING_REASON = (
    "the board has not reported its battery, but the configuration has thresholds in [battery]"
)

SILENT_REASON = f"the board has not reported its battery for {SILENCE_TIMEOUT_S:g} s"


def status_text(config: BatteryConfig, status: BatteryStatus) -> str:
    """Return the battery's values as text, with the reason of a level that is not "ok"."""
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


def empty_reason(config: BatteryConfig) -> Reason:
    """Return the reason of a stop by an empty battery, without measured values."""
    charged = _with_unit(config, config.stop_below + HYSTERESIS)
    return reason("battery_empty", threshold=_threshold(config, "stop"), charged=charged)


class BatteryInput(Struct):
    """The battery values that the board reports, and the battery level computed from them."""

    status: BatteryStatus | None = None  # until voltage or charge is reported
    stopped_now: bool = False  # in the last `process_reports`
    values: dict[str, tuple[float, Ns]] = {}  # "volts", "percent", "amps", with arrival
    awaited: bool = True  # until the board on the new port reports what `battery.measure` names
    # Last report of what `battery.measure` names, or last step without a link.
    reported_ns: Ns | None = None
    # Last level but "unknown"; "stop" only while the board reports the battery.
    known: BatteryLevel = "ok"
    told: BatteryLevel | None = None  # in the last event
    mean: float | None = None
    since_ns: Ns = 0  # first report since the last silence
    mean_ns: Ns = 0  # newest report in `mean`
    stood_ns: Ns = 0  # sum of the weights in `mean`

    @property
    def level(self) -> BatteryLevel | Literal[""]:
        return "" if self.status is None else self.status.level

    @property
    def refuses_clear(self) -> bool:
        """Whether `clear` is refused, because the last known level is "stop"."""
        return self.known == "stop"

    def refusal(self, config: BatteryConfig) -> Reason:
        """Return why `clear` is refused while `refuses_clear` is true."""
        why = empty_reason(config)
        if self.told is None:
            advice = "wait until the board has reported its battery for some seconds"
            return replace(why, advice=advice)
        return why

    def reopen(self) -> None:
        """Record that the port was opened: another board may answer from now on."""
        self.awaited = True

    def forget(self, config: BatteryConfig) -> None:
        """Forget the level, unless the board on the newly opened port has reported it."""
        if self.awaited:
            self.known, self.told, self.mean = "ok", None, None
            self.values.pop(config.measure, None)
            if not ("volts" in self.values or "percent" in self.values):
                self.status = None

    def process_reports(
        self,
        reports: Iterable[tuple[int, BoardStatus]],
        now_ns: Ns,
        linked: bool,
        config: BatteryConfig,
    ) -> list[Event]:
        """Process status lines with their arrival; return an event if the level changed.

        Without a link the board cannot report, so a level "stop" stays.
        """
        self.stopped_now = False
        if self.reported_ns is None or not linked:
            self.reported_ns = now_ns
        news = False
        for at_ns, line in reports:
            percent = None if line.charge is None else float(round(100 * line.charge))
            values = {"volts": line.volts, "percent": percent, "amps": line.amps}
            for name, value in values.items():
                if value is not None:
                    self._take(name, value, at_ns, config.measure)
                    news = True
        if self.known == "stop" and now_ns - self.reported_ns > SILENCE_TIMEOUT_S * NS_PER_S:
            self.known = "ok"
        if self.status is None and not ("volts" in self.values or "percent" in self.values):
            return []
        for name, (_, at_ns) in [*self.values.items()]:
            if now_ns - at_ns > SILENCE_TIMEOUT_S * NS_PER_S:
                del self.values[name]
                news = True
        level = self._level(now_ns, config)
        if not news and self.status is not None and self.status.level == (level or "unknown"):
            return []
        self.status = self._summed(level or "unknown")
        if level is None or level == self.told:
            return []
        before, self.told = self.told, level
        return [self._event(level, before, config)]

    def _take(self, name: str, value: float, at_ns: Ns, measure: str) -> None:
        first = not self.values
        self.values[name] = value, at_ns
        if name != measure:
            self.since_ns = at_ns if first else self.since_ns
            return
        self.awaited, self.reported_ns = False, at_ns
        if self.mean is None:
            self.mean, self.since_ns, self.mean_ns = value, at_ns, at_ns
            self.stood_ns = 0
        elif at_ns > self.mean_ns:
            # A weighted mean of all reports until `TIME_CONSTANT_S`, then an exponential one.
            stood_ns = min(at_ns - self.mean_ns, MAX_WEIGHT_NS)
            self.stood_ns += stood_ns
            span_ns = min(TIME_CONSTANT_S * NS_PER_S, self.stood_ns)
            self.mean += (value - self.mean) * stood_ns / span_ns
            self.mean_ns = at_ns

    def _level(self, now_ns: Ns, config: BatteryConfig) -> BatteryLevel | None:
        measure, values, bounds = config.measure, self.values, config.bounds
        if measure not in values:
            self.mean = None
        if not ("volts" in values or "percent" in values):
            return "unknown"
        if not bounds:
            return "ok"
        lasted_ns = now_ns - self.since_ns if self.mean is None else self.stood_ns
        if lasted_ns < SETTLE_S * NS_PER_S:
            return None
        if self.mean is None:
            return "unknown"
        reached = LEVELS_BY_URGENCY.index(self.known)
        new_level: BatteryLevel = "ok"
        for level, below in bounds.items():
            rise = HYSTERESIS if reached >= LEVELS_BY_URGENCY.index(level) else 0.0
            if self.mean < below + rise:
                new_level = level
        self.stopped_now = new_level == "stop" != self.known
        self.known = new_level
        return new_level

    def _summed(self, level: BatteryLevel) -> BatteryStatus:
        values = {name: value for name, (value, _) in self.values.items()}
        times = [at_ns for _, at_ns in self.values.values()]
        return BatteryStatus(level, max(times, default=None), **values, mean=self.mean)

    def _event(
        self, level: BatteryLevel, before: BatteryLevel | None, config: BatteryConfig
    ) -> Event:
        assert self.status is not None
        text = status_text(config, self.status)
        if level == "stop":
            why = empty_reason(config)
            text = f"{text}; {why.advice}, then type `acsard call clear`"
            return Event("battery_stop", text, "error", code=why.code)
        if before == "stop" and level != "unknown":
            text = f"{text}; the robot stays stopped until `acsard call clear`"
        return Event("battery", text, "info" if level == "ok" else "warning", kind=level)

"""The rows of `diagnostics` in each situation: level, message, values and advice.

`words/diagnostics.txt` has all rows of a usual robot, and then, for each situation, those that
differ from them (`-`: a row that is not there). To write it anew, run
`pytest --approve tests/unit/test_messages_diagnostics.py`, and then read `git diff`.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args

from msgspec.structs import replace

from acsard.core.codes import reason
from acsard.core.config.settings import (
    BatteryConfig,
    BusConfig,
    Config,
    ControlConfig,
    FeedbackConfig,
    McuConfig,
    RobotConfig,
    SafetyConfig,
)
from acsard.core.messages.diagnostics import SHOW_REFUSAL_S, diagnostics
from acsard.core.messages.schema import DiagnosticStatus, Latency, Spread
from acsard.core.motion.bumpers import SILENT_REASON
from acsard.core.motion.modes import Mode
from acsard.core.values import (
    BatteryLevel,
    BatteryStatus,
    GyroDoes,
    RoutersStatus,
    SourceStatus,
    Wait,
)
from tests.each import each
from tests.unit.examples import OUTPUTS, SNAPSHOT, changed

PAGE = Path(__file__).parent / "words" / "diagnostics.txt"
LEVELS = ("ok", "WARNING", "ERROR")
CONFIG = Config(robot=RobotConfig("r7"), mcu=McuConfig(port="/dev/x"))
BUMPERS = replace(CONFIG, safety=SafetyConfig(bumpers=("front", "rear")))
BATTERY = replace(CONFIG, battery=BatteryConfig(warning_below=22.0, stop_below=21.0))
ROUTERS = replace(CONFIG, bus=BusConfig(connect=("tcp/a:7447", "tcp/b:7447")))
BUSY = {"lines": 9_000, "lines_sent": 9_000}
DAYS_40 = {"lines": 340_000_000, "lines_sent": 345_600_000}
APP = SourceStatus("app", 50, 0.1, Wait("nothing"))

CODES = {
    Mode.INACTIVE: "switched_off",
    Mode.STOPPED: "stopped",
    Mode.FAULT: "wheel_reversed",
    Mode.WAITING: "booting",
    Mode.READY: "no_command",
    Mode.DRIVING: "commanded",
    Mode.SHUTDOWN: "shutting_down",
}

SITUATIONS: dict[str, tuple[Config, dict[str, Any]]] = {
    **{f"the mode {mode}": (CONFIG, {"mode": mode, "code": code}) for mode, code in CODES.items()},
    "a fault of the driver": (CONFIG, {"mode": "fault", "code": "driver_fault"}),
    "a fault of acsard": (CONFIG, {"mode": "fault", "code": "guard_too_fast"}),
    **{f"a link that is {link}": (CONFIG, {"link": link}) for link in ("stale", "booting", "down")},
    "a robot that waits for its link": (
        CONFIG, {"mode": "waiting", "link": "down", "code": "port_trouble"},
    ),
    "a port that was released": (
        CONFIG, {"mode": "stopped", "code": "stopped", "link": "down", "port_released": True},
    ),
    "a late computer": (CONFIG, {"link": "stale", "code": "host_late"}),
    "the simulator": (Config(), {}),
    "the simulator without a link": (Config(), {"link": "down"}),
    "50 lines a second of 33 bytes on 38400 baud": (
        replace(CONFIG, mcu=McuConfig("/dev/x", 38400), control=ControlConfig(rate=50)), {},
    ),
    "lines without answers": (CONFIG, {"unanswered": True}),
    "damaged lines": (CONFIG, {"counters": BUSY | {"line_malformed": 200}}),
    "links that this computer lost": (
        CONFIG, {"counters": BUSY | {"link_lost": 3, "link_lost_host_stall": 3}},
    ),
    "links that the board lost": (CONFIG, {"counters": BUSY | {"link_lost": 3}}),
    "a link lost once a day": (CONFIG, {"counters": DAYS_40 | {"link_lost": 40}}),
    "a link lost more than once a day": (CONFIG, {"counters": DAYS_40 | {"link_lost": 41}}),
    "estimated encoder counts": (CONFIG, {"encoder_counts": [20, 0, 0, 400]}),
    "1 % missed periods": (CONFIG, {"missed_last_minute": 1}),
    "2 % missed periods": (CONFIG, {"missed_last_minute": 2}),
    "missed periods an hour ago": (CONFIG, {"counters": {"missed_periods": 100_000}}),
    "a bad minute after good hours": (
        CONFIG, {"latencies": {"period_lateness": Latency(Spread(10_000_000, 0, 0, 0),
                                                          Spread(5_800, 0, 0, 0))},
                 "missed_last_minute": 200},
    ),
    "no source": (CONFIG, {"source": ""}),
    "a speed limit": (CONFIG, {"speed_limit": "0.3 m/s, set by x"}),
    "two senders of a source": (
        CONFIG, {"sources": (APP, SourceStatus("nav", 10, 0.1, Wait("senders", senders=1)))},
    ),
    "a refused source": (CONFIG, {"refused_age_s": SHOW_REFUSAL_S / 2}),
    "a source refused long ago": (CONFIG, {"refused_age_s": SHOW_REFUSAL_S}),
    "a left out and a slipping wheel": (
        CONFIG, {"wheel_fault": "rear_left is left out", "excluded": ("rear_left",),
                 "slipping": ("right",)},
    ),
    "no encoders": (
        replace(CONFIG, feedback=FeedbackConfig(encoders=False)),
        {"wheel_fault": "no encoders"},
    ),
    **{f"an emergency stop that is {estop}": (
        CONFIG, {"emergency_stop": estop, "board": {"volts": "24.31"},
                 "counters": {"line_status_malformed": 2, "emergency_stops": 1, "lines": 9}},
    ) for estop in ("released", "pressed", "silent")},
    "a required emergency stop": (replace(CONFIG, safety=SafetyConfig(estop="required")), {}),
    "a motor driver in fault": (CONFIG, {"board": {"motor_driver": "fault"}}),
    "bumpers that are not reported": (BUMPERS, {}),
    "bumpers": (BUMPERS, {"bumpers": [False, False]}),
    "a pressed bumper": (
        BUMPERS, {"bumpers": [True, False], "counters": {"bumper_presses": 1},
                  "bumper": reason("bumper", bumpers="front bumper pressed")},
    ),
    "silent bumpers": (BUMPERS, {"bumpers": [True, True], "bumper": SILENT_REASON}),
    "bumpers that are ignored": (
        replace(CONFIG, safety=SafetyConfig(bumpers=("front", "rear"), bumper="off")), {},
    ),
    **{f"the battery's level {level}": (
        BATTERY, {"battery": BatteryStatus(level, 0, 22.5, 40.0, -1.5, 21.756)},
    ) for level in get_args(BatteryLevel)},
    "thresholds of a battery that is not reported": (BATTERY, {"battery": None}),
    "no battery": (CONFIG, {"battery": None}),
    "routers that were not looked for yet": (ROUTERS, {}),
    "a router that was lost and one that was never connected": (
        ROUTERS, {"routers": RoutersStatus(missing=("tcp/a:7447",))},
    ),
    "a connected router": (CONFIG, {"routers": RoutersStatus(("a",))}),
    "a router that is a peer": (CONFIG, {"routers": RoutersStatus(("a", "b"), peers=("b",))}),
    **{f"a gyro: {does}": (CONFIG, {"gyro": does}) for does in get_args(GyroDoes)},
    "a full disk": (CONFIG, {"latch_file": "No space left"}),
    "changed settings": (CONFIG, {"settings_differ": "rates.odom = 5"}),
}  # fmt: skip


def statuses(config: Config = CONFIG, **changes: Any) -> list[DiagnosticStatus]:
    return diagnostics(config, OUTPUTS.now, changed(SNAPSHOT, **changes), None).status


def words(status: DiagnosticStatus) -> list[str]:
    """Return the row as text."""
    name = status.name.removeprefix("acsard: ")
    values = [f"    {pair.key}: {pair.value}" for pair in status.values]
    return [f"{LEVELS[status.level]}  {name}: {status.message}", *values]


def test_each_situation_has_its_rows(approved: Callable[[Path, str], None]) -> None:
    usual = {status.name: words(status) for status in statuses()}
    blocks = ["\n".join(["# a usual robot", *(line for row in usual.values() for line in row)])]
    for situation, (config, changes) in SITUATIONS.items():
        found = {status.name: words(status) for status in statuses(config, **changes)}
        lines = [line for name, row in found.items() if row != usual.get(name) for line in row]
        gone = [f"-  {name.removeprefix('acsard: ')}" for name in usual if name not in found]
        blocks.append("\n".join([f"# {situation}", *lines, *gone]))
    approved(PAGE, "\n\n".join(blocks) + "\n")


@each("mode", [*Mode])
@each("link", ["up", "stale", "booting", "down"])
def test_no_row_appears_or_disappears_in_any_state_of_the_robot(mode: str, link: str) -> None:
    names = [status.name for status in statuses()]
    assert len(set(names)) == len(names)
    found = statuses(
        mode=mode, link=link, source="", latencies={}, counters={}, sources=(), refused_age_s=0.0
    )
    assert [status.name for status in found] == names
    assert {status.hardware_id for status in found} == {"r7"}

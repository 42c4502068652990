"""The simulator's view of the product as it was before the simulator existed, at 5450cf70.

`--against TREE --adapter FILE` loads this file in place of the tree's own `product.py`. It gives
the old modules their present names, loads the present `product.py` on top of them, and translates
the names that have changed since. Remove it when that commit is compared no more.
"""

from __future__ import annotations

import importlib
import importlib.util
import struct
import sys
from pathlib import Path
from typing import Any

from tests.simulate.roads import parameters

MODULES = {
    "acsard.core.config.parsing": "acsard.config.parsing",
    "acsard.core.incoming.commands": "acsard.incoming.commands",
    "acsard.core.incoming.queries": "acsard.incoming.queries",
    "acsard.core.messages.encodings": "acsard.messages.encodings",
    "acsard.core.simulator.baud_mismatch": "acsard.sim.garble",
    "acsard.core.simulator.fake_mcu": "acsard.sim.fake_mcu",
    "acsard.core.simulator.simulated_robot": "acsard.sim.watched",
    "acsard.core.values": "acsard.values",
    "acsard.daemon.latch_rules": "acsard.runtime.kept_latches",
    "acsard.daemon.pacing": "acsard.runtime.period",
}
"""Maps the present name of a module to its old one."""

RENAMED = b"commands.neutral_pause", b"commands.pause"
"""The present and the old name of a setting."""

for present, old in MODULES.items():
    sys.modules[present] = importlib.import_module(old)
# The present plans use faults of the simulated board that have other names now.
fake_mcu: Any = importlib.import_module("acsard.sim.fake_mcu").FakeMcu
fake_mcu.free_running = fake_mcu.unprompted
fake_mcu.wrong_baud = fake_mcu.other_baud
fake_mcu.watchdog_fed_by_bad_lines = fake_mcu.fed_by_anything

spec = importlib.util.spec_from_file_location(
    "present_product", Path(__file__).with_name("product.py")
)
assert spec is not None
assert spec.loader is not None
product: Any = importlib.util.module_from_spec(spec)
sys.modules[spec.name] = product
spec.loader.exec_module(product)

START_NS, WALL_OFFSET_NS = product.START_NS, product.WALL_OFFSET_NS
HELD, Seen = product.HELD, product.Seen


def old_config(config: dict[str, Any]) -> dict[str, Any]:
    """Return a configuration with the old names of the settings."""
    commands = dict(config["commands"])
    if "neutral_pause" in commands:
        commands["pause"] = commands.pop("neutral_pause")
    return config | {"commands": commands}


def old_parameters(payload: bytes) -> bytes:
    """Return a request of ROS to set parameters with the old names of the settings.

    `tests.simulate.roads.parameters` made the request and shows its layout.
    """
    data, at, settings = payload[4:], 4, {}
    for _ in range(struct.unpack_from("<I", data)[0]):
        at += -at % 4
        length = struct.unpack_from("<I", data, at)[0]
        name = data[at + 4 : at + 4 + length - 1].replace(*RENAMED).decode()
        at += 4 + length + 2
        at += -at % 8
        settings[name] = struct.unpack_from("<d", data, at + 8)[0]
        at += 16 + 28
    return parameters(settings)


def problems(config: dict[str, Any]) -> list[str]:
    """Return the problems of this configuration, in words; none if it is legal."""
    found: list[str] = product.problems(old_config(config))
    return found


class Product(product.Product):  # type: ignore[misc]
    """One robot with the old daemon."""

    def __init__(self, config: dict[str, Any], see: Any) -> None:
        super().__init__(old_config(config), see)

    def ask(
        self, at_ns: int, service: str, ticket: int, payload: bytes, via: Any, attachment: bytes
    ) -> None:
        """Hand over a service call, with the old names of settings."""
        if service == "set":
            payload = payload.replace(*RENAMED)
        elif service.startswith("parameters/set"):
            payload = old_parameters(payload)
        super().ask(at_ns, service, ticket, payload, via, attachment)

    def end(self, way: str) -> None:
        """End the daemon by SIGTERM (`term`) or at once (`kill`)."""
        if way == "term":
            self._world.loop.leaving = True
        super().end(way)

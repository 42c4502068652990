"""Plans with bumpers, and their promise: a pressed one stops the robot until a clear afterwards.

The pages say when a status line counts as a press. Such a plan has no other trouble of the board
and no end of the daemon, so that each line arrives and its order is certain.
"""

from __future__ import annotations

import random
import re
from collections.abc import Iterable
from typing import Any

from tests.simulate.promises import LINE, BrokenError, Witness
from tests.simulate.roads import NS

SHARE = 0.08
"""Share of the plans that have bumpers."""

PLACES = ("front", "rear", "left", "right")

KEPT = ("call", "wall", "stall", "stall in step")
"""Events that a plan with bumpers keeps."""

NAMES = {"bumpers", "bumper_pressed"}
"""The faults of the simulated board that report bumpers."""

STATUS = re.compile(rb"!status bumpers=([.X]+)(?:\*[0-9A-F]{4})?\r?")


def add(plan: dict[str, Any]) -> None:
    """Give some plans bumpers, and operators who clear the stops.

    The plan has dice of its own, so the other plans stay as they are.
    """
    dice = random.Random(f"board inputs {plan['seed']}")
    # A line without a checksum does not count once the link has the check.
    if dice.random() > SHARE or "link_check" in plan["config"]["mcu"]:
        return
    places = [dice.choice(PLACES) for _ in range(dice.randint(1, 4))]
    plan["config"]["safety"] = {"bumpers": places}
    plan["board"].append(["bumpers"])
    events = [event for event in plan["events"] if event["do"] in KEPT]
    clear = {"do": "call", "verb": "clear", "late": 0.01, "lost": False, "twice": False,
             "by": "op9", "via": "native"}  # fmt: skip
    for _ in range(1 + int(plan["seconds"] / 15)):
        at, lasts = dice.uniform(2.0, plan["seconds"]), dice.choice((0.03, 0.3, 2.0, 6.0))
        fault = ["bumper_pressed", dice.randint(1, len(places)), 0.0, 0.0]
        events.append({"at": round(at, 3), "do": "board", "for": lasts, "fault": fault})
        for _ in range(dice.randrange(4)):
            early = round(at + dice.uniform(0.0, lasts + 1.0), 3)
            events.append({"at": early, **clear, "named": dice.random() < 0.7})
        late = round(at + lasts + dice.uniform(0.1, 2.0), 3)
        events.append({"at": late, **clear, "named": True})
    plan["events"] = sorted(events, key=lambda one: one["at"])


def removed(plan: dict[str, Any]) -> dict[str, Any]:
    """Return the plan without bumpers, for a product that does not know them."""
    if "safety" not in plan["config"]:
        return plan
    return plan | {
        "config": {name: table for name, table in plan["config"].items() if name != "safety"},
        "board": [fault for fault in plan["board"] if fault[0] not in NAMES],
        "events": [event for event in plan["events"] if event.get("fault", [""])[0] not in NAMES],
    }


class Bumpers:
    """The bumpers in the status lines that reached the daemon."""

    def __init__(self, witness: Witness) -> None:
        self._witness = witness
        self._held, self._marks = b"", b""
        self._pressed_ns: int | None = None
        """Arrival of the first status line with a pressed bumper since all were released."""

    def fed(self, at_ns: int, data: bytes) -> None:
        """Take bytes that reached the daemon. A bumper that is pressed now is a stop."""
        *lines, self._held = (self._held + data).split(b"\n")
        for line in lines:
            match = STATUS.fullmatch(line)
            if match is None:
                continue
            before, self._marks = self._marks or b"." * len(match[1]), match[1]
            if any(now > then for now, then in zip(self._marks, before, strict=True)):
                self._witness.stops.append(at_ns)
                self._witness.counts["bumper pressed"] += 1
                # The robot does not ramp down, because it touches an obstacle.
                self._witness.cut = True
            if b"X" not in self._marks:
                self._pressed_ns = None
            elif self._pressed_ns is None:
                self._pressed_ns = at_ns

    def step(self, at_ns: int, decided_ns: int, lines: Iterable[tuple[int, bytes]]) -> None:
        """Judge the lines of a step that began at `decided_ns`."""
        pressed_ns = self._pressed_ns
        if pressed_ns is None or decided_ns <= pressed_ns:
            return
        for _, line in lines:
            match = LINE.match(line)
            if match is not None and any(float(speed[1:]) for speed in match.groups()):
                text = f"{line!r}, pressed since {pressed_ns / NS:.3f} s"
                raise BrokenError("nothing moves while a bumper is pressed", at_ns, text)

    def cleared(self, asked_ns: int) -> None:
        """Judge a clear that worked."""
        pressed_ns = self._pressed_ns
        if pressed_ns is not None and asked_ns > pressed_ns:
            text = f"pressed since {pressed_ns / NS:.3f} s"
            raise BrokenError("no clear works while a bumper is pressed", asked_ns, text)

"""The list of usual boards in the code agrees with the udev rules that are installed."""

from __future__ import annotations

import re
from pathlib import Path

from acsard.machine.serial_ports import BOARDS

RULES = Path(__file__).parents[3] / "deploy" / "udev" / "70-acsar.rules"

LINE = 'ENV{ID_VENDOR_ID}=="%s", ENV{ID_MODEL_ID}=="%s", ENV{ACSAR_MCU}="1"'


def test_the_udev_rules_name_exactly_the_usual_boards() -> None:
    lines = re.findall(re.escape(LINE).replace("%s", r"([\w|]+)"), RULES.read_text())
    named = [f"{vendor}:{model}" for vendor, models in lines for model in models.split("|")]
    assert sorted(named) == sorted(BOARDS)


def test_no_other_line_of_the_rules_chooses_a_board() -> None:
    chosen = [row for row in RULES.read_text().splitlines() if 'ENV{ACSAR_MCU}="1"' in row]
    assert all(re.fullmatch(re.escape(LINE).replace("%s", r"[\w|]+"), row) for row in chosen)

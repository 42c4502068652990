"""The README of the firmware is right: its Arduino example, status lines and table of settings."""

from __future__ import annotations

import ctypes
import re
import shutil
import subprocess

import pytest

from acsard.core.link.board_status import decode_status
from tests.firmware.board import FIRMWARE

PAGE = FIRMWARE / "README.md"

ARDUINO = """
#include <string.h>
static char sent[4096];
static int pin;
static unsigned long now;
static void print(const char *text) { strcat(sent, text); }
static struct { void (*print)(const char *); } Serial = {print};
static int digitalRead(int which) { return pin; }
static unsigned long millis(void) { return now; }
"""
"""The functions of Arduino that the example uses, for a program on this machine."""

TEST = """
const char *run(int level, unsigned long at) {
    sent[0] = 0;
    pin = level;
    now = at;
    sendStatus();
    return sent;
}
"""


@pytest.fixture(scope="module")
def sketch(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    if shutil.which("gcc") is None:
        pytest.skip("no gcc")
    blocks = PAGE.read_text(encoding="utf-8").split("```")
    (code,) = [block for block in blocks if "void sendStatus()" in block]
    assert len(code.strip().splitlines()) <= 10
    place = tmp_path_factory.mktemp("sketch")
    (place / "sketch.c").write_text(ARDUINO + code + TEST, encoding="utf-8")
    command = ["gcc", "-shared", "-fPIC", "-Wall", "-o", "sketch.so", "sketch.c"]
    subprocess.run(command, cwd=place, check=True)
    library = ctypes.CDLL(str(place / "sketch.so"))
    library.run.restype = ctypes.c_char_p
    library.run.argtypes = (ctypes.c_int, ctypes.c_ulong)
    return library


def test_the_example_reports_ten_times_a_second_and_a_change_immediately(
    sketch: ctypes.CDLL,
) -> None:
    reports = [(at, line) for at in range(1000) if (line := sketch.run(350 <= at < 620, at))]
    pressed = {at for at, line in reports if decode_status(line.removesuffix(b"\r\n"), False).estop}
    assert all(line.endswith(b"\r\n") for _, line in reports)
    assert pressed == {350, 450, 550}
    assert {at for at, _ in reports} - pressed == {0, 100, 200, 300, 620, 720, 820, 920}


def test_each_status_line_of_the_page_is_valid() -> None:
    lines = re.findall(r"!status [^`\n]*\*[0-9A-F]{4}", PAGE.read_text(encoding="utf-8"))
    assert len(lines) >= 4
    for line in lines:
        decode_status(line.encode(), True)


def test_the_page_has_each_setting_of_the_inputs_with_its_value() -> None:
    page, config = PAGE.read_text(encoding="utf-8"), (FIRMWARE / "config.h").read_text()
    table = page.partition("settings of [the inputs]")[2].partition("\n\nAll wheels")[0]
    settings = re.findall(r"^\| `(\w+)` \| (\d+) \|", table, re.MULTILINE)
    inputs = config.partition("/* Inputs.")[2].partition("/* Pins.")[0]
    assert settings == re.findall(r"^#define (\w+) (\d+)", inputs, re.MULTILINE)

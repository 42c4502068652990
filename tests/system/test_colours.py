"""With NO_COLOR, or without a terminal, no output has colours."""

from __future__ import annotations

import fcntl
import re
import struct
import sys
import termios
from collections.abc import Sequence
from pathlib import Path

import pytest

from tests.system.harness import (
    Bus,
    Daemon,
    Program,
    acsard,
    environment,
    finish,
    free_endpoint,
    until,
)
from tests.system.terminals import ON_TERMINAL, Terminal
from tests.system.test_cli import VERBS, WAITS

SGR = re.compile(r"\x1b\[([\d;:]*)m")


def colours(text: str) -> list[str]:
    """Return the sequences that set a colour. Bold, faint and reversed are not colours."""
    sequences = (match[1] for match in SGR.finditer(text))
    return [sequence for sequence in sequences if any(map(_is_colour, re.split("[;:]", sequence)))]


def _is_colour(number: str) -> bool:
    return bool(number) and int(number) // 10 in (3, 4, 9, 10) and number not in ("39", "49")


SCREENS = [
    (["drive"], WAITS),
    (["top"], WAITS),
    (["top", "--once"], WAITS),
    (["fleet"], WAITS),
    (["echo", "state"], WAITS),
    (["fleet", "--once"], WAITS),
    (["echo", "state", "--short"], WAITS),
    (["doctor"], "configuration"),
    (["recording", "--directory", "."], "no recording"),
    (["run", "--port", "nowhere", "--id", "other"], "nowhere"),
]


EVERY_HELP = """\
import argparse
from acsard.cli import main, parser

def words(of, before=()):
    yield before
    for action in of._actions:
        if isinstance(action, argparse._SubParsersAction):
            for name, inner in action.choices.items():
                yield from words(inner, (*before, name))

for one in words(parser()):
    for last in ("--help", "--nonsense"):
        try:
            main([*one, last])
        except SystemExit:
            pass
print("that was", "all")
"""
"""Includes the subcommands of the verbs, and the error for an unknown option."""


def colour_output(words: Sequence[str], where: Path, text: str, **more: str) -> str:
    """Return the output of a program at a colour terminal, until it contains this text."""
    with Terminal() as terminal:
        fcntl.ioctl(terminal.slave, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 100, 0, 0))
        env = environment(TERM="xterm-256color", COLORTERM="truecolor")
        for name in ("COLUMNS", "LINES", "NO_COLOR"):
            env.pop(name, None)
        with Program(
            words,
            where,
            env | more,
            stdin=terminal.slave,
            stdout=terminal.slave,
            stderr=terminal.slave,
            start_new_session=True,
        ):
            until(lambda: text in SGR.sub("", terminal.screen), 15.0, f"{text!r} of {words}")
        return terminal.screen


def typed_at(daemon: Daemon, words: Sequence[str]) -> list[str]:
    """Return a command line of acsard for a terminal, with this daemon's configuration file."""
    file = [] if words[0] in ("run", "recording") else ["--config", str(daemon.config)]
    return [sys.executable, "-c", ON_TERMINAL, *words, *file]


@pytest.mark.variations(4)
@pytest.mark.parametrize(
    ("words", "text"), SCREENS, ids=[" ".join(command) for command, _ in SCREENS]
)
@pytest.mark.nightly
def test_no_screen_has_a_colour_if_no_color_is_set(
    shared: Daemon, bus: Bus, tmp_path: Path, words: list[str], text: str
) -> None:
    assert colours(colour_output(typed_at(shared, words), tmp_path, text, NO_COLOR="1")) == []


@pytest.mark.variations(4)
@pytest.mark.slow
@pytest.mark.parametrize("words", [["drive"], ["top"], ["fleet"], ["doctor"]], ids=" ".join)
def test_a_screen_has_colours_unless_no_color_is_set(
    shared: Daemon, bus: Bus, tmp_path: Path, words: list[str]
) -> None:
    text = next(text for verb, text in SCREENS if verb == words)
    assert colours(colour_output(typed_at(shared, words), tmp_path, text))


@pytest.mark.slow
def test_no_help_and_no_usage_error_has_a_colour_if_no_color_is_set(tmp_path: Path) -> None:
    words = [sys.executable, "-c", EVERY_HELP]
    output = colour_output(words, tmp_path, "that was all", NO_COLOR="1")
    assert output.count("usage: acsard") >= 2 * len(VERBS)
    assert colours(output) == []


@pytest.mark.variations(5)
@pytest.mark.parametrize(
    "words",
    [
        ["doctor"], ["top"], ["fleet"], ["echo", "state", "-n1", "--short"],
        ["echo", "odom", "-n1"],
        ["topics"], ["check"], ["set"], ["echo", "odom", "--rate", "-n2"],
        ["get", "nonsense"], ["call", "nonsense"],
        ["set", "limits.linear_speed", "-1"], ["drive"],
    ],
    ids=" ".join,
)  # fmt: skip
@pytest.mark.nightly
def test_output_into_a_pipe_has_no_colour(shared: Daemon, bus: Bus, words: list[str]) -> None:
    env = environment(TERM="xterm-256color", FORCE_COLOR="1")
    env.pop("NO_COLOR", None)
    done = finish(acsard(*words, "--config", str(shared.config)), shared.config.parent, env=env)
    assert done.out + done.err
    assert "\x1b" not in done.out + done.err


@pytest.mark.slow
def test_the_log_of_zenoh_in_a_pipe_has_no_colour(tmp_path: Path) -> None:
    env = environment(TERM="xterm-256color", RUST_LOG="zenoh=debug")
    env.pop("NO_COLOR", None)
    words = acsard("run", "--listen", free_endpoint())
    with Program(words, tmp_path, env) as program:
        until(lambda: "zenoh::" in program.stdout + program.stderr, 10.0, "its log")
    assert "\x1b" not in program.stdout + program.stderr

"""Programs that the tests build with the tools of other languages, and keep in pytest's cache."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

import pytest

from tests.system.harness import ROOT, environment

BUILD_S = 3600
"""Time limit of a test that may have to build a bridge first."""

CLIENTS = ROOT / "deploy/clients"
"""The examples in other languages."""

LIBCLANG = "no libclang: it builds the bridge's bindings (Debian: apt install libclang-dev)"


def program(name: str, needed: str) -> str:
    """Return the path of a tool; skips the test if it is not installed."""
    path = shutil.which(name)
    if path is None:
        pytest.skip(f"no {name} on the PATH: {needed}")
    return path


def finished(words: Sequence[str], where: Path, **more: str) -> subprocess.CompletedProcess[str]:
    """Run a program to its end. `more` are variables of its environment."""
    return subprocess.run(
        words, cwd=where, env=environment(**more), capture_output=True, text=True, check=False
    )


def run(words: Sequence[str], where: Path, **more: str) -> str:
    """Run a program to its end and return its output. Fails if its exit code is not 0."""
    done = finished(words, where, **more)
    assert done.returncode == 0, f"{words}\n{done.stdout}\n{done.stderr}"
    return done.stdout


def ros2dds_bridge(cache: Path) -> str:
    """Return the installed zenoh-bridge-ros2dds, or build the program in `tests/ros2dds`."""
    if (path := shutil.which("zenoh-bridge-ros2dds")) is not None:
        return path
    for tool in ("cargo", "cmake", "c++"):
        if shutil.which(tool) is None:
            pytest.fail(f"no {tool} on the PATH: it builds the bridge in tests/ros2dds")
    target = cache / "ros2dds"
    words = ["cargo", "build", "--quiet", "--locked"]
    done = finished(words, ROOT / "tests/ros2dds", CARGO_TARGET_DIR=str(target))
    if done.returncode != 0 and "Unable to find libclang" in done.stderr:
        pytest.fail(LIBCLANG)
    assert done.returncode == 0, done.stderr
    return str(target / "debug/ros2dds")


def copied(language: str, cache: Path) -> Path:
    """Copy the example of a language into the build directory, which keeps earlier builds."""
    built = shutil.ignore_patterns("target", "node_modules", "dist", "*lock*")
    return shutil.copytree(CLIENTS / language, cache / language, ignore=built, dirs_exist_ok=True)


def node_program(where: Path) -> list[str]:
    """Return the words that run the program for Node."""
    node = program("node", "it runs the program")
    flags = ["--experimental-websocket"] if run([node, "--version"], where) < "v22" else []
    return [node, *flags, str(CLIENTS / "node/drive.mjs")]

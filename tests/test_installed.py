"""acsard works as users install it: by `uv tool` and `pipx`, from a wheel, with the constraints.

Each subcommand does its work, or names the extra that it needs. No clone is there.
"""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from acsard.cli import UNLISTED, VERBS
from acsard.host.version import commit_of
from deploy.release import contents
from tests.pages import ROOT

pytestmark = [
    pytest.mark.slow,
    pytest.mark.nightly,
    pytest.mark.timeout(1200),
    pytest.mark.skipif(not commit_of(ROOT), reason="the wheel is made from a git clone"),
]

WITHIN_S = 60.0

# Subcommands that end by themselves, with a word of their output. `{}` is the test's directory.
WORKS = {
    "--version": "acsard 0",
    "check": "faults = []",
    "topics": "cmd_vel",
    "ports": "",
    "tls router robot1": "",
    "service install --dry-run": "systemctl enable --now acsard.service",
    "service uninstall --dry-run": "",
    "get info": '"version":"',
    "echo state -n 1 --short": "m/s",
    "echo odom -n 1": '"child_frame_id"',
    "call stop": "stopped and latched",
    "call clear": "cleared",
    "set": "limits.linear_speed",
    "set limits.linear_speed 0.4": "0.4",
    "fleet --once": "sim",
    "recording show {}/recordings": "",
    "recording export {}/recordings {}/export.csv": "",
}
NEED_TOOLS = {
    "tls init --directory {}/tls": "",
    "set limits.linear_speed 0.3 --keep": "0.3",
}


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


@contextmanager
def running(words: list[str], env: dict[str, str]) -> Iterator[None]:
    """Run the daemon of this environment in the block."""
    daemon = subprocess.Popen(
        words, env=env, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )  # fmt: skip
    try:
        until = time.monotonic() + WITHIN_S
        while run([words[0], "get", "info"], env)[0]:
            assert daemon.poll() is None
            assert time.monotonic() < until
        yield
    finally:
        daemon.terminate()
        daemon.wait(10.0)


def run(words: list[str], env: dict[str, str], within_s: float = WITHIN_S) -> tuple[int, str]:
    done = subprocess.run(
        words, env=env, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        text=True, timeout=within_s, check=False,
    )  # fmt: skip
    return done.returncode, done.stdout


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a directory with a wheel, the constraints, and a venv with uv and pipx."""
    pytest.importorskip("hatch_fancy_pypi_readme", reason="only the build needs it")
    where = tmp_path_factory.mktemp("made")
    clone, env = where / "clone", dict(os.environ)
    for words in (
        ["git", "clone", "-q", str(ROOT), str(clone)],
        [sys.executable, "-m", "venv", str(where / "venv")],
        [str(where / "venv/bin/pip"), "install", "-q", "uv", "pipx"],
    ):
        code, output = run(words, env, 300.0)
        assert code == 0, output
    words = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(where)]
    subprocess.run(words, cwd=clone, check=True, capture_output=True)
    (where / "constraints.txt").write_text(contents.constraints())
    return where


def with_uv(made: Path, what: str) -> list[str]:
    uv, held = str(made / "venv/bin/uv"), str(made / "constraints.txt")
    return [uv, "tool", "install", "-q", "--python", sys.executable, "-c", held, what]


def with_pipx(made: Path, what: str) -> list[str]:
    pipx, held = str(made / "venv/bin/pipx"), f"--constraint {made / 'constraints.txt'}"
    return [pipx, "install", "--python", sys.executable, f"--pip-args={held}", what]


@pytest.mark.parametrize("extra", ["", "tools"])
@pytest.mark.parametrize("way", [with_uv, with_pipx])
def test_every_subcommand_of_an_installed_wheel_works_or_names_its_extra(
    way: Callable[[Path, str], list[str]], extra: str, made: Path, tmp_path: Path
) -> None:
    (wheel,) = made.glob("*.whl")
    programs = tmp_path / "bin"
    config = tmp_path / "acsard.toml"
    config.write_text(
        f'robot.id = "installed"\nbus.listen = ["tcp/127.0.0.1:{free_port()}"]\n'
        f'web.address = ["http://127.0.0.1:{free_port()}"]\n'
        f'record.directory = "{tmp_path}/recordings"\n'
    )
    env = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")} | {
        "HOME": str(tmp_path),
        "ACSARD_CONFIG": str(config),
        "UV_TOOL_DIR": str(tmp_path / "uv"),
        "UV_TOOL_BIN_DIR": str(programs),
        "PIPX_HOME": str(tmp_path / "pipx"),
        "PIPX_BIN_DIR": str(programs),
    }
    what = f"acsard[{extra}] @ {wheel.as_uri()}" if extra else str(wheel)
    code, output = run(way(made, what), env, 600.0)
    assert code == 0, output
    acsard = str(programs / "acsard")
    _, python, *_ = (programs / "acsard").read_text().splitlines()[0].partition("#!")
    code, output = run([python, "-c", VERSIONS], env)
    installed = dict(line.split("==") for line in output.split())
    tested = dict(contents.pins())
    assert {name: tested.get(name) for name in installed} == installed

    for verb in (*VERBS, *UNLISTED):
        code, output = run([acsard, verb, "--help"], env)
        assert code == 0, f"{verb}: {output}"
    with running([acsard, "run", "--port", "sim"], env):
        for words, expected in (WORKS | (NEED_TOOLS if extra else {})).items():
            code, output = run([acsard, *words.replace("{}", str(tmp_path)).split()], env)
            assert code == 0, f"{words}: {output}"
            assert expected in output, f"{words}: {output}"
    lacking = ["foxglove"] if extra else ["foxglove", "web", *NEED_TOOLS]
    for words in lacking:
        code, output = run([acsard, *words.replace("{}", str(tmp_path)).split()], env)
        assert code == 1, f"{words}: {output}"
        named = "foxglove" if words == "foxglove" else "tools"
        installer = "uv tool install" if way is with_uv else "pipx install --force"
        assert f"type `{installer} 'acsard[{named}] @ {wheel.as_uri()}'`" in output, output


VERSIONS = """\
import importlib.metadata as m
for d in m.distributions():
    name = d.metadata["Name"].lower().replace("_", "-")
    if name not in ("acsard", "pip", "setuptools", "wheel"):
        print(f"{name}=={d.version}")
"""

"""acsard works as users install it: by `uv tool` and `pipx`, from a wheel, with the constraints.

Each subcommand does its work, or names the extra that it needs. No clone is there.
"""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Timer

import pytest

from acsard.cli import UNLISTED, VERBS
from acsard.host.version import source_of
from deploy.release import contents
from tests.pages import ROOT
from tests.unit.calibration_logs import usual

pytestmark = [
    pytest.mark.slow,
    pytest.mark.nightly,
    pytest.mark.timeout(1200),
    pytest.mark.skipif(not source_of(ROOT), reason="the wheel is made from a git clone"),
]

WITHIN_S = 60.0

# What each subcommand says, and its exit code. `{}` is the test's directory.
WORKS = {
    "--version": (0, "acsard 0"),
    "check": (0, "faults = []"),
    "topics": (0, "cmd_vel"),
    "ports": (0, ""),
    "tls router robot1": (0, "// The configuration of a Zenoh"),
    "service install --dry-run": (0, "systemctl enable --now acsard.service"),
    "service uninstall --dry-run": (0, ""),
    "get info": (0, '"version":"'),
    "echo state -n 1 --short": (0, "m/s"),
    "echo odom -n 1": (0, '"child_frame_id"'),
    "top --once": (0, "wheels, rad/s"),
    "fleet --once": (0, "1 robot"),
    "doctor": (0, "the running daemon"),
    "call stop": (0, "stopped and latched"),
    "call clear": (0, "cleared"),
    "move forward 0.02": (0, "yaw"),
    "set": (0, "limits.linear_speed"),
    "set limits.linear_speed 0.4": (0, "limits.linear_speed = 0.4"),
    "recording": (0, "[being recorded]"),
    "recording show": (0, "link up"),
    "recording export 1 {}/export.csv --csv": (0, "rows in"),
    "calibrate log {}/drive.csv": (0, "wheel_separation_multiplier"),
    "drive": (2, "reads single key presses"),
    "mcu check": (2, "`acsard mcu check --port DEVICE`"),
}
NEED_TOOLS = {
    "tls init --directory {}/tls": (0, "ca.pem"),
    "set limits.linear_speed 0.3 --keep": (0, "limits.linear_speed = 0.3"),
    "web tokens": (0, "no tokens"),
}

# These subcommands run until a signal, and print this when they are ready. The gateway needs the
# certificates of `tls init`.
SERVE = {
    "run --port sim": "link_up",
    "sim": "acsard run --port /dev/",
    "router {}/router.json5": "listens at tcp/",
}
SERVE_WITH_TOOLS = {
    "web": "http://127.0.0.1:",
    "gateway --config {}/gateway.toml": "listens at tls/",
}


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


@contextmanager
def serving(words: list[str], expected: str, env: dict[str, str]) -> Iterator[None]:
    """Run a subcommand that serves in the block, which starts when `expected` was printed."""
    server = subprocess.Popen(
        words, env=env, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        text=True,
    )  # fmt: skip
    assert server.stdout is not None
    late = Timer(WITHIN_S, server.kill)
    late.start()
    output = ""
    try:
        while expected not in output:
            line = server.stdout.readline()
            assert line, f"{words}: {output}"
            output += line
        late.cancel()
        yield
    finally:
        late.cancel()
        server.terminate()
        rest, _ = server.communicate(timeout=WITHIN_S)
    assert server.returncode == 0, f"{words}: {output}{rest}"


def run(words: list[str], env: dict[str, str], within_s: float = WITHIN_S) -> tuple[int, str]:
    done = subprocess.run(
        words, env=env, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        text=True, timeout=within_s, check=False,
    )  # fmt: skip
    return done.returncode, done.stdout


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a directory with a wheel, the constraints, and a venv with uv and pipx."""
    pytest.importorskip("hatchling", reason="only the build needs it")
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
    daemon = f"tcp/127.0.0.1:{free_port()}"
    config.write_text(
        f'robot.id = "installed"\nbus.listen = ["{daemon}"]\n'
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
    (tmp_path / "drive.csv").write_text(usual().csv(places=False))
    (tmp_path / "router.json5").write_text(
        f'{{mode: "router", listen: {{endpoints: ["tcp/127.0.0.1:{free_port()}"]}}}}'
    )
    (tmp_path / "gateway.toml").write_text(
        f'robot.id = "installed"\nbus.tls = "{tmp_path}/tls"\n'
        f'bus.listen = ["{daemon}", "tls/127.0.0.1:{free_port()}"]\n'
    )
    what = f"acsard[{extra}] @ {wheel.as_uri()}" if extra else str(wheel)
    code, output = run(way(made, what), env, 600.0)
    assert code == 0, output
    acsard = programs / "acsard"
    code, output = run([str(acsard.resolve().parent / "python"), "-c", VERSIONS], env)
    assert code == 0, output
    installed = dict(line.split("==") for line in output.split())
    tested = {pin.name: pin.version for pin in contents.pins()}
    assert {name: tested.get(name) for name in installed} == installed

    def typed(text: str) -> list[str]:
        return [str(acsard), *text.replace("{}", str(tmp_path)).split()]

    # uv and pipx would remove an extra that the command does not name.
    lacking = {"foxglove": "foxglove,tools" if extra else "foxglove"}
    lacking |= dict.fromkeys([] if extra else ["web", *NEED_TOOLS], "tools")
    first, *others = (SERVE | (SERVE_WITH_TOOLS if extra else {})).items()
    with serving(typed(first[0]), first[1], env):
        for text, expected in (WORKS | (NEED_TOOLS if extra else {})).items():
            code, output = run(typed(text), env)
            assert (code, expected[1] in output) == (expected[0], True), f"{text}: {code} {output}"
        for text, word in others:
            with serving(typed(text), word, env):
                pass
        for text, named in lacking.items():
            code, output = run(typed(text), env)
            assert code == 1, f"{text}: {output}"
            installer = "uv tool install" if way is with_uv else "pipx install --force"
            assert f"type `{installer} 'acsard[{named}] @ file://{wheel}'`" in output, output
    tried = {text.split()[0] for text in (*WORKS, *SERVE, *SERVE_WITH_TOOLS, *lacking)}
    assert {*VERBS, *UNLISTED} <= tried


VERSIONS = """\
import importlib.metadata as m
for d in m.distributions():
    name = d.metadata["Name"].lower().replace("_", "-")
    if name not in ("acsard", "pip", "setuptools", "wheel"):
        print(f"{name}=={d.version}")
"""

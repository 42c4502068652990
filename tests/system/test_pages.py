"""Every command that a page asks the reader to type works as written, with a simulated robot.

The README's Python is run by `test_client.py`.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.pages import COMMANDS, Block, Run, blocks, promises
from tests.system.fleet_router import ROBOT_FILE, write_local_copy
from tests.system.harness import (
    ROOT,
    Bus,
    Daemon,
    Finished,
    Program,
    acsard,
    environment,
    finish,
    free_endpoint,
    until,
    write_config,
)
from tests.system.identities import free_tls_endpoint
from tests.system.test_fleet import Fleet
from tests.system.typed import typed

MARKS = {
    "README.md": [pytest.mark.slow],
    "deploy/zenoh/README.md": [pytest.mark.network, pytest.mark.nightly],
}
"""Marks for pages whose commands take long."""

TYPED = [
    pytest.param(
        block,
        id=block.where,
        marks=MARKS.get(block.page, ()),
    )
    for block in blocks()
    if any(isinstance(COMMANDS.get(command), Run) for command in block.commands())
]

INSTALL_S = 300.0
"""Time limit for an install from a distant package index."""


def find(page: str, *words: str) -> str:
    """Return the only command of a page that contains these words."""
    commands = [c for block in blocks() if block.page == page for c in block.commands()]
    (match,) = {c for c in commands if all(word in c for word in words)}
    return match


def shell(place: Path, command: str, within: float = 60.0) -> Finished:
    """Run a shell command in this directory. The commands of its `.venv` come first on the PATH."""
    path = os.pathsep.join([str(place / ".venv/bin"), os.environ["PATH"]])
    return finish(["bash", "-c", command], place, within, environment(PATH=path))


def with_acsard(place: Path) -> Path:
    """Make a `.venv` in this directory whose `acsard` command runs the code under test."""
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", place / ".venv"], check=True)
    script = place / ".venv/bin/acsard"
    script.write_text(f'#!/bin/sh\nexec {sys.executable} -m acsard "$@"\n')
    script.chmod(0o755)
    return place


@pytest.fixture(scope="module")
def desk(shared: Daemon, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Provide a directory whose `acsard` command and acsard.toml reach the running robot."""
    place = with_acsard(tmp_path_factory.mktemp("desk"))
    write_config(place / "acsard.toml", {"bus": {"listen": [shared.endpoint]}})
    return place


@pytest.mark.parametrize("block", TYPED)
def test_the_commands_on_a_page_do_what_the_page_says(block: Block, desk: Path, bus: Bus) -> None:
    if "tls init" in block.text and Path("/etc/systemd/system/acsard.service").exists():
        pytest.skip("tls init would write the drop-in of the service of this machine")
    for command in block.commands():
        how = COMMANDS.get(command)
        if isinstance(how, Run):
            done = shell(desk, command)
            assert done.code in how.codes, f"{command}\n{done.out}\n{done.err}"
            assert re.search(how.says, done.out, re.M), f"{command}\n{done.out}\n{done.err}"
            assert "Traceback" not in done.err


def test_the_flash_of_the_firmware_page_calls_avrdude_with_its_port() -> None:
    if shutil.which("make") is None:
        pytest.skip("no make")
    words = ["make", "-n", "flash", "PORT=/dev/ttyACM0"]
    assert find("deploy/firmware/README.md", "make flash").split() == ["make", *words[2:]]
    done = finish(words, ROOT / "deploy/firmware")
    assert done.code == 0, done
    assert re.search(r"avrdude .*-P /dev/ttyACM0 .*firmware\.hex", done.out)


# commands that take longer


COLLECT = """\
import json, sys
import pytest

for arguments in json.loads(sys.argv[1]):
    print("asked", arguments)
    code = pytest.main(["--collect-only", "-qq", "-p", "no:cacheprovider", *arguments])
    print("ended", int(code), arguments, flush=True)
"""
"""One process runs all of them, because imports take most of the time."""


@pytest.mark.network
@pytest.mark.timeout(600)
@pytest.mark.nightly
def test_each_call_that_proves_a_promise_finds_tests() -> None:
    asked = [words for words in promises() if any(word.startswith("tests/") for word in words)]
    done = finish([sys.executable, "-c", COLLECT, json.dumps(asked)], ROOT, 500.0)
    ended = re.findall(r"^ended (\d+) (.*)$", done.out, re.M)
    assert len(ended) == len(asked) > 20, done
    assert [words for code, words in ended if code != "0"] == []


@pytest.mark.network
@pytest.mark.nightly
def test_the_broken_board_of_the_firmware_page_is_found_broken(tmp_path: Path) -> None:
    page, place = "deploy/firmware/README.md", with_acsard(tmp_path)
    board = find(page, "acsard sim --link").split()[1:]
    with Program([sys.executable, "-m", "acsard", *board], place) as sim:
        sim.says("acsard run --port")
        done = shell(place, find(page, "--port ./mcu --yes"), 100.0)
    assert done.code == 1, done
    assert "trailing_comma = true" in done.out
    assert re.search("^FAIL +motor b ", done.out, re.M)


@pytest.mark.slow
def test_the_robot_of_the_first_page_waits_after_its_cable_is_pulled_until_it_is_back(
    tmp_path: Path,
) -> None:
    place = with_acsard(tmp_path)
    typed_there = ("acsard sim --link ./mcu", "acsard run --port ./mcu")
    board, run = ([sys.executable, "-m", *command.split()] for command in typed_there)
    write_config(place / "acsard.toml", {"bus": {"listen": [free_endpoint()]}})
    why = find("deploy/README.md", "acsard echo state")

    def stands_because(words: str) -> None:
        until(lambda: words in shell(place, why).out, 20.0, words)

    with Program(board, place) as sim:
        sim.says("acsard run --port")
        with Program(run, place):
            stands_because("ready: waiting for a command")
            sim.signal(signal.SIGINT)
            stands_because("waiting: ./mcu does not exist")
            with Program(board, place):
                stands_because("ready: waiting for a command")


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Fleet]:
    with Fleet(tmp_path_factory.mktemp("fleet")) as fleet:
        yield fleet


@pytest.mark.network
@pytest.mark.nightly
def test_the_laptop_of_the_fleet_page_does_what_its_role_may(fleet: Fleet) -> None:
    place = with_acsard(fleet.where)
    (place / "fleet").mkdir()
    (place / "fleet/clients").symlink_to(place)
    (place / "laptop-anna").symlink_to(place / "operator")
    page = "deploy/zenoh/README.md"
    story = [
        (find(page, "echo state", "laptop-anna"), 0, '"mode":"ready"'),
        (find(page, "call stop", "--id robot1 ", "laptop-anna"), 0, "stopped and latched"),
        (find(page, "echo state", "viewer"), 0, '"mode":"stopped"'),
        (find(page, "call clear", "viewer"), 77, ""),
        (find(page, "call clear", "operator"), 0, "cleared"),
        (find(page, "call stop", "viewer"), 0, "stopped and latched"),
    ]
    for command, code, text in story:
        done = shell(place, command.replace("tls/router.local:7447", fleet.endpoint))
        assert (done.code, text in done.out) == (code, True), f"{command}\n{done}"


@pytest.mark.network
@pytest.mark.nightly
def test_one_authority_and_one_file_serve_the_ten_robots_of_the_fleet_page(tmp_path: Path) -> None:
    page, place = "deploy/zenoh/README.md", with_acsard(tmp_path)
    for words in ("tls init", "tls add router", "tls add robot$n", "tls add laptop", "tls router"):
        done = shell(place, find(page, words).replace("192.168.1.10", "127.0.0.1"))
        assert done.code == 0, done
    clients, endpoint = place / "fleet/clients", free_tls_endpoint()
    authority = (place / "fleet/ca.pem").read_bytes()
    for n in range(1, 11):
        made = {file.name: file.read_bytes() for file in (clients / f"robot{n}").iterdir()}
        assert made.keys() == {"ca.pem", "certificate.pem", "key.pem"}
        assert made["ca.pem"] == authority
    own = tomllib.loads(ROBOT_FILE.read_text())
    own["robot"]["id"] = "robot10"
    own["bus"] |= {"connect": [endpoint], "tls": str(clients / "robot10")}
    file = write_local_copy(place / "router.json5", clients, endpoint)
    with Program(acsard("router", str(file)), place) as program:
        until(lambda: "router_open" in program.stderr, 20.0, "the router")
        with Daemon(place, config=own, name="robot10", ready=False):

            def code(name: str, *words: str) -> int:
                by = ("--id", "robot10", "--connect", endpoint, "--tls", str(clients / name))
                return typed(*words, *by).code

            until(lambda: code("laptop-anna", "call", "stop") == 0, 30.0, "the tenth robot")
            assert code("robot1", "call", "clear") != 0
            assert code("laptop-anna", "call", "clear") == 0


# commands that install from an index


@pytest.fixture
def clone(tmp_path: Path) -> Path:
    """Copy the files of a clone, without build products."""
    place = tmp_path / "clone"
    for name in ("acsard", "deploy"):
        made = shutil.ignore_patterns("__pycache__", "build")
        shutil.copytree(ROOT / name, place / name, ignore=made)
    for name in ("pyproject.toml", "acsard.toml", "README.md", "LICENSE", "CHANGELOG.md"):
        shutil.copy(ROOT / name, place / name)
    return place


def of_a_stranger(**more: str) -> dict[str, str]:
    """Return an environment without PYTHONPATH, in which Python imports only installed packages."""
    env = environment(**more)
    del env["PYTHONPATH"]
    return env


@pytest.mark.network
@pytest.mark.nightly
@pytest.mark.timeout(2 * INSTALL_S)
def test_the_first_command_of_the_readme_installs_it_and_the_robot_is_up(clone: Path) -> None:
    endpoint = free_endpoint()  # port 7448 may be in use here
    config = write_config(clone.parent / "other.toml", {"bus": {"listen": [endpoint]}})
    env = of_a_stranger(ACSARD_CONFIG=str(config))
    words = ["bash", "-c", find("README.md", "'.[tools]'")]
    with Program(words, clone, env, start_new_session=True) as program:
        try:
            program.says(endpoint, INSTALL_S)
            with Bus(endpoint) as bus:
                assert bus.get("info")["simulated"] is True
        finally:
            os.killpg(program.pid, signal.SIGTERM)  # the shell, and the daemon under it


@pytest.mark.network
@pytest.mark.nightly
@pytest.mark.timeout(2 * INSTALL_S)
def test_the_service_s_venv_has_all_that_lan_and_service_need(clone: Path) -> None:
    page, venv = "deploy/systemd/README.md", clone / ".venv"
    wanted = [
        find(page, "python3 -m venv"),
        find(page, ".venv/bin/pip install -r"),
        find(page, ".venv/bin/pip install --no-deps"),
        f"{venv}/bin/acsard tls init --directory {clone.parent}/tls",
    ]
    for command in wanted:
        done = finish(["bash", "-c", command], clone, INSTALL_S, of_a_stranger())
        assert done.code == 0, done
    files = finish([str(venv / "bin/acsard"), "service", "install", "--dry-run"], clone.parent)
    assert "acsard.service" in files.out
    router = finish([str(venv / "bin/acsard"), "tls", "router", "robot7"], clone.parent)
    assert '"acsard/robot7/srv/stop"' in router.out


@pytest.mark.network
@pytest.mark.timeout(2 * INSTALL_S)
@pytest.mark.nightly
def test_the_install_line_of_the_fleet_page_suffices_to_make_its_authority(
    clone: Path,
) -> None:
    page = "deploy/zenoh/README.md"
    typed = [find(page, words) for words in ("pip install", "bin/activate", "tls init")]
    done = finish(["bash", "-ec", "\n".join(typed)], clone, INSTALL_S, of_a_stranger())
    assert done.code == 0, done
    assert (clone / "fleet/ca-key.pem").is_file()

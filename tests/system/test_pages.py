"""The commands of the pages, typed as written, work with a simulated robot and print what is shown.

`<!-- not run: ... -->` on a page exempts commands, as `tests/pages.py` says.
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from tests.pages import PAGES, ROOT, blocks
from tests.system.fleet_router import ROBOT_FILE, write_local_copy
from tests.system.harness import (
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
from tests.system.typed import typed

# On a computer without a board or with a fault they name it, and exit with 1.
REPORTS = ("acsard ports", "acsard doctor")

INSTALL_S = 300.0  # for an install from a distant package index

RUN = [page for page in PAGES if any(block.page == page and block.run() for block in blocks())]


def find(page: str, *words: str) -> str:
    """Return the only command of a page that contains these words."""
    commands = {c for block in blocks() if block.page == page for c in block.commands()}
    (match,) = (command for command in commands if all(word in command for word in words))
    return match


def shell(place: Path, command: str) -> Finished:
    """Run a shell command in this directory. The commands of its `.venv` come first on the PATH."""
    path = os.pathsep.join([str(place / ".venv/bin"), os.environ["PATH"]])
    return finish(["bash", "-c", command], place, 60.0, environment(PATH=path))


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


def words(line: str) -> set[str]:
    """Return the words of a printed line that no robot, person or time changes."""
    return set(re.findall(r"(?<!\S)[a-z]+(?!\S)", line))


@pytest.mark.slow
@pytest.mark.parametrize("page", RUN)
def test_the_commands_of_a_page_work_and_print_what_it_shows(page: str, desk: Path) -> None:
    if Path("/etc/systemd/system/acsard.service").exists():
        pytest.skip("`acsard tls init` would write the drop-in of the service of this machine")
    for block in (block for block in blocks("sh", "console") if block.page == page):
        output = ""
        for command in block.run():
            done = shell(desk, command)
            assert done.code in ((0, 1) if command in REPORTS else (0,)), f"{command}\n{done}"
            assert "Traceback" not in done.err, f"{command}\n{done}"
            output += f"{done.out}\n"
        for line in block.printed() if block.run() else ():
            assert any(words(line) <= words(other) for other in output.splitlines()), (
                f"{line}\n{output}"
            )


def test_the_flash_of_the_firmware_page_calls_avrdude_with_its_port() -> None:
    if shutil.which("make") is None:
        pytest.skip("no make")
    command = find("deploy/manual/pages/howto/flash.md", "make flash").replace("make", "make -n", 1)
    done = finish(command.split(), ROOT / "deploy/firmware")
    assert done.code == 0, done
    assert re.search(r"avrdude .*-P /dev/ttyACM0 .*firmware\.hex", done.out)


@pytest.mark.network
@pytest.mark.nightly
def test_one_authority_and_one_file_serve_the_ten_robots_of_the_fleet_page(tmp_path: Path) -> None:
    place = with_acsard(tmp_path)
    for part in ("tls init", "tls add router", "tls add robot$n", "tls add laptop", "tls router"):
        command = find("deploy/manual/pages/howto/fleet.md", part).replace(
            "192.168.1.10", "127.0.0.1"
        )
        done = shell(place, command)
        assert done.code == 0, done
    clients, endpoint = place / "fleet/clients", free_tls_endpoint()
    for n in range(1, 11):
        names = {file.name for file in (clients / f"robot{n}").iterdir()}
        assert names == {"ca.pem", "certificate.pem", "key.pem"}
    own = tomllib.loads(ROBOT_FILE.read_text())
    own["robot"]["id"] = "robot10"
    own["bus"] |= {"connect": [endpoint], "tls": str(clients / "robot10")}
    file = write_local_copy(place / "router.json5", clients, endpoint)
    with Program(acsard("router", str(file)), place) as program:
        until(lambda: "router_open" in program.stderr, 20.0, "the router")
        with Daemon(place, config=own, name="robot10", ready=False):

            def code(name: str, verb: str) -> int:
                by = ("--id", "robot10", "--connect", endpoint, "--tls", str(clients / name))
                return typed("call", verb, *by).code

            until(lambda: code("laptop", "stop") == 0, 30.0, "the tenth robot")
            assert code("robot1", "clear") != 0
            assert code("laptop", "clear") == 0


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
    command = ["bash", "-c", find("README.md", "'.[tools]'")]
    with Program(command, clone, env, start_new_session=True) as program:
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
    page, venv = "deploy/manual/pages/howto/install.md", clone / ".venv"
    for command in (
        find(page, "python3 -m venv"),
        find(page, ".venv/bin/pip install -r"),
        find(page, ".venv/bin/pip install --no-deps"),
        f"{venv}/bin/acsard tls init --directory {clone.parent}/tls",
    ):
        done = finish(["bash", "-c", command], clone, INSTALL_S, of_a_stranger())
        assert done.code == 0, done
    files = finish([str(venv / "bin/acsard"), "service", "install", "--dry-run"], clone.parent)
    assert "acsard.service" in files.out
    router = finish([str(venv / "bin/acsard"), "tls", "router", "robot7"], clone.parent)
    assert '"acsard/robot7/srv/stop"' in router.out

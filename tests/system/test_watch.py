"""Two robots of a fleet are watched by Prometheus as the page "Watch a fleet" says.

The second test runs Prometheus itself, if it is there (Debian: `prometheus`).
"""

from __future__ import annotations

import json
import os
import re
import shutil
import ssl
import subprocess
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

from acsard.machine.authority import Authority
from tests.pages import ROOT, blocks
from tests.system.fleet_router import ITS_NAME, ROBOTS, certified, robot_at, router
from tests.system.harness import Program, acsard, environment, finish, free_endpoint, until
from tests.system.identities import free_tls_endpoint
from tests.system.typed import typed

pytestmark = [pytest.mark.network, pytest.mark.skipif(shutil.which("jq") is None, reason="no jq")]

FILES = ROOT / "deploy/prometheus"
PAGE = "deploy/manual/pages/howto/watch.md"
PROMETHEUS = shutil.which("prometheus")


class Watched:
    """Prometheus's directory, and the address of the page of each robot."""

    def __init__(self, where: Path, stack: ExitStack) -> None:
        self.where, self.stack, self.pages = where, stack, dict[str, Program]()
        self.ports = {name: free_endpoint().rpartition(":")[2] for name in ROBOTS}
        endpoint = free_tls_endpoint()
        certified(where, "operator", ITS_NAME)
        for name in ROBOTS:
            Authority.load(where).issue(where / name, name, [f"{name}.local", "127.0.0.1"], 1.0)
        stack.enter_context(router(where, endpoint)).says("routing")
        make, *_ = (line for block in self.blocks() for line in block if "openssl" in line)
        subprocess.run(["sh", "-c", make], cwd=where, check=True)
        for name in ROBOTS:
            self._start(name, endpoint)
        self._configure(endpoint)

    @staticmethod
    def blocks() -> Iterator[list[str]]:
        return (block.commands() for block in blocks("sh") if block.page == PAGE)

    def _start(self, name: str, endpoint: str) -> None:
        daemon = self.stack.enter_context(robot_at(endpoint, self.where, name, ready=False))
        daemon.says("bus ")
        env = environment(STATE_DIRECTORY=str(self.where / f"{name}.tokens"))
        told = [
            "--config",
            str(daemon.config),
            "--address",
            f"https://127.0.0.1:{self.ports[name]}",
        ]
        (invite,) = (line for block in self.blocks() for line in block if "web invite" in line)
        words = re.sub(r"--config \S+ ", "", invite.partition("web invite ")[2]).split()
        done = finish(acsard("web", *told, "invite", *words), self.where, env=env)
        assert done.code == 0, done
        assert (self.where / "prometheus.token").read_text().strip() not in done.out
        page = Program(acsard("web", *told), self.where, env)
        self.stack.enter_context(page).says("page ")
        self.pages[name] = page

    def _configure(self, endpoint: str) -> None:
        shutil.copytree(FILES, self.where, dirs_exist_ok=True)
        shutil.copy(self.where / "operator/ca.pem", self.where)
        where = ["--id", ",".join(ROBOTS), "--connect", endpoint, "--tls", self.where / "operator"]
        seen = typed("fleet", "--json", *map(str, where))
        assert seen.code == 0, seen
        (command,) = (line for block in self.blocks() for line in block if "> robots.json" in line)
        jq = command.partition("|")[2]
        subprocess.run(["sh", "-c", jq], cwd=self.where, input=seen.out, text=True, check=True)
        targets = (self.where / "robots.json").read_text()
        for name, port in self.ports.items():
            assert f"{name}.local:8443" in targets
            targets = targets.replace(f"{name}.local:8443", f"{name}.local:{port}")
        (self.where / "robots.json").write_text(targets)


@pytest.fixture(scope="module")
def watched(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Watched]:
    with ExitStack() as stack:
        yield Watched(tmp_path_factory.mktemp("watched"), stack)


def test_each_target_answers_the_token_and_nobody_else(watched: Watched) -> None:
    (job,) = YAML(typ="safe").load((watched.where / "prometheus.yml").read_text())["scrape_configs"]
    trusted = ssl.create_default_context(cafile=str(watched.where / job["tls_config"]["ca_file"]))
    file = job["authorization"]["credentials_file"]
    token = (watched.where / file).read_text().strip()
    (group,) = json.loads((watched.where / "robots.json").read_text())
    for name, target in zip(ROBOTS, group["targets"], strict=True):
        port = target.rpartition(":")[2]
        # A client that calls the page by a name of the robot is one of another host.
        away = {"Host": target}
        request = urllib.request.Request(
            f"{job['scheme']}://127.0.0.1:{port}/metrics", headers=away
        )
        with pytest.raises(urllib.error.HTTPError, match="401"):
            urllib.request.urlopen(request, context=trusted)
        request.add_header("Authorization", f"Bearer {token}")
        up = f'acsard_up{{robot="{name}"}} 1.0'

        def look(request: urllib.request.Request = request, up: str = up) -> bool:
            with urllib.request.urlopen(request, context=trusted) as answer:
                return up in answer.read().decode()

        until(look, 10.0, up)


@pytest.mark.nightly
@pytest.mark.skipif(PROMETHEUS is None or os.geteuid() != 0, reason="no prometheus, or not root")
def test_prometheus_sees_both_robots_and_one_that_is_gone(watched: Watched) -> None:
    config = watched.where / "prometheus.yml"
    config.write_text(config.read_text().replace("scrape_interval: 5s", "scrape_interval: 1s"))
    alerts = watched.where / "alerts.yml"
    alerts.write_text(alerts.read_text().replace("for: 1m", "for: 1s"))
    config.write_text(
        config.read_text().replace("global:\n", "global:\n  evaluation_interval: 1s\n")
    )
    address = free_endpoint().removeprefix("tcp/")
    words = [f"--config.file={config}", f"--storage.tsdb.path={watched.where / 'data'}"]
    words += [f"--web.listen-address={address}"]
    # In a mount namespace of its own, the names of the robots are this machine.
    (watched.where / "hosts").write_text("".join(f"127.0.0.1 {name}.local\n" for name in ROBOTS))
    script = f'mount --bind {watched.where}/hosts /etc/hosts && exec "$@"'
    with Program(
        ["unshare", "-m", "sh", "-c", script, "sh", str(PROMETHEUS), *words], watched.where
    ):

        def asked(path: str) -> Any:
            try:
                with urllib.request.urlopen(f"http://{address}/api/v1/{path}") as answer:
                    return json.load(answer)["data"]
            except OSError:
                return {}

        def query(expression: str) -> list[Any]:
            found = asked(f"query?query={urllib.parse.quote(expression)}").get("result", [])
            return [(item["metric"].get("robot"), item["value"][1]) for item in found]

        both = [(name, "1") for name in ROBOTS]
        until(lambda: sorted(query("acsard_up")) == both, 30.0, "both are up")
        assert {name for name, _ in query('acsard_mode{mode="ready"} == 1')} <= set(ROBOTS)
        watched.pages["robot2"].__exit__()

        def firing() -> list[tuple[str, str]]:
            found = [item["labels"] for item in asked("alerts").get("alerts", [])]
            return [(labels["alertname"], labels.get("robot", "")) for labels in found]

        until(lambda: ("RobotGone", "robot2") in firing(), 30.0, "the alert")
        assert ("RobotGone", "robot1") not in firing()
        # A token that is taken back makes the robot unseen, too.
        (watched.where / "prometheus.token").write_text(64 * "0")
        until(lambda: ("RobotGone", "robot1") in firing(), 30.0, "the other alert")

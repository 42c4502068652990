"""Alert rules, configuration and board use metrics that the page has, and do what they say.

`promtool`, if it is there, checks the files and plays the night of `alerts_test.yml`.
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from collections.abc import Iterator
from itertools import combinations
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

from acsard.core.link.link_state import LinkState
from acsard.core.messages.state_warnings import WARNING_KINDS
from acsard.core.motion.modes import Mode
from tests.pages import ROOT, text_of
from tests.tools.interface import names

FILES = ROOT / "deploy/prometheus"
BOARD = json.loads((FILES / "board.json").read_text())
PROMTOOL = shutil.which("promtool")


def yaml(name: str) -> Any:
    return YAML(typ="safe").load((FILES / name).read_text())


RULES = yaml("alerts.yml")["groups"][0]["rules"]


def expressions() -> Iterator[str]:
    yield from (rule["expr"] for rule in RULES)
    yield from (target["expr"] for panel in BOARD["panels"] for target in panel["targets"])


def test_rules_and_board_ask_for_metrics_and_labels_that_the_page_has() -> None:
    metrics = {name.removeprefix("http/Metrics/") for name in names() if "http/Metrics/" in name}
    counters = {name.removeprefix("counters/") for name in names() if name.startswith("counters/")}
    latencies = {
        name.removeprefix("counters/Latencies/") for name in names() if "Latencies" in name
    }
    asked: dict[str, set[str]] = {}
    for expression in expressions():
        for metric, labels in re.findall(r"(acsard_\w+)(?:{([^}]*)})?", expression):
            assert metric in metrics, expression
            for label, values in re.findall(r'(\w+)(?:=|=~|!~)"([^"]+)"', labels):
                asked.setdefault(f"{metric} {label}", set()).update(values.split("|"))
    assert asked.pop("acsard_mode mode") <= set(Mode)
    assert asked.pop("acsard_link state") <= set(LinkState.__args__)  # type: ignore[attr-defined]
    assert asked.pop("acsard_warning what") <= set(WARNING_KINDS)
    assert asked.pop("acsard_robot_total what") - {"line_.+"} <= counters
    assert "line_<reason>" in counters
    assert asked.pop("acsard_latency_seconds latency") <= latencies
    assert asked.pop("acsard_latency_seconds at") <= {"p50", "p99", "max"}
    assert {key.split()[1] for key in asked} == {"robot"}


def test_each_alert_is_urgent_or_not_and_the_page_has_the_same_words() -> None:
    for rule in RULES:
        assert rule["labels"]["severity"] in ("page", "ticket"), rule["alert"]
        assert "$labels.robot" in rule["annotations"]["summary"] or "count(" in rule["expr"]
    assert re.findall(r"< (\d+ \* )?86400", yaml_text := (FILES / "alerts.yml").read_text())
    assert "30 * 86400" in yaml_text


def test_the_configuration_names_the_files_that_the_page_makes() -> None:
    (job,) = yaml("prometheus.yml")["scrape_configs"]
    page = text_of("deploy/manual/pages/howto/watch.md")
    (targets,) = job["file_sd_configs"][0]["files"]
    for file in (job["tls_config"]["ca_file"], job["authorization"]["credentials_file"], targets):
        assert f"`{file}`" in page
    assert job["honor_labels"], "the label robot of a metric wins over that of the address"
    (relabel,) = job["relabel_configs"]
    found = re.fullmatch(relabel["regex"], "robot1.local:8443")
    assert found is not None
    assert found[1] == "robot1"


def test_the_panels_of_the_board_have_a_place_of_their_own() -> None:
    panels = BOARD["panels"]
    assert len({panel["id"] for panel in panels}) == len(panels)
    for panel in panels:
        place = panel["gridPos"]
        assert place["x"] + place["w"] <= 24
        assert panel["datasource"]["uid"] == "${source}"
    for one, other in combinations([panel["gridPos"] for panel in panels], 2):
        beside = one["x"] + one["w"] <= other["x"] or other["x"] + other["w"] <= one["x"]
        below = one["y"] + one["h"] <= other["y"] or other["y"] + other["h"] <= one["y"]
        assert beside or below
    variables = {item["name"] for item in BOARD["templating"]["list"]}
    used = set(re.findall(r"\$\{?(\w+)", json.dumps(panels)))
    assert used == variables == {"source", "robot"}


@pytest.mark.skipif(PROMTOOL is None, reason="no promtool (Debian: prometheus)")
def test_promtool_accepts_the_files_and_plays_the_night(tmp_path: Path) -> None:
    shutil.copytree(FILES, tmp_path, dirs_exist_ok=True)
    for name in ("ca.pem", "prometheus.token"):
        (tmp_path / name).touch()
    (tmp_path / "robots.json").write_text('[{"targets": ["robot1.local:8443"]}]')
    panels = [target["expr"] for panel in BOARD["panels"] for target in panel["targets"]]
    rules = [
        {"record": f"board:{number}", "expr": expression.replace("$robot", ".*")}
        for number, expression in enumerate(panels)
    ]
    (tmp_path / "board.yml").write_text(json.dumps({"groups": [{"name": "b", "rules": rules}]}))
    for words in (
        ["check", "config", "prometheus.yml"],
        ["check", "rules", "alerts.yml", "board.yml"],
        ["test", "rules", "alerts_test.yml"],
    ):
        done = subprocess.run(
            [str(PROMTOOL), *words], cwd=tmp_path, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stdout + done.stderr

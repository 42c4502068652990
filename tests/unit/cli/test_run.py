"""Tests of the configuration keys that the command line of `run` can set."""

from __future__ import annotations

import sys

import pytest

from acsard.cli import parser, run
from acsard.cli.common import overrides
from acsard.core.config.parsing import parse
from acsard.core.config.settings import Config, McuConfig, WebConfig
from acsard.machine.doctor import OPTION_KEYS
from tests.each import each


def given_by(*words: str) -> dict[str, dict[str, object]]:
    return overrides(run.options(parser(["run"]).parse_args(["run", *words])))


def test_without_options_nothing_is_overridden() -> None:
    assert given_by() == {}


def test_the_options_are_the_keys_of_the_configuration() -> None:
    flags = given_by("--port", "/dev/x", "--baud-rate", "57600", "--id", "r7", "--namespace", "a/b",
                     "--listen", "tcp/127.0.0.1:1", "--connect", "tcp/[::1]:2")  # fmt: skip
    config = parse(b"", flags)
    assert (config.mcu.port, config.mcu.baud_rate) == ("/dev/x", 57600)
    assert (config.robot.id, config.ros.namespace) == ("r7", "a/b")
    assert config.bus.listen == ("tcp/127.0.0.1:1",)
    assert config.bus.connect == ("tcp/[::1]:2",)


def test_the_doctor_knows_every_key_that_options_set() -> None:
    flags = given_by("--port", "x", "--baud-rate", "9600", "--id", "r", "--namespace", "n",
                     "--record", "d", "--listen", "tcp/127.0.0.1:1", "--connect", "tcp/127.0.0.1:2",
                     )  # fmt: skip
    keys = {f"{section}.{key}" for section, values in flags.items() for key in values}
    assert keys == set(OPTION_KEYS)


@each(
    ("words", "table"),
    [
        (["--port", "x"], "mcu"),
        (["--id", "x"], "robot"),
        (["--namespace", "x"], "ros"),
        (["--listen", "tcp/[::1]:1"], "bus"),
        (["--connect", "tcp/[::1]:1"], "bus"),
    ],
)
def test_one_option_changes_its_own_table_only(words: list[str], table: str) -> None:
    flags = given_by(*words)
    assert list(flags) == [table]
    config, default = parse(b"", flags), Config()
    changed = [n for n in Config.__struct_fields__ if getattr(config, n) != getattr(default, n)]
    assert changed == [table]


def test_the_banner_distinguishes_a_simulator_from_a_robot() -> None:
    simulated = run.banner(Config(), "acsard.toml", "/dev/pts/3")
    config = Config(mcu=McuConfig(port="/dev/ttyUSB0"))
    real = run.banner(config, "acsard.toml", "/dev/ttyUSB0")
    missing = run.banner(config, "acsard.toml", "/dev/ttyUSB0", "/dev/ttyUSB0 is not there")
    assert "SIMULATOR" in simulated
    assert "no real robot will move" in simulated
    assert "SIMULATOR" not in real
    assert "none yet: /dev/ttyUSB0 is not there" in missing
    assert "/dev/ttyUSB0 at 115200 baud" in real
    assert all("acsard/acsar/..." in text and "acsard.toml" in text for text in (simulated, real))


def test_the_banner_has_what_a_newcomer_types_next_and_the_page_where_it_is_served() -> None:
    web = WebConfig(address=("http://127.0.0.1:8080", "https://0.0.0.0:8443"))
    config = Config(web=web)
    silent, served = (
        run.banner(config, "x.toml", "/dev/x", served=enabled) for enabled in (False, True)
    )
    for banner in (silent, served):
        tries = [line.split("  ")[0] for line in map(str.strip, banner.splitlines())]
        assert tries[-3:] == ["acsard drive", "acsard top", "acsard call stop"]
    assert "  page    http://127.0.0.1:8080, https://0.0.0.0:8443, for a browser; " in served
    assert "page" not in silent
    assert served.count("\n") == silent.count("\n") + 1


def test_the_banner_s_tools_reach_this_daemon_and_no_other() -> None:
    bare = parser(["run"]).parse_args(["run"])
    assert run.reach(bare) == ""
    words = ["run", "--id", "two", "--listen", "tcp/0.0.0.0:7458", "--config", "my robot.toml"]
    options = run.reach(parser(["run"]).parse_args(words))
    assert options == " --config 'my robot.toml' --connect tcp/127.0.0.1:7458 --id two"
    banner = run.banner(Config(), "acsard.toml", "/dev/pts/3", reach=options)
    assert f"acsard call stop{options} " in banner


def test_on_a_terminal_the_page_is_served_unless_it_is_disabled_or_missing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv("INVOCATION_ID", raising=False)
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    words = run.page(Config(), "nowhere.toml")
    assert words is not None
    assert words[:3] == ["web", "--id", "acsar"]
    assert run.page(Config(web=WebConfig(page=False)), "nowhere.toml") is None
    monkeypatch.setattr(run, "find_spec", lambda name: None)  # as if the extra were not installed
    assert run.page(Config(), "nowhere.toml") is None

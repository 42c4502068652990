"""Which file and which robot a tool takes, `check`, and the banner of `run`."""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from collections.abc import Callable, Iterable
from pathlib import Path

import pytest

from acsard.cli import parser, run
from acsard.cli.check import main
from acsard.cli.common import load, overrides, with_record_directory
from acsard.cli.robot_options import require_readable, robot_address
from acsard.core.config.parsing import parse
from acsard.core.config.settings import BusConfig, Config, McuConfig, WebConfig
from acsard.host import config_file
from acsard.host.config_file import SEARCH_PATHS, find
from acsard.host.errors import CertificateError, Exit, MendableError, UsageError
from acsard.host.version import version
from acsard.machine.authority import Authority
from acsard.machine.examination import OPTION_KEYS
from tests.system.typed import typed

DEFAULTS = "built-in defaults"


class Places:
    """The four places for a configuration file, all empty and in a temporary directory."""

    def __init__(self, root: Path) -> None:
        self.option = root / "option.toml"
        self.variable = root / "variable.toml"
        self.here = root / "here" / "acsard.toml"
        self.etc = root / "etc.toml"

    def fill(self) -> None:
        for place in (self.option, self.variable, self.here, self.etc):
            place.write_text(f'[robot]\nid = "{place.parent.name[:4]}-{place.stem}"\n')


@pytest.fixture(name="places")
def _places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Places:
    """Set up a machine without any configuration file.

    No option or variable names a file, and there is no file in this directory or in /etc.
    """
    places = Places(tmp_path)
    places.here.parent.mkdir()
    monkeypatch.chdir(places.here.parent)
    monkeypatch.delenv("ACSARD_CONFIG", raising=False)
    monkeypatch.setattr(config_file, "SEARCH_PATHS", (SEARCH_PATHS[0], places.etc))
    return places


@pytest.mark.parametrize(
    ("option", "variable", "there", "found"),
    [
        ("option", "variable", ("here", "etc"), "option"),
        (None, "variable", ("here", "etc"), "variable"),
        (None, None, ("here", "etc"), "here"),
        (None, "", ("here", "etc"), "here"),
        (None, None, ("etc",), "etc"),
        (None, None, (), ""),
    ],
)
def test_the_option_wins_then_the_variable_then_the_file_here_and_that_in_etc(
    places: Places, monkeypatch: pytest.MonkeyPatch,
    option: str | None, variable: str | None, there: tuple[str, ...], found: str,
) -> None:  # fmt: skip
    places.fill()
    for name in {"here", "etc"} - {*there}:
        getattr(places, name).unlink()
    if variable is not None:
        monkeypatch.setenv("ACSARD_CONFIG", variable and str(places.variable))
    where, text = find(option and str(places.option))
    if not found:
        assert (where, text, load(None)) == (DEFAULTS, b"", (DEFAULTS, Config()))
        return
    assert where == ("acsard.toml" if found == "here" else str(getattr(places, found)))
    assert text == getattr(places, found).read_bytes()


def test_a_named_file_that_is_missing_is_an_error_and_never_replaced(
    places: Places, monkeypatch: pytest.MonkeyPatch
) -> None:
    places.fill()
    for place in (places.variable, places.here):
        place.unlink()
    monkeypatch.setenv("ACSARD_CONFIG", str(places.variable))
    with pytest.raises(MendableError) as caught:
        find(None)
    assert caught.value.code == Exit.BAD_CONFIG
    monkeypatch.delenv("ACSARD_CONFIG")
    places.here.mkdir()
    with pytest.raises(MendableError):
        find(None)


def address_of(
    config: Path,
    connect: str | None = None,
    robot_id: str | None = None,
    tls: str | None = None,
) -> tuple[str, str, str]:
    where = robot_address(
        argparse.Namespace(config=str(config), connect=connect, id=robot_id, tls=tls)
    )
    return where.endpoint, where.robot_id, where.tls


def test_the_options_of_a_tool_win_over_the_configuration(places: Places) -> None:
    places.fill()
    assert address_of(places.option, "tcp/10.0.0.1:1", "r8") == ("tcp/10.0.0.1:1", "r8", "")
    assert address_of(places.option, robot_id="r8") == ("tcp/127.0.0.1:7448", "r8", "")


def test_a_certificate_needs_a_tls_endpoint(
    places: Places, monkeypatch: pytest.MonkeyPatch
) -> None:
    places.option.write_text(
        '[bus]\nlisten = ["tls/0.0.0.0:7449", "tcp/127.0.0.1:8"]\ntls = "/etc/acsard/tls"\n'
    )
    assert address_of(places.option) == ("tcp/127.0.0.1:8", "acsar", "")
    assert address_of(places.option, "tls/robot:7449")[2] == "/etc/acsard/tls"
    monkeypatch.setenv("ACSARD_TLS", "/home/a")
    assert address_of(places.option, "tls/robot:7449")[2] == "/home/a"
    assert address_of(places.option, "tls/robot:7449", tls="/home/b")[2] == "/home/b"


def test_a_key_that_does_not_exist_is_refused_with_the_near_name() -> None:
    for key in ("odom", "cmd/stranger", "cmd/app/x/y", "json/odom", "wheel_cmd/x", "*", "sim/**"):
        require_readable(key, "echo")
    with pytest.raises(UsageError, match="odmo is not a key of the robot: did you mean odom"):
        require_readable("odmo", "echo")


def test_the_record_directory_is_from_the_option_the_file_or_the_service_in_this_order(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    data = b'[record]\ndirectory = "/file"'
    named, in_file = parse(data, {"record": {"directory": "/option"}}), parse(data)
    assert with_record_directory(Config()).record.directory == ""
    monkeypatch.setenv("ACSARD_RECORD", "/service")
    directories = [
        with_record_directory(config).record.directory for config in (named, in_file, Config())
    ]
    assert directories == ["/option", "/file", "/service"]


def test_a_good_file_is_printed_with_its_place_and_its_warnings(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "robot.toml"
    file.write_text("[mcu]\nbaud_rate = 9600\n[control]\nrate = 29\n")
    assert main(argparse.Namespace(config=str(file), json=False, new=None)) == 0
    out, err = capsys.readouterr()
    assert out.startswith(f"# effective configuration from {file}\n")
    assert parse(out.encode()) == parse(file.read_bytes())
    assert err.startswith(f"{file}: warning: control.rate = 29 ")
    assert err.endswith(f"\n{file}: no mistakes, 1 warning\n")


def test_certificates_that_the_daemon_would_refuse_are_a_mistake(tmp_path: Path) -> None:
    file = tmp_path / "robot.toml"
    file.write_text(
        f'[bus]\nlisten = ["tls/127.0.0.1:7449", "tcp/127.0.0.1:7448"]\ntls = "{tmp_path}"\n'
    )
    with pytest.raises(CertificateError, match="cannot read"):
        main(argparse.Namespace(config=str(file), json=False, new=None))


def test_a_certificate_that_has_expired_is_a_mistake_and_one_that_soon_will_a_warning(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tls, file = tmp_path / "tls", tmp_path / "robot.toml"
    tls.mkdir()
    file.write_text(
        f'[bus]\nlisten = ["tls/127.0.0.1:7449", "tcp/127.0.0.1:7448"]\ntls = "{tls}"\n'
    )
    args = argparse.Namespace(config=str(file), json=False, new=None)
    authority = Authority.make(tls, "test", 3650)
    authority.issue(tls, "robot", [], 10)
    assert main(args) == 0
    assert "expires in 10 days; run `acsard tls renew" in capsys.readouterr().err
    authority.issue(tls, "robot", [], -1)
    with pytest.raises(MendableError, match=r"expired 24 hours ago.*acsard tls renew"):
        main(args)


@pytest.mark.parametrize("sign", [">", ">>"])
def test_a_file_that_is_read_is_not_the_output_too(tmp_path: Path, sign: str) -> None:
    file = tmp_path / "robot.toml"
    file.write_text("[mcu]\nbaud_rate = 57600\n")
    done = subprocess.run(
        ["sh", "-c", f'"{sys.executable}" -m acsard check {sign} robot.toml'],
        cwd=tmp_path, env=os.environ | {"ACSARD_CONFIG": "robot.toml"}, capture_output=True,
        text=True, timeout=30.0, check=False,
    )  # fmt: skip
    assert done.returncode == Exit.FAILURE
    assert "the output goes into robot.toml, which acsard reads" in done.stderr
    assert file.read_text() == ("" if sign == ">" else "[mcu]\nbaud_rate = 57600\n")


def test_a_new_file_has_the_explained_defaults_and_is_never_written_twice(tmp_path: Path) -> None:
    file = tmp_path / "robot.toml"
    args = parser(["check"]).parse_args(["check", "--new", str(file)])
    assert main(args) == 0
    assert file.read_bytes() == Path("acsard.toml").read_bytes()
    file.write_text("[mcu]\nbaud_rate = 57600\n")
    with pytest.raises(MendableError, match="exists already, and was not changed"):
        main(args)
    assert file.read_text() == "[mcu]\nbaud_rate = 57600\n"


def given_by(words: Iterable[str]) -> dict[str, object]:
    """Return the values that these words of `acsard run` set, by their keys."""
    found = overrides(run.options(parser(["run"]).parse_args(["run", *words])))
    return {f"{table}.{key}": value for table, keys in found.items() for key, value in keys.items()}


def test_each_option_sets_its_key_and_no_other_and_the_doctor_knows_them() -> None:
    words = {
        ("--port", "/dev/x"): ("mcu.port", "/dev/x"),
        ("--id", "r7"): ("robot.id", "r7"),
        ("--namespace", "a/b"): ("ros.namespace", "a/b"),
        ("--record", "d"): ("record.directory", "d"),
        ("--listen", "tcp/127.0.0.1:1"): ("bus.listen", ["tcp/127.0.0.1:1"]),
        ("--connect", "tcp/[::1]:2"): ("bus.connect", ["tcp/[::1]:2"]),
    }
    assert given_by(()) == {}
    for options, (key, value) in words.items():
        assert given_by(options) == {key: value}
        assert parse(b"", {key.partition(".")[0]: {key.partition(".")[2]: value}}) != Config()
    assert {key for key, _ in words.values()} == set(OPTION_KEYS)


def test_the_banner_has_the_approved_words(approved: Callable[[Path, str], None]) -> None:
    """It tells a simulator from a robot, and what a newcomer types next reaches this daemon."""
    assert run.reach(parser(["run"]).parse_args(["run"])) == ""
    words = ["run", "--id", "two", "--listen", "tcp/0.0.0.0:7458", "--config", "my robot.toml"]
    reach = run.reach(parser(["run"]).parse_args(words))
    real = Config(mcu=McuConfig(port="/dev/ttyUSB0"))
    served = Config(web=WebConfig(address=("http://127.0.0.1:8080", "https://0.0.0.0:8443")))
    banners = {
        "a simulator": run.banner(Config(), "acsard.toml", "/dev/pts/3"),
        "a robot": run.banner(real, "acsard.toml", "/dev/ttyUSB0"),
        "a board that is missing": run.banner(real, "x.toml", "/dev/ttyUSB0", "it is not there"),
        "with the page": run.banner(served, "x.toml", "/dev/x", served=""),
        "over ssh": run.banner(served, "x.toml", "/dev/x", served="pi@192.0.2.7"),
        "with options": run.banner(Config(), "x.toml", "/dev/x", reach=reach),
    }
    text = "".join(f"--- {what}\n{banner}" for what, banner in banners.items())
    approved(Path(__file__).with_name("words") / "banner.txt", text.replace(version(), "VERSION"))


def test_the_banner_names_the_router_of_a_robot_that_listens_nowhere() -> None:
    bus = BusConfig(mode="client", connect=("tcp/r:7447",))
    text = run.banner(Config(bus=bus), "x.toml", "/dev/x")
    assert "bus     client of the Zenoh router at tcp/r:7447, keys " in text


def test_on_a_terminal_the_page_is_served_unless_it_is_disabled_or_missing(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.delenv("INVOCATION_ID", raising=False)
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    file = tmp_path / "acsard.toml"
    where = ["--connect", "tcp/127.0.0.1:7448"]
    assert run.page(Config(), str(file)) == ["web", "--id", "acsar", *where]
    file.touch()
    named = ["--config", str(file)]
    assert run.page(Config(), str(file)) == ["web", "--id", "acsar", *named, *where]
    assert run.page(Config(web=WebConfig(page=False)), "nowhere.toml") is None
    monkeypatch.setattr(run, "find_spec", lambda name: None)  # as if the extra were not installed
    assert run.page(Config(), "nowhere.toml") is None


def test_without_a_file_the_defaults_are_printed_and_are_no_mistake(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("ACSARD_CONFIG", raising=False)
    monkeypatch.setattr("acsard.host.config_file.SEARCH_PATHS", ())
    result = typed("check")
    assert (result.code, result.err) == (0, f"{DEFAULTS}: no mistakes, no warnings")
    assert result.out.startswith(f"# effective configuration from {DEFAULTS}\n")


def test_the_command_from_afar_has_the_address_to_which_this_terminal_is_logged_in(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv("SSH_CONNECTION", raising=False)
    assert run._login() == ""
    monkeypatch.setenv("SSH_CONNECTION", "192.0.2.9 50000 192.0.2.7 22")
    monkeypatch.setenv("USER", "pi")
    assert run._login() == "pi@192.0.2.7"

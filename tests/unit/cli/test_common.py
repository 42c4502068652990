"""Tests of the search order for the configuration file, and of the errors for a bad one."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

import pytest

from acsard.cli import main, parser
from acsard.cli.common import OPTIONS, count, load, with_record_directory
from acsard.cli.connection import require_asked, require_followed, robot_address
from acsard.cli.run import options
from acsard.core.config.parsing import parse
from acsard.core.config.settings import Config
from acsard.host import config_file
from acsard.host.config_file import SEARCH_PATHS, find, writable
from acsard.host.errors import Exit, MendableError, UsageError
from tests.each import each


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


def test_the_file_is_searched_in_the_working_directory_and_in_etc() -> None:
    assert [str(place) for place in SEARCH_PATHS] == ["acsard.toml", "/etc/acsard/acsard.toml"]


def test_the_option_wins_over_all_others(places: Places, monkeypatch: pytest.MonkeyPatch) -> None:
    places.fill()
    monkeypatch.setenv("ACSARD_CONFIG", str(places.variable))
    assert find(str(places.option)) == (str(places.option), places.option.read_bytes())


def test_the_variable_wins_over_the_places(places: Places, monkeypatch: pytest.MonkeyPatch) -> None:
    places.fill()
    monkeypatch.setenv("ACSARD_CONFIG", str(places.variable))
    assert find(None) == (str(places.variable), places.variable.read_bytes())


def test_the_file_here_wins_over_etc(places: Places) -> None:
    places.fill()
    assert find(None) == ("acsard.toml", places.here.read_bytes())


def test_the_file_in_etc_is_used_last(places: Places) -> None:
    places.fill()
    places.here.unlink()
    assert find(None) == (str(places.etc), places.etc.read_bytes())


@pytest.mark.usefixtures("places")
def test_without_a_file_the_defaults_are_used() -> None:
    assert find(None) == ("built-in defaults", b"")
    assert load(None) == ("built-in defaults", Config())


def test_an_empty_variable_names_nothing(places: Places, monkeypatch: pytest.MonkeyPatch) -> None:
    places.fill()
    monkeypatch.setenv("ACSARD_CONFIG", "")
    assert find(None)[0] == "acsard.toml"


def test_a_named_file_that_is_missing_is_an_error_and_never_replaced(
    places: Places, monkeypatch: pytest.MonkeyPatch
) -> None:
    places.fill()
    places.variable.unlink()
    with pytest.raises(
        MendableError, match=r"cannot read /nowhere/x\.toml: No such file"
    ) as caught:
        find("/nowhere/x.toml")
    assert caught.value.code == Exit.BAD_CONFIG
    monkeypatch.setenv("ACSARD_CONFIG", str(places.variable))
    with pytest.raises(MendableError, match="cannot read"):
        find(None)


def test_a_file_here_that_cannot_be_read_is_an_error_and_not_passed_over(places: Places) -> None:
    places.fill()
    places.here.unlink()
    places.here.mkdir()
    with pytest.raises(MendableError, match=r"cannot read acsard\.toml: Is a directory") as caught:
        find(None)
    assert caught.value.code == Exit.BAD_CONFIG


def test_a_good_file_is_decoded_with_the_command_line_on_top(places: Places) -> None:
    places.option.write_text('[robot]\nid = "r1"\n[mcu]\nport = "/dev/a"\n')
    where, config = load(str(places.option), {"robot.id": "r2"})
    assert where == str(places.option)
    assert (config.robot.id, config.mcu.port) == ("r2", "/dev/a")


@pytest.mark.parametrize(
    ("text", "words"), [("a = 1\n", "1 problem in "), ("a = 1\nb = 2\n", "2 problems in ")]
)
def test_every_problem_is_printed_with_the_file_it_is_in(
    places: Places, capsys: pytest.CaptureFixture[str], text: str, words: str
) -> None:
    places.option.write_text(text)
    with pytest.raises(MendableError, match=words) as caught:
        load(str(places.option))
    assert int(caught.value.code) == 78
    out, err = capsys.readouterr()
    assert out == ""
    lines = err.splitlines()
    assert len(lines) == text.count("\n")
    assert all(line.startswith(f"{places.option}: ") for line in lines)
    assert lines[0].startswith(f"{places.option}: a = 1: unknown key")


@each(
    ("words", "place"),
    [
        ("run --baud-rate 1234", "--baud-rate: mcu.baud_rate = 1234: expected"),
        ("run --id a/b", '--id: robot.id = "a/b": expected'),
        ("run --listen foo", '--listen: bus.listen = "foo": not an endpoint'),
        ("run --listen tcp/0.0.0.0:1", '--listen: bus.listen = "tcp/0.0.0.0:1": this endpoint'),
        ("run --connect foo", '--connect: bus.connect = "foo": not an endpoint'),
        ("run --namespace /", '--namespace: ros.namespace = "/": expected'),
        ("run --port=", '--port: mcu.port = "": expected'),
    ],
)
def test_a_value_of_an_option_is_blamed_on_the_option_and_not_on_the_file(
    words: str, place: str, places: Places, capsys: pytest.CaptureFixture[str]
) -> None:
    places.here.write_text('[robot]\nid = "r1"\n')
    assert main(words.split()) == Exit.BAD_CONFIG
    output = capsys.readouterr().err
    assert output.startswith(place)
    assert output.endswith(f"acsard: 1 problem in {place.partition(':')[0]}\n")


def test_problems_of_the_file_and_of_an_option_are_distinguished(
    places: Places, capsys: pytest.CaptureFixture[str]
) -> None:
    places.here.write_text("[control]\nrate = 5\n")
    assert main(["run", "--id", "a/b"]) == Exit.BAD_CONFIG
    output = capsys.readouterr().err
    assert '--id: robot.id = "a/b"' in output
    assert "acsard.toml: control.rate = 5" in output
    assert "acsard: 2 problems in " in output
    places.here.write_text("[control]\nrate = 100\n")
    assert main(["run", "--baud-rate", "9600"]) == Exit.BAD_CONFIG
    output = capsys.readouterr().err
    assert output.startswith("--baud-rate: control.rate = 100: ")


def test_every_key_that_run_can_set_has_the_name_of_its_option() -> None:
    known = parser(["run"])
    for key in options(known.parse_args(["run"])):
        assert known.parse_args(["run", OPTIONS[key], "1"])


def address_of(
    config: Path,
    connect: str | None = None,
    robot_id: str | None = None,
    tls: str | None = None,
) -> tuple[str, str, str]:
    return robot_address(
        argparse.Namespace(config=str(config), connect=connect, id=robot_id, tls=tls)
    )


def test_a_tool_talks_to_the_robot_of_the_configuration(places: Places) -> None:
    places.option.write_text(
        '[robot]\nid = "r7"\n[bus]\nlisten = ["tcp/[::1]:9", "tcp/127.0.0.1:8"]\n'
    )
    assert address_of(places.option) == ("tcp/[::1]:9", "r7", "")


def test_the_options_of_a_tool_win_over_the_configuration(places: Places) -> None:
    places.fill()
    assert address_of(places.option, "tcp/10.0.0.1:1", "r8") == ("tcp/10.0.0.1:1", "r8", "")
    assert address_of(places.option, robot_id="r8") == ("tcp/127.0.0.1:7448", "r8", "")


def test_a_tool_connects_to_the_router_of_a_daemon_in_client_mode(places: Places) -> None:
    places.option.write_text(
        '[bus]\nmode = "client"\nlisten = ["tcp/127.0.0.1:8"]\nconnect = ["tcp/127.0.0.1:7447"]\n'
    )
    assert address_of(places.option)[0] == "tcp/127.0.0.1:7447"


def test_a_certificate_goes_with_a_tls_endpoint_only(
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


def test_a_tool_without_an_address_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "a.toml"
    file.write_text("[bus]\nlisten = []\n")
    with pytest.raises(MendableError) as caught:
        robot_address(argparse.Namespace(config=str(file), connect=None, id=None, tls=None))
    assert caught.value.code is Exit.BAD_CONFIG


def test_an_unknown_key_causes_a_warning_and_a_command_key_of_any_source_does_not(
    capsys: pytest.CaptureFixture[str],
) -> None:
    for key in ("odom", "cmd/stranger", "json/odom", "wheel_cmd/x"):
        require_followed(key)
    assert capsys.readouterr().err == ""
    require_followed("oddom\x1b[2J")
    err = capsys.readouterr().err
    assert "did you mean odom?" in err
    assert err.strip().isprintable()


# keys of another type than the program expected


@each(
    ("key", "instead"),
    [
        ("info", "acsard get info"),
        ("schema/Twist", "acsard get schema/Twist"),
        ("srv/stop", "acsard call stop"),
        ("alive", "acsard fleet"),
    ],
)
def test_following_a_key_that_is_never_published_is_refused_with_an_alternative(
    key: str, instead: str
) -> None:
    with pytest.raises(UsageError, match=instead):
        require_followed(key)


@each(
    ("key", "instead"),
    [
        ("srv/clear", "call clear"),
        ("cmd/app", "echo cmd/app"),
        ("cmd/app/anna", "echo cmd/app/anna"),
        ("alive", "acsard fleet"),
        ("**", "get queries only one"),
        ("schema/*", "get queries only one"),
    ],
)
def test_querying_a_key_that_never_answers_or_acts_is_refused(key: str, instead: str) -> None:
    with pytest.raises(UsageError, match=instead):
        require_asked(key)


def test_published_and_unknown_keys_may_be_followed_and_queried() -> None:
    for key in ("odom", "state", "nonsense", "schema", "cmd/app/x/y"):
        require_followed(key)
        require_asked(key)
    for key in ("cmd/app", "cmd/app/anna"):
        require_followed(key)
    require_asked("config")


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


def test_a_relative_record_directory_becomes_an_absolute_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    named = with_record_directory(parse(b"", {"record": {"directory": "box"}}))
    assert named.record.directory == str(tmp_path / "box")


def test_without_a_file_a_write_is_refused_and_names_the_file_on_the_robot(places: Places) -> None:
    with pytest.raises(MendableError) as raised:
        writable(None)
    assert "on the robot" in str(raised.value)
    assert "acsard.toml on the robot" in str(raised.value)


def test_a_file_that_this_user_may_not_write_is_refused_before_the_work(
    places: Places, monkeypatch: pytest.MonkeyPatch
) -> None:
    places.here.write_text("")
    # Root may write everywhere.
    monkeypatch.setattr(os, "access", lambda *_: False)
    with pytest.raises(MendableError, match="was not changed: it is read-only"):
        writable(None)


@pytest.mark.parametrize("named", [True, False])
def test_write_leaves_the_reference_file_of_a_clone_as_git_has_it(
    places: Places, named: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    clone = places.here.parent
    places.here.write_text("")
    (clone / ".git").mkdir()
    assert writable(None) == Path("acsard.toml")  # a repository of the operator's own
    (clone / "acsard").mkdir()
    (clone / "acsard" / "__init__.py").touch()
    with pytest.raises(
        MendableError, match=r"cp .*acsard\.toml robot\.toml.* --config robot\.toml"
    ):
        writable(str(places.here) if named else None)
    (clone / "robot.toml").write_text("")
    assert writable("robot.toml") == Path("robot.toml")


@each("text", ["x", "", "0", "-1", "1.5", "²", "1" * 10, "9" * 5000])
def test_an_invalid_count_is_refused_with_the_valid_range(text: str) -> None:
    assert count("12") == 12
    with pytest.raises(argparse.ArgumentTypeError) as raised:
        count(text)
    assert str(raised.value) == f"{text[:40]} is not a whole number from 1 to 999999999"

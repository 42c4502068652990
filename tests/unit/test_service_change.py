"""A change of the version: its steps on a machine of directories, with a `systemctl` that notes.

`systemd/test_upgrade.py` shows the same with a real systemd and a robot.
"""

from __future__ import annotations

import inspect
import os
import shutil
import signal
from collections.abc import Iterable
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest

from acsard.cli import main
from acsard.core.messages.schema import Twist, Vector3
from acsard.host.errors import MendableError, NoAnswerError
from acsard.machine import service_installation, upgrade, versions
from acsard.machine.deploy_files import source
from acsard.machine.service_installation import GATEWAY, PAGE, RULES, UNIT
from acsard.machine.upgrade import change, prepare, unit_state, watch
from tests.system.harness import free_endpoint
from tests.unit.screens import STATE

OLD, NEW = "0.2.0", "0.3.0"

# The state of a unit is in a file of its name, and that of a version in one of `UNIT-VERSION`.
SYSTEMCTL = """\
#!/bin/sh
echo "$@" >>{root}/calls
[ "$1" = reset-failed ] && exit 1  # the unit has never been loaded
[ "$1" = show ] || exit 0
state={root}/$2
[ -e $state-$(readlink {home}/current) ] && state=$state-$(readlink {home}/current)
cat $state 2>/dev/null || printf 'ActiveState=inactive\\nNRestarts=0\\nMainPID=0\\nJob=\\n'
"""


class Machine:
    """A machine with a service of the version `OLD`, and with `NEW` beside it."""

    def __init__(self, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.root, self.home, self.said = root, root / "opt", list[str]()
        self.units, self.rules = root / "units", root / "rules" / RULES.name
        for function in (
            versions.current, versions.previous, versions.installed, versions.use,
            versions.go_back, versions.deploy_of, versions.remove_others,
        ):  # fmt: skip
            monkeypatch.setattr(function, "__defaults__", (self.home,))
        changing = inspect.unwrap(versions.changing)
        monkeypatch.setattr(changing, "__defaults__", (self.home,))
        monkeypatch.setattr(versions, "HOME", self.home)
        for name, place in (("UNIT_DIRECTORY", self.units), ("RULES", self.rules)):
            monkeypatch.setattr(service_installation, name, place)
        monkeypatch.setattr(service_installation, "CONFIG_DIRECTORY", root / "etc")
        monkeypatch.setenv("PATH", str(root / "bin"), prepend=os.pathsep)
        for program, text in (("systemctl", SYSTEMCTL), ("udevadm", "#!/bin/sh\nexit 1\n")):
            self.program(root / "bin" / program, text.format(root=root, home=self.home))
        for version in (OLD, NEW):
            deploy = versions.deploy_of(version)
            for part in ("systemd", "udev"):
                shutil.copytree(source() / part, deploy / part)
            (deploy / "systemd" / UNIT).write_text(f"# {version}\n")
            self.program(self.home / version / "bin" / versions.STOP_PROGRAM, "")
            self.accepts(version, True)
        versions.use(OLD)
        for file in service_installation.system_files(versions.deploy_of(OLD)):
            service_installation.Write(file).do()
        self.config = root / "etc" / "acsard.toml"
        self.config.parent.mkdir()
        self.config.write_text(f'[bus]\nlisten = ["{free_endpoint()}"]\n')

    def program(self, path: Path, text: str) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        path.chmod(0o755)

    def accepts(self, version: str, accepts: bool) -> None:
        """Let `acsard check` of a version accept or refuse each configuration."""
        does = "exit 0" if accepts else "echo no key is right >&2; exit 78"
        self.program(self.home / version / "bin" / "acsard", f"#!/bin/sh\n{does}\n")

    def state(self, unit: str, active: str, restarts: int = 0, version: str = "") -> None:
        text = f"ActiveState={active}\nNRestarts={restarts}\nMainPID=0\nJob=\n"
        (self.root / (f"{unit}-{version}" if version else unit)).write_text(text)

    def calls(self) -> list[str]:
        """Return the commands that systemd got, without the questions."""
        lines = (self.root / "calls").read_text().splitlines()
        return [line for line in lines if not line.startswith("show")]

    @property
    def links(self) -> tuple[str, str]:
        return versions.current(), versions.previous()

    @property
    def unit(self) -> str:
        return (self.units / UNIT).read_text()


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Machine:
    return Machine(tmp_path, monkeypatch)


def test_a_service_that_does_not_run_gets_the_new_version_with_its_units(machine: Machine) -> None:
    change(NEW, machine.said.append)
    assert machine.links == (NEW, OLD)
    assert machine.unit == f"# {NEW}\n"
    assert machine.calls() == ["daemon-reload"]
    accepted, end = machine.said
    assert accepted == f"version {NEW} accepts {machine.config}"
    assert "`sudo systemctl start acsard`" in end
    machine.said.clear()
    change(NEW, machine.said.append)
    assert machine.said == [f"version {NEW} is in use already"]
    assert machine.links == (NEW, OLD)


def test_a_unit_that_a_user_changed_is_kept_and_named(machine: Machine) -> None:
    (machine.units / UNIT).write_text("# mine\n")
    (machine.units / GATEWAY).unlink()
    change(NEW, machine.said.append)
    assert machine.unit == "# mine\n"
    assert (machine.units / GATEWAY).exists()
    (kept,) = [text for text in machine.said if "was kept" in text]
    assert kept.startswith(f"{machine.units / UNIT} differs from that of version {OLD}")


def test_a_version_that_refuses_the_configuration_is_not_used(machine: Machine) -> None:
    machine.accepts(NEW, False)
    with pytest.raises(MendableError, match=rf"{OLD} stays in use, .*no key is right"):
        change(NEW, machine.said.append)
    assert (machine.links, machine.unit, machine.said) == ((OLD, ""), f"# {OLD}\n", [])
    machine.config.unlink()  # nothing to refuse
    change(NEW, machine.said.append)
    assert machine.links == (NEW, OLD)


def test_a_daemon_that_runs_and_does_not_answer_is_not_changed(machine: Machine) -> None:
    machine.state(UNIT, "active")
    with pytest.raises(MendableError, match="nobody knows whether the robot stands"):
        change(NEW, machine.said.append)
    assert machine.links == (OLD, "")


STANDS, DRIVES, TURNS = (0.0, 0.0), (0.5, 0.0), (0.0, 0.6)


class Answering:
    """A daemon that sends these speeds, m/s and rad/s, each for a second. The last one stays.

    Without speeds it is silent. A pause of the upgrade advances its time.
    """

    new_link = "up"  # of the version `NEW`

    def __init__(self, speeds: Iterable[tuple[float, float]]) -> None:
        self.now_s, self._speeds = 0.0, [*speeds]

    def get(self, key: str) -> Any:
        if not self._speeds:
            raise NoAnswerError(key)
        linear, angular = self._speeds[min(int(self.now_s), len(self._speeds) - 1)]
        twist = Twist(Vector3(linear, 0.0, 0.0), Vector3(0.0, 0.0, angular))
        # The wheels of a heavy robot have not begun to turn.
        link = self.new_link if versions.current() == NEW else "up"
        state = msgspec.structs.replace(
            STATE, wheels=[0.0] * 4, reason="commanded by nav", link=link
        )
        return {"cmd_vel_out": SimpleNamespace(twist=twist), "state": state}[key]

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds

    def answer(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Be the daemon and the clock of `upgrade`."""
        clock = SimpleNamespace(monotonic=lambda: self.now_s, sleep=self.sleep)
        monkeypatch.setattr(upgrade, "time", clock)
        monkeypatch.setattr(upgrade, "answers", lambda endpoint: True)
        monkeypatch.setattr(upgrade, "open_connection", lambda address: nullcontext(self))


@pytest.mark.parametrize(
    ("speeds", "changed_s"),
    [
        ([STANDS], 2.0),
        # A pause of a second is no standstill.
        ([DRIVES, STANDS, TURNS, STANDS], 5.0),
        ([DRIVES], None),
        ([TURNS], None),
    ],
)
def test_a_running_robot_is_changed_when_it_has_stood_for_two_seconds(
    speeds: list[tuple[float, float]],
    changed_s: float | None,
    machine: Machine,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    machine.state(UNIT, "active")
    daemon = Answering(speeds)
    daemon.answer(monkeypatch)
    if changed_s is None:
        with pytest.raises(MendableError, match=r"robot drives \(commanded by nav\); stop it"):
            change(NEW, machine.said.append, wait_s=3.0)
        assert daemon.now_s == pytest.approx(3.0, abs=0.3)
        assert machine.links == (OLD, "")
        return
    machine.program(machine.home / "0.1.0" / "bin" / versions.STOP_PROGRAM, "")
    change(NEW, machine.said.append, wait_s=9.0, watch_s=4.0)
    assert machine.links == (NEW, OLD)
    assert machine.calls()[-1] == f"restart --no-block {UNIT}"
    # The new version is watched to the end.
    assert daemon.now_s == pytest.approx(changed_s + 4.0, abs=0.3)
    assert versions.installed() == [OLD, NEW], "an older version is removed"
    assert [text.partition(";")[0] for text in machine.said] == [
        f"version {NEW} accepts {machine.config}",
        "waiting until the robot stands, at most 9 s",
        f"version {NEW} is in use",
        f"version {NEW} works",
    ]


def test_a_version_that_loses_the_link_of_the_one_before_is_left_again(
    machine: Machine, monkeypatch: pytest.MonkeyPatch
) -> None:
    machine.state(UNIT, "active")
    daemon = Answering([STANDS])
    daemon.new_link = "down"
    daemon.answer(monkeypatch)
    trouble = rf"{NEW} has no link to the microcontroller \(down\); version {OLD} runs again"
    with pytest.raises(MendableError, match=trouble):
        change(NEW, machine.said.append, watch_s=1.0)
    assert machine.links == (OLD, "")


def test_a_daemon_that_accepts_a_connection_and_stays_silent_is_not_changed(
    machine: Machine, monkeypatch: pytest.MonkeyPatch
) -> None:
    machine.state(UNIT, "active")
    Answering([]).answer(monkeypatch)
    with pytest.raises(MendableError, match="nobody knows whether the robot stands"):
        change(NEW, machine.said.append)
    assert machine.links == (OLD, "")


@pytest.mark.parametrize(
    ("old", "after"),
    [("active", f"{OLD} runs again"), ("failed", "is in use again, but does not start either")],
)
def test_a_version_that_systemd_restarts_is_left_again(
    old: str, after: str, machine: Machine, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(upgrade, "BACK_TIMEOUT_S", 0.3)
    for unit in (UNIT, PAGE):
        machine.state(unit, "activating")
    machine.state(UNIT, "activating", restarts=1, version=NEW)
    systemctl = machine.root / "bin" / "systemctl"
    # After its restart, the version of before is active or has failed.
    add = f"[ $1 = restart ] && [ $(readlink {machine.home}/current) = {OLD} ] && "
    text = f"ActiveState={old}\\nNRestarts=0\\nMainPID=0\\nJob=\\n"
    add += f"printf '{text}' >{machine.root}/{UNIT}\n"
    systemctl.write_text(systemctl.read_text().replace("[ ", add + "[ ", 1))
    with pytest.raises(MendableError, match=rf"{NEW} does not keep {UNIT} running; .*{after}"):
        change(NEW, machine.said.append, watch_s=5.0)
    assert machine.links == (OLD, "")
    assert machine.unit == f"# {OLD}\n"
    both = f"{UNIT} {PAGE}"
    assert machine.calls() == 2 * [
        "daemon-reload", f"reset-failed {both}", f"restart --no-block {both}"
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("active", "restarts", "trouble"),
    [
        ("activating", 0, rf"has not started {UNIT} within 0 s"),
        ("active", 0, "runs, but does not answer on the bus"),
        ("failed", 0, f"does not keep {UNIT} running"),
        ("active", 2, f"does not keep {UNIT} running"),
    ],
)
def test_a_watched_version_that_does_not_work_is_described(
    active: str, restarts: int, trouble: str, machine: Machine
) -> None:
    machine.state(UNIT, active, restarts)
    assert unit_state(UNIT).runs is (active != "failed")
    address = upgrade._address(machine.config)
    assert address.endpoint in machine.config.read_text()
    assert watch(address, None, [UNIT], 0.0) == trouble


def test_a_version_that_another_program_stops_stays_in_use(machine: Machine) -> None:
    machine.state(UNIT, "inactive")
    with pytest.raises(MendableError, match=f"another program stopped {UNIT}"):
        watch(upgrade._address(machine.config), None, [UNIT], 5.0)


@pytest.mark.parametrize(
    ("packaged", "change_it", "trouble"),
    [
        (NEW, False, ""),
        (NEW, True, f"version {NEW} of another build is in use already"),
        ("0.4.0", False, "has no version of acsard"),
    ],
)
def test_a_package_must_bring_the_version_that_it_installs(
    packaged: str, change_it: bool, trouble: str, machine: Machine
) -> None:
    package, listed = machine.root / "new.deb", machine.home / versions.PACKAGE / packaged
    package.touch()
    shutil.copytree(machine.home / NEW, listed)
    if change_it:
        (listed / "lib" / "module.py").touch()
    for program, text in (
        ("dpkg-deb", "echo acsard"),
        ("apt-get", f'echo "$DEBIAN_FRONTEND $@" >{machine.root}/apt'),
        ("dpkg-query", f"printf '/.\\n{listed}\\n{listed}/bin\\n'"),
    ):
        machine.program(machine.root / "bin" / program, f"#!/bin/sh\n{text}\n")
    if trouble:
        with pytest.raises(MendableError, match=trouble):
            prepare(package)
    else:
        assert prepare(package) == NEW
    asked = (machine.root / "apt").read_text()
    assert asked.startswith("noninteractive install --yes ")
    assert asked.endswith(f" {package}\n")


@pytest.mark.skipif(os.geteuid() != 0, reason="only root may change the version")
def test_a_rollback_goes_to_the_version_before_and_says_if_there_is_none(
    machine: Machine, capsys: pytest.CaptureFixture[str]
) -> None:
    before = signal.getsignal(signal.SIGHUP)
    try:
        assert main(["service", "rollback"]) == 1
        assert "there is no version before the one in use" in capsys.readouterr().err
        change(NEW, machine.said.append)
        assert main(["service", "rollback"]) == 0
        assert (machine.links, machine.unit) == ((OLD, NEW), f"# {OLD}\n")
        assert main(["service", "upgrade", str(machine.home / NEW)]) == 0
        assert machine.links == (NEW, OLD)
    finally:
        signal.signal(signal.SIGHUP, before)

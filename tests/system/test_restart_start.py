"""A start from the shell leads to a robot that drives, or fails with a clear message."""

from __future__ import annotations

import itertools
import os
import shutil
import signal
import time
from pathlib import Path

import pytest
import zenoh

from tests.system.bystander import lost
from tests.system.harness import (
    START_S,
    ZERO_LINE,
    Bus,
    Daemon,
    Peer,
    Program,
    Tables,
    acsard,
    alive_at,
    client_config,
    finish,
    free_endpoint,
    until,
    wheels,
    write_config,
)
from tests.system.strangers import FIRST_ODOMETRY, command_line


@pytest.mark.slow
def test_first_odometry_reaches_another_process_within_3_s_of_the_start(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    with Program(command_line(FIRST_ODOMETRY, endpoint), tmp_path) as watcher:
        watcher.says("ready")
        # Only the address is configured, because 7448 may be in use on this machine.
        with Program(acsard("run", "--listen", endpoint), tmp_path) as daemon:
            first = float(watcher.says("first").split()[1])
    seconds = first - daemon.started
    print(f"acsard run -> first odometry in another process: {seconds:.3f} s")
    assert seconds < 3.0 + lost(daemon.started, first)


@pytest.mark.slow
def test_a_port_that_is_missing_at_the_start_is_reported_and_picked_up_when_it_appears(
    tmp_path: Path,
) -> None:
    path = tmp_path / "mcu"
    with Daemon(tmp_path, path) as daemon, Bus(daemon.endpoint) as bus:
        with bus.follow("state") as states:
            state = states.find(lambda state: True, 5.0, "a state").value
        assert (state["link"], state["mode"]) == ("down", "waiting")
        events = until(lambda: daemon.events("port_waiting"), 5.0, "a word about the missing port")
        assert str(path) in events[0]["text"]
        with Peer(path) as peer, bus.follow("state") as states:
            appeared = peer.session.plugged
            until(lambda: peer.lines, 5.0, "a line")
            print(f"port appears -> first bytes: {peer.session.raw[0].at - appeared:.3f} s")
            first = peer.session.raw[0].at
            assert first - appeared < 0.5 + 0.5 + lost(appeared, first)
            assert peer.session.stream.startswith(b"\r\n" + ZERO_LINE)
            states.find(lambda state: state["link"] == "up", 5.0, "link up")
        assert len(daemon.events("port_waiting")) == 1  # once, not at every attempt


@pytest.mark.slow
def test_sigterm_while_the_port_is_missing_ends_with_0_at_any_time_after_the_start(
    tmp_path: Path,
) -> None:
    # In the first milliseconds the signal interrupts an attempt to open the port, later a pause.
    for pause in (0.0, 0.001, 0.3):
        with Daemon(tmp_path, tmp_path / "nothing") as daemon:
            time.sleep(pause)
            sent = time.monotonic()
            daemon.signal(signal.SIGTERM)
            assert daemon.ended(2.0) == 0
            assert time.monotonic() - sent < 1.0 + lost(sent)


# in use: 75


@pytest.mark.slow
def test_a_second_daemon_on_the_port_ends_with_75_and_names_the_owner(
    tmp_path: Path, peer: Peer
) -> None:
    with Daemon(tmp_path, peer.path) as first, Bus(first.endpoint) as bus:
        bus.linked()
        opened, count = len(peer.session.raw), len(peer.lines)
        with bus.commanding(0.5):
            until(lambda: peer.lines[-1].line.startswith(b"ap10.00"), 5.0, "steady driving")
            config: Tables = {"mcu": {"port": str(peer.path)}, "bus": {"listen": [free_endpoint()]}}
            path = write_config(tmp_path / "second.toml", config)
            second = finish(acsard("run", "--config", str(path)), tmp_path)
            peer.await_lines(10)
            lines = peer.session.raw_lines()[count:]
            # On a busy machine, the link may have been lost for a moment.
            until(lambda: bus.state()["mode"] == "driving", 5.0, "it drives on")
    print(f"second daemon on the port: exit {second.code} after {second.seconds:.2f} s")
    assert second.code == 75
    assert f"process {first.pid}" in second.err
    assert str(peer.path) in second.err
    assert "Traceback" not in second.err
    # Not a byte of the second daemon: no line end of a new session, no zero during the drive.
    assert opened
    assert b"\r\n" not in lines
    # A commander that waits for a core may fall silent. That causes a ramp, and no sudden zero. The
    # same holds without a link, which a daemon that waits for a core may lose.
    if not first.events("link_stale"):
        for before, line in itertools.pairwise(lines):
            assert line != ZERO_LINE or wheels(before)[0] < 1.0


@pytest.mark.slow
def test_a_second_daemon_on_the_bus_address_ends_with_75_before_a_byte_on_its_own_port(
    tmp_path: Path, peer: Peer
) -> None:
    with Daemon(tmp_path) as first:
        config: Tables = {
            "robot": {"id": "other"},
            "mcu": {"port": str(peer.path)},
            "bus": {"listen": [first.endpoint]},
        }
        path = write_config(tmp_path / "second.toml", config)
        second = finish(acsard("run", "--config", str(path)), tmp_path)
        assert first.process.poll() is None
    print(f"second daemon on the address: exit {second.code} after {second.seconds:.2f} s")
    assert second.code == 75
    assert f"the process {first.pid} answers at {first.endpoint} as robot acsar" in second.err
    assert "with --listen or in bus.listen" in second.err
    assert "Traceback" not in second.err
    assert peer.session.stream == b""


@pytest.mark.slow
def test_a_second_daemon_with_the_same_id_behind_one_router_ends_with_75(
    tmp_path: Path, peer: Peer
) -> None:
    endpoint = free_endpoint()
    with zenoh.open(client_config(endpoint, "router")) as router:
        connected = {"bus": {"listen": [free_endpoint()], "connect": [endpoint]}}
        with Daemon(tmp_path, config=connected):
            alive = router.liveliness().declare_subscriber(
                "acsard/acsar/alive", zenoh.handlers.FifoChannel(10), history=True
            )
            until(alive.try_recv, 5.0, "the first daemon's alive token at the router")
            mine: Tables = {
                "mcu": {"port": str(peer.path)},
                "bus": {"listen": [free_endpoint()], "connect": [endpoint]},
            }
            path = write_config(tmp_path / "second.toml", mine)
            second = finish(acsard("run", "--config", str(path)), tmp_path)
            assert second.code == 75
            assert "acsar" in second.err
            assert "robot.id" in second.err
            assert "Traceback" not in second.err
            assert peer.session.stream == b""
            print(f"second daemon of the id: exit 75 after {second.seconds:.2f} s")
            other = ["--id", "other", "--namespace", "other"]
            with Daemon(tmp_path, peer.path, mine, words=other, name="other") as third:
                assert third.process.poll() is None


@pytest.mark.slow
@pytest.mark.nightly
def test_a_second_robot_with_the_ros_names_of_another_behind_one_router_ends_with_75(
    tmp_path: Path, peer: Peer
) -> None:
    """The second daemon refuses to start, because one `cmd_vel` would drive both robots."""
    endpoint = free_endpoint()

    def robot(name: str, port: str = "sim") -> Tables:
        bus = {"listen": [free_endpoint()], "connect": [endpoint]}
        return {"robot": {"id": name}, "bus": bus, "mcu": {"port": port}}

    path = write_config(tmp_path / "two.toml", robot("two", str(peer.path)))
    run = acsard("run", "--config", str(path))
    with (
        zenoh.open(client_config(endpoint, "router")),
        Daemon(tmp_path, config=robot("one"), name="one") as first,
    ):
        ended = finish(run, tmp_path)
        assert ended.code == 75
        assert "--namespace NAME" in ended.err
        assert "Traceback" not in ended.err
        assert peer.session.stream == b""
        with Program([*run, "--namespace", "two"], tmp_path) as named:
            named.says("bus ")
            first.signal(signal.SIGKILL)
            first.ended(5.0)
            # The daemon's own earlier tokens are not those of another daemon.
            with Daemon(tmp_path, config=robot("one"), name="one") as again:
                assert again.process.poll() is None


# no permission: 77


def unprivileged() -> list[str]:
    """Return a command prefix that drops root's capabilities, or an empty list for other users."""
    if os.geteuid() != 0:
        return []
    drop = ["setpriv", "--bounding-set=-all", "--inh-caps=-all"]
    if shutil.which("setpriv") is None or finish([*drop, "true"], "/").code:
        pytest.skip("root needs setpriv and the right to drop capabilities")
    return drop


@pytest.mark.slow
def test_a_port_without_permission_ends_with_77_and_the_remedy(tmp_path: Path, peer: Peer) -> None:
    drop = unprivileged()
    device = os.path.realpath(peer.path)
    os.chmod(device, 0o000)  # not even for the owner, who is root here but without root's rights
    run = acsard("run", "--port", device, "--listen", free_endpoint())
    begun = time.monotonic()
    ended = finish([*drop, *run], tmp_path)
    print(f"no permission: exit {ended.code} after {ended.seconds:.2f} s")
    assert ended.code == 77
    assert 2.0 < ended.seconds < 8.0 + lost(begun)  # udev gets 2 s to set the group
    assert device in ended.err
    assert "has the mode 000, so no group may open it" in ended.err
    assert "Traceback" not in ended.err
    assert peer.session.stream == b""


def test_permission_granted_within_2_s_of_the_start_is_enough(tmp_path: Path, peer: Peer) -> None:
    drop = unprivileged()
    device = os.path.realpath(peer.path)
    os.chmod(device, 0o000)
    endpoint = free_endpoint()
    run = acsard("run", "--port", device, "--listen", endpoint)
    with Program([*drop, *run], tmp_path) as daemon, alive_at(endpoint, daemon) as alive:
        # The bus starts first, so the token shows that the daemon is now trying the port.
        until(alive.try_recv, START_S, "the alive token")
        os.chmod(device, 0o600)
        until(lambda: peer.lines, 3.0, "a line after permission")


# bad configuration: 78

PLANTED = """\
[robot]
id = "two words"
[mcu]
port = "/dev/null"
baud_rate = 1234
trailing_coma = true
[drive]
wheel_radius = inf
[limits]
linear_speed = -1.0
"""
MISTAKES = {
    "robot.id": "two words",
    "mcu.baud_rate": "1234",
    "mcu.trailing_coma": "trailing_comma",
    "drive.wheel_radius": "inf",
    "limits.linear_speed": "-1.0",
}


def test_a_bad_configuration_ends_with_78_and_a_line_per_mistake(tmp_path: Path) -> None:
    path = tmp_path / "bad.toml"
    path.write_text(PLANTED)
    begun = time.monotonic()
    ended = finish(acsard("run", "--config", str(path)), tmp_path)
    print(f"run with a bad configuration: {ended.seconds:.2f} s")
    assert ended.code == 78
    assert ended.out == ""
    *lines, summary = ended.err.splitlines()
    assert len(lines) == len(MISTAKES), ended.err
    for key, message in MISTAKES.items():
        assert [line for line in lines if key in line and message in line], (key, ended.err)
    assert summary.startswith("acsard: 5 problems")
    assert ended.seconds < 2.0 + lost(begun)

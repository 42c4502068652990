"""A stop survives the end of the daemon, whatever its disk does.

A commander sends all the time: zeros for 0.3 s every 2 s, and a speed in between. The zeros arm it
after every start, so only the latch can keep the robot at rest.
"""

from __future__ import annotations

import random

import pytest

from acsard.core.config.settings import Config
from acsard.core.messages.schema import DiagnosticArray, DiagnosticStatus
from acsard.core.messages.signature import public_name
from acsard.core.robot import Robot
from acsard.core.values import NS_PER_S, Cause, Event, Instant, Latches
from acsard.daemon.intake import Intake
from acsard.daemon.latch_file import Keeper, LatchFileError, decode, encode, unreadable
from acsard.daemon.publication import Publication
from tests.each import each
from tests.scenarios.speakers import Speaker, moved
from tests.scenarios.world import SIGNED, START, World

ZEROS_S, CYCLE_S = 0.3, 2.0


class MemoryFile(Keeper):
    """A latch file in memory. It contains the newest latches without waiting for a disk."""

    trouble = ""
    is_stored = True

    def __init__(self) -> None:
        super().__init__(Latches())
        self.data = b""
        self.told: list[Event] = []

    def keep(self, latches: Latches) -> None:
        self.latches, self.data = latches, encode("acsar", latches)

    def wait(self) -> None:
        self.is_stored = True

    def take_events(self) -> list[Event]:
        return [self.told.pop() for _ in range(len(self.told))]

    def read(self, now: Instant) -> Latches:
        """Return the latches that the next start of the daemon reads."""
        try:
            self.latches = decode("acsar", self.data)
        except LatchFileError as error:
            self.latches = unreadable("FILE", str(error), now)
        return self.latches


class Host:
    """A computer with a daemon, a simulated board, and the commander of this module."""

    def __init__(self, dice: random.Random) -> None:
        self.file, self.dice = MemoryFile(), dice
        self.file.keep(Latches())
        self.world = self._started(Latches())
        self._speaker()

    def _started(self, latches: Latches) -> World:
        return World(Config(), latches=latches, keeper=self.file)

    def _speaker(self) -> None:
        self.patrol = Speaker(self.world, "signed", "patrol")
        self._phase = self.dice.uniform(0.0, CYCLE_S)

    def restart(self) -> None:
        """Kill the daemon, and start it again after a pause with the latches in the file."""
        end = self.world
        pause_ns = self.dice.randrange(int(0.2 * NS_PER_S), 3 * NS_PER_S)
        latches = self.file.read(Instant(end.now_ns + pause_ns, end.instant.wall_ns + pause_ns))
        self.world = self._started(latches)
        self.world.wall_offset_ns += end.now_ns + pause_ns
        self._speaker()

    def patrols(self, seconds: float) -> None:
        """Let the commander send at 20 Hz for this time."""
        for _ in range(round(seconds * 20)):
            self._phase = (self._phase + 0.05) % CYCLE_S
            self.patrol.send(0.0 if self._phase < ZEROS_S else 0.5)
            self.world.run(0.05)


def row(world: World, name: str) -> DiagnosticStatus:
    """Return the row of `diagnostics` with this name."""
    message = world.loop.publication.current("diagnostics")
    assert isinstance(message, DiagnosticArray)
    (row_status,) = [status for status in message.status if status.name == f"acsard: {name}"]
    return row_status


def test_a_robot_whose_latch_file_is_cut_off_starts_stopped() -> None:
    host = Host(random.Random(1))
    host.patrols(2 * CYCLE_S)
    assert host.world.state.mode == "driving"
    host.file.data = host.file.data[:-20]
    host.restart()
    start_ns = host.world.now_ns
    host.patrols(1.5 * CYCLE_S)
    assert not moved(host.world, start_ns)
    assert host.world.state.mode == "stopped"
    assert "a stop may have been lost" in host.world.state.reason


def test_state_and_diagnostics_say_that_a_stop_would_be_lost() -> None:
    host = Host(random.Random(10))
    host.world.run(1.5)
    assert host.world.state.latch_file_error == ""
    assert row(host.world, "latch file").level == 0
    host.file.trouble = "a stop would not survive a restart: FILE: No space left on device"
    host.world.run(1.5)
    assert host.world.state.latch_file_error == host.file.trouble
    assert row(host.world, "latch file").level == 1
    assert row(host.world, "latch file").message == host.file.trouble


@pytest.mark.slow
@each("away_s", [-(10**9), -60, 0, 1, 10**9])
def test_a_plain_clear_waits_two_seconds_after_a_reboot_wherever_its_clock_is(away_s: int) -> None:
    at_ns = START.wall_ns - away_s * NS_PER_S
    cause = Cause(7, "stop", "stopped", "stopped by joe", by="joe", at_ns=at_ns, kept=True)
    world = World(latches=Latches((cause,), 7))
    world.run(0.5)
    world.ask("srv/clear")
    assert world.state.mode == "stopped"
    world.run(1.6)
    world.ask("srv/clear")
    assert world.state.mode == "ready"


@each("disk_s", [0.02, 1.0])
@each("trouble", ["", "a stop would not survive a restart: FILE: No space left on device"])
def test_a_stop_is_obeyed_immediately_and_answered_within_0_2_s_however_slow_the_disk_is(
    disk_s: float, trouble: str
) -> None:
    """The answer waits for the file, and says if the stop cannot be kept."""
    host = Host(random.Random(8))
    host.world.run(0.5)
    host.file.is_stored, host.file.trouble = False, trouble
    assert not host.world.ask("srv/stop")
    assert host.world.state.mode == "stopped"
    host.file.is_stored = disk_s < 0.1
    host.world.run(min(disk_s, 0.2))
    ((reply,),) = host.world.bus.replies.values()
    assert ("would not survive" in reply.payload.decode()) is bool(trouble and disk_s > 0.1)


@pytest.mark.variations(4)
@pytest.mark.parametrize("by", ["put", "call"])
@pytest.mark.parametrize(
    ("owner", "name", "works"),
    [
        (Intake, "take", True),
        (Robot, "hear", False),
        (Robot, "hear", True),
        (Publication, "publish", False),
    ],
)
def test_a_stop_in_a_step_that_raises_is_in_force_at_the_next_start(
    monkeypatch: pytest.MonkeyPatch, owner: type, name: str, works: bool, by: str
) -> None:
    """A bug raises an exception in the same step that receives a stop, and the daemon ends.

    The bug is in reading the bus, in the robot, after the robot's step, or in publishing.
    """
    host = Host(random.Random(16))
    host.patrols(2 * CYCLE_S)
    usual = getattr(owner, name)

    def broken(*words: object) -> None:
        if works:
            usual(*words)
        raise ZeroDivisionError("a bug")

    def stop() -> None:
        if by == "put":
            host.world.put("stop", b"", attachment=SIGNED)
        else:
            host.world.ask("srv/stop")

    with monkeypatch.context() as patched:
        patched.setattr(owner, name, broken)
        with pytest.raises(ZeroDivisionError):
            stop()
    host.restart()
    host.patrols(2 * CYCLE_S)
    assert host.world.state.mode == "stopped"
    client = public_name("somebody") if by == "put" else "unnamed"
    assert f"stopped by {client} (native)" in host.world.state.reason


def test_an_event_of_the_latch_file_reaches_the_log() -> None:
    host = Host(random.Random(11))
    event = Event("latch_file", "a stop would not survive a restart: FILE: full", "warning")
    host.file.told.append(event)
    host.world.run(0.1)
    assert event in host.world.events

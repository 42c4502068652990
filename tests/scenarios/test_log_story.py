"""Each output of a recording tells its reader what happened, when, why and by which client.

The test plays thirteen incidents in three runs of the daemon. `log_story.txt` is what `acsard
recording show` says of them (`--approve` writes it), and the report and the exported `log` say the
same. In two incidents the battery runs low, and an undervoltage restarts the board.
"""

from __future__ import annotations

import errno
import html
import io
import os
import re
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from typing import NamedTuple

import msgspec
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from msgspec.structs import replace

from acsard.cli import main
from acsard.core.config.settings import BatteryConfig, Config, McuConfig, RecordConfig
from acsard.core.incoming.commands import Arrival
from acsard.core.incoming.queries import Query
from acsard.core.simulator import protocol
from acsard.core.values import NS_PER_S, BatteryLevel, Cause, Latches
from acsard.recording import recorder as module
from acsard.recording.file import FrameWriter
from acsard.recording.recorder import Recorder
from tests.scenarios.speakers import Speaker, over
from tests.scenarios.world import World, naming

pytestmark = pytest.mark.slow

NAV, ANN, JOE, EVE = "nav2@robot", "ann@tablet", "joe@laptop", "eve@phone"
ANNA, TOM = "anna@desk", "tom@train"
IDENTITY = protocol.identity


class Line(NamedTuple):
    """A line of one output, with its time."""

    seconds: float
    """Wall-clock time, s since 1970."""
    text: str
    """The name of the entry and its sentence, without the mark of its level."""


def signed(name: str) -> bytes:
    return msgspec.json.encode({"sender": f"{name}/s3cret"})


class Host:
    """The robot's computer with its daemon. The recorder writes only when `write` is called."""

    def __init__(self, where: Path) -> None:
        self.config = replace(
            Config(mcu=McuConfig(port="/dev/ttyACM0", link_check="on", encoder_counts=3200)),
            record=RecordConfig(str(where), 100.0),
            battery=BatteryConfig("percent", warning_below=30.0, stop_below=10.0),
        )

    def start(self, wall_ns: int, latches: Latches = Latches()) -> None:  # noqa: B008
        """Start the daemon with a clock that shows `wall_ns`."""
        self.recorder = Recorder(
            self.config, lambda event: self.world.loop.publication.intake.events.append(event)
        )
        self.world = World(self.config, recorder=self.recorder, latches=latches)
        self.world.wall_offset_ns = wall_ns - self.world.now_ns

    def write(self) -> None:
        """Write the recorded steps to the file, as the recorder's thread does each second."""
        queue = self.recorder._queue
        self.recorder._writer.write([queue.popleft() for _ in range(len(queue))], False)

    def run(self, seconds: float) -> None:
        self.world.run(seconds)
        self.write()

    def send(self, name: str, source: str, speed: float) -> None:
        payload = msgspec.json.encode({"linear": {"x": speed}, "angular": {"z": 0.0}})
        self.world.put(f"cmd/{source}", payload, attachment=signed(name))

    def hold(self, name: str, source: str, speed: float, seconds: float) -> None:
        """Let the client `name` send a speed in m/s at 20 Hz for `seconds`."""
        for number in range(round(seconds * 20)):
            self.send(name, source, speed)
            self.world.run(0.05)
            if number % 20 == 19:
                self.write()
        self.write()

    def drive(self, seconds: float = 2.0) -> None:
        """Let the navigation program send zeros for 1 s, and then a speed for `seconds`."""
        self.hold(NAV, "nav", 0.0, 1.0)
        self.hold(NAV, "nav", 0.5, seconds)
        assert self.world.state.mode == "driving", self.world.state.reason

    def drive_until(self, level: BatteryLevel) -> None:
        """Let the navigation drive until the battery has this level."""
        for _ in range(600):
            self.hold(NAV, "nav", 0.5, 0.1)
            battery = self.world.state.battery
            if battery is not None and battery.level == level:
                return
        raise AssertionError(self.world.state.battery)

    def call(self, service: str, name: str) -> None:
        world, key = self.world, f"srv/{service}"
        if service == "stop":
            stop = Arrival(service, True, b"", "", world.now_ns, None, "", attachment=signed(name))
            world.bus.arrivals.append(stop)
        payload = naming(world.numbers) if service == "clear" else b""
        query = Query(1, key, key, "", payload, "", world.now_ns, attachment=signed(name))
        world.bus.queries.append(query)
        self.run(0.05)

    def crash(self) -> None:
        """End the daemon as a crash does, so that only the kernel closes the files."""
        file = self.recorder._writer._file
        assert file is not None
        file.close()


def identity(counts: int, watchdog_ms: int, sample: bool) -> bytes:
    """Return the identity line of a board that an undervoltage has just reset."""
    return IDENTITY(counts, watchdog_ms, sample).removesuffix(b"\r\n") + b" reset=brown-out\r\n"


@contextmanager
def full_disk() -> Iterator[None]:
    """Let the disk accept no more data."""

    def refuse(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(FrameWriter, "add", refuse)
        patched.setattr(FrameWriter, "add_steps", refuse)
        yield


NINE = 1_800_000_000 * NS_PER_S
"""The time at which the story begins by a right clock."""


def first_run(host: Host) -> None:
    """Play the incidents until the process crashes."""
    host.start(NINE - 10 * 3600 * NS_PER_S)
    # start
    host.run(3.0)
    host.world.wall_offset_ns += 10 * 3600 * NS_PER_S
    # wrong clock
    host.run(2.0)

    host.drive()
    host.hold(ANN, "teleop", 0.0, 0.5)
    # two commanders
    for _ in range(40):
        host.send(NAV, "nav", 0.5)
        host.send(ANN, "teleop", 0.3)
        host.world.run(0.05)
    host.write()
    # the first commander drives again
    host.hold(NAV, "nav", 0.5, 2.0)
    host.run(1.0)

    host.drive()
    # stop by anna
    host.call("stop", ANNA)
    host.run(2.0)
    # clear by anna
    host.call("clear", ANNA)
    host.run(1.0)

    # neutral-first
    host.hold(NAV, "dock", 0.5, 4.0)

    host.drive()
    # cable pulled
    host.world.port.unplug()
    host.world.port.trouble = "/dev/ttyACM0 was lost; reopening it"
    host.run(3.0)
    # cable plugged in
    host.world.port.trouble = ""
    host.world.port.plug(host.world.mcu)
    host.run(3.0)

    host.drive()
    # undervoltage of the board
    host.world.mcu.reset(host.world.now_ns, 1_000_000_000)
    host.run(4.0)

    host.drive()
    # congested Wi-Fi
    speaker = Speaker(host.world, "client", f"{TOM}/s3cret")
    speaker.open()
    over(host.world, speaker, lambda t: 0.6 if t > 1.0 else 0.005, lambda t: 0.4, 3.0)
    host.run(1.0)

    host.drive()
    # late host
    host.world.stall(0.6)
    host.run(1.5)

    host.drive()
    # damaged board
    with host.world.mcu.fault("reversed_encoder", 1):
        host.hold(NAV, "nav", 0.5, 2.0)
    host.run(1.0)
    # the fault is cleared by anna
    host.call("clear", ANNA)

    host.drive()
    with host.world.mcu.fault("battery", 50.0, 0.6):
        host.drive_until("warning")
        # low battery
        host.drive_until("stop")
    # empty battery
    with host.world.mcu.fault("battery", 90.0, 600.0):
        host.run(8.0)
        # anna clears the stop after a charge
        host.call("clear", ANNA)

    host.drive()
    with full_disk():
        host.hold(NAV, "nav", 0.5, 2.0)
    host.hold(NAV, "nav", 0.5, 4.0)
    # the disk has room again
    host.hold(NAV, "nav", 0.5, 4.0)
    # crash while driving
    host.crash()


def second_run(host: Host) -> None:
    """Restart after the crash, drive, and end in the ordinary way."""
    host.start(host.world.instant.wall_ns + 5 * NS_PER_S)
    # restart after the crash
    host.run(2.0)
    host.drive()
    # ordinary end
    host.world.loop.shutting_down = True
    host.run(0.5)
    host.recorder.close()


def third_run(host: Host) -> None:
    """Start a robot that is still stopped, because the client anna stopped it earlier."""
    wall_ns = host.world.instant.wall_ns
    client = f"{ANNA}/0123456789abcdef (native)"
    text = f"stopped by {client}"
    stop = Cause(1, "stop", "stopped", text, by=client, at_ns=wall_ns, kept=True)
    host.start(wall_ns + 60 * NS_PER_S, Latches((stop,), 1))
    # restart of a stopped robot
    host.run(2.0)
    host.recorder.close()


def seconds_of(text: str, date: str = "") -> float:
    """Convert a local time like 2027-01-15 08:00:59.950 to s since 1970.

    If the text has no date, `date` is used.
    """
    whole, _, fraction = (text if "-" in text else f"{date} {text}").partition(".")
    return time.mktime(time.strptime(whole, "%Y-%m-%d %H:%M:%S")) + float(f"0.{fraction}")


def shown_lines(*words: str) -> list[Line]:
    """Return the lines of `acsard recording show`."""
    with redirect_stdout(io.StringIO()) as printed:
        assert main(["recording", "show", *words]) == 0
    rows = [row.split("  ", 1) for row in printed.getvalue().splitlines()]
    return [Line(seconds_of(at), re.sub("^!!? ", "", text)) for at, text in rows]


def reported(directory: Path, *words: str) -> list[Line]:
    """Return the lines of the list of events in a report."""
    assert main(["recording", "report", *words]) == 0
    (page,) = directory.glob("*.html")
    rows = re.findall(r"<tr><td>(.*?)<td.*?>(.*?)<td>(.*?)(?=<tr>|</table>)", page.read_text())
    (date,) = re.findall(r"<h1>.*?, (\S+) ", page.read_text())
    cells = [map(html.unescape, row) for row in rows]
    return [Line(seconds_of(at, date), f"{name}: {text}") for at, name, text in cells]


def log_of(path: Path) -> list[Line]:
    """Return the lines of the topic `log` in an exported file."""
    lines = []
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        for decoded in reader.iter_decoded_messages("/log"):
            message = decoded.decoded_message
            seconds = message.stamp.sec + message.stamp.nanosec / 1e9
            text = f"{message.name.replace('_', ' ')}: {message.msg}"
            lines.append(Line(seconds, text))
    return lines


class Story(NamedTuple):
    """The lines of each output."""

    outputs: dict[str, list[Line]]
    where: Path
    """The directory of the recordings."""


@pytest.fixture(scope="module")
def story(tmp_path_factory: pytest.TempPathFactory) -> Story:
    where, here = tmp_path_factory.mktemp("story") / "record", tmp_path_factory.mktemp("here")
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(module, "WRITE_PAUSE_S", 1000.0)
        patched.setattr(module, "CLOSE_S", 20.0)
        patched.setattr(protocol, "identity", identity)
        patched.chdir(here)
        host = Host(where)
        for run in (first_run, second_run, third_run):
            run(host)
        words = "--from", "2000-01-01", "--directory", str(where)
        assert main(["recording", "export", *words]) == 0
        outputs = {
            "show": shown_lines(*words),
            "report": reported(here, "--from", "2000-01-01", "--directory", str(where)),
            "export": log_of(next(here.glob("*.mcap"))),
        }
    return Story(outputs, where)


def test_the_log_tells_what_happened_when_why_and_by_which_client(
    story: Story, approved: Callable[[Path, str], None]
) -> None:
    lines = [
        f"{line.seconds - NINE / NS_PER_S:10.1f}  {line.text}" for line in story.outputs["show"]
    ]
    text = re.sub(r"/[0-9a-f]{16}", "/ID", "\n".join(lines)).replace(str(story.where), "DIRECTORY")
    text = re.sub(r"\(acsard [^)]+\)", "(acsard VERSION)", text)
    approved(Path(__file__).with_name("log_story.txt"), text + "\n")


def test_the_three_outputs_have_the_same_lines_at_the_same_times(story: Story) -> None:
    show = story.outputs["show"]
    assert len(show) > 80
    for output in ("report", "export"):
        lines = story.outputs[output]
        assert [line.text for line in lines] == [line.text for line in show], output
        apart = [
            abs(entry.seconds - other.seconds) for entry, other in zip(lines, show, strict=True)
        ]
        assert max(apart) < 0.002, output

"""Each output of a recording tells its reader what happened, when, why and by which client.

The test plays thirteen incidents in three runs of the daemon. `acsard recording show`, the report
and the exported `log` must report all of them in the same words. In two incidents the battery runs
low, and an undervoltage restarts the board.
"""

from __future__ import annotations

import errno
import html
import io
import os
import re
import time
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from datetime import datetime
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
from acsard.host.errors import Exit
from acsard.recording import recorder as module
from acsard.recording.file import MAGIC, FrameWriter, listed
from acsard.recording.recorder import Recorder
from tests.scenarios.speakers import Speaker, over
from tests.scenarios.world import World, naming

pytestmark = pytest.mark.slow

TOLERANCE_S = 1.0
"""Largest difference between the time of an incident and the time of a line about it."""

NAV, ANN, JOE, EVE = "nav2@robot", "ann@tablet", "joe@laptop", "eve@phone"
ANNA, TOM = "anna@desk", "tom@train"
IDENTITY = protocol.identity
TOM_BY = rf"\(by {TOM}/[0-9a-f]{{16}}\)"


class Line(NamedTuple):
    """A line of one output, with its time."""

    seconds: float
    """Wall-clock time, s since 1970."""
    text: str
    """The name of the entry and its sentence, without the mark of its level."""


class Incident(NamedTuple):
    """An incident, and patterns for the lines that report it."""

    name: str
    wall_ns: int
    patterns: tuple[str, ...]
    """Each pattern must match a line within a second of the incident."""


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
        self.incidents: list[Incident] = []

    def start(self, wall_ns: int, latches: Latches = Latches()) -> None:  # noqa: B008
        """Start the daemon with a clock that shows `wall_ns`."""
        self.recorder = Recorder(
            self.config, lambda event: self.world.loop.publication.intake.events.append(event)
        )
        self.world = World(self.config, recorder=self.recorder, latches=latches)
        self.world.wall_offset_ns = wall_ns - self.world.now_ns

    def note(self, name: str, *patterns: str, after: float = 0.0) -> None:
        """Add an incident to the list. It happens `after` seconds from now."""
        wall_ns = self.world.instant.wall_ns + int(after * NS_PER_S)
        self.incidents.append(Incident(name, wall_ns, patterns))

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


def by(name: str, source: str = "") -> str:
    """Return a pattern that matches the part of a line which names this client and its source."""
    client = f"{re.escape(name)}/[0-9a-f]{{16}}"
    return rf"\(by {source} \({client}\)\)" if source else rf"\(by {client} \(native\)\)"


NINE = 1_800_000_000 * NS_PER_S
"""The time at which the story begins by a right clock."""


def first_run(host: Host) -> None:
    """Play the incidents until the process crashes."""
    host.start(NINE - 10 * 3600 * NS_PER_S)
    host.note("start", "^start: the daemon starts")
    host.run(3.0)
    host.world.wall_offset_ns += 10 * 3600 * NS_PER_S
    host.note("wrong clock", "^clock: the clock of the daemon's computer was set forward by 10 h")
    host.run(2.0)

    host.drive()
    host.hold(ANN, "teleop", 0.0, 0.5)
    host.note(
        "two commanders", rf"^commander: nav \({NAV}/\w+\) -> teleop \({ANN}/\w+\)", after=-0.5
    )
    host.note(
        "two commanders: why",
        r"^waits: teleop has priority: wait until it is silent \(by nav\)",
        after=1.0,
    )
    for _ in range(40):
        host.send(NAV, "nav", 0.5)
        host.send(ANN, "teleop", 0.3)
        host.world.run(0.05)
    host.write()
    host.note(
        "the first commander drives again",
        rf"^commander: teleop .* -> nav \({NAV}/\w+\)",
        after=0.5,
    )
    host.hold(NAV, "nav", 0.5, 2.0)
    host.run(1.0)

    host.drive()
    host.note(
        "stop by anna",
        f"^stop: stopped and latched; srv/clear releases it {by(ANNA)}",
        rf"^mode: driving -> stopped: stopped by {ANNA}/\w+ \(native\)",
    )
    host.call("stop", ANNA)
    host.run(2.0)
    host.note("clear by anna", f"^clear: cleared; each sender must send a zero .* {by(ANNA)}")
    host.call("clear", ANNA)
    host.run(1.0)

    host.note(
        "neutral-first",
        r"^reason: ready: send a zero first: dock must send a zero .* \(by dock\)",
    )
    host.note(
        "neutral-first, for long",
        f"^commands without effect: dock: send a zero first: .* for over 3 s {by(NAV, 'dock')}",
        after=3.0,
    )
    host.hold(NAV, "dock", 0.5, 4.0)

    host.drive()
    host.note(
        "cable pulled",
        "^link down: the serial port is closed; it is being reopened",
        "^mode: driving -> waiting: /dev/ttyACM0 was lost",
    )
    host.world.port.unplug()
    host.world.port.trouble = "/dev/ttyACM0 was lost; reopening it"
    host.run(3.0)
    host.note("cable plugged in", "^link up: the link to the microcontroller is up", after=0.1)
    host.world.port.trouble = ""
    host.world.port.plug(host.world.mcu)
    host.run(3.0)

    host.drive()
    host.note(
        "undervoltage of the board",
        "^link stale: the microcontroller has fallen silent",
        "^mode: driving -> waiting:",
        after=0.3,
    )
    host.world.mcu.reset(host.world.now_ns, 1_000_000_000)
    host.run(4.0)

    host.drive()
    host.note(
        "congested Wi-Fi",
        rf"^command refused: .*too_old.* after the beat that it echoes, .* {TOM_BY}",
        after=3.6,
    )
    speaker = Speaker(host.world, "client", f"{TOM}/s3cret")
    speaker.open()
    over(host.world, speaker, lambda t: 0.6 if t > 1.0 else 0.005, lambda t: 0.4, 3.0)
    host.run(1.0)

    host.drive()
    host.note(
        "late host",
        r"^link stale: this computer did not run the daemon for 0\.60 s",
        r"^missed periods: \d+ x missed",
        "^mode: driving -> waiting: this computer did not run",
        after=0.6,
    )
    host.world.stall(0.6)
    host.run(1.5)

    host.drive()
    host.note(
        "damaged board",
        "^wheel fault: .*front_left wheel is left out .* check its encoder",
        "^fault: front_left wheel does not obey its command: it turns the wrong way .*: check",
        "^mode: driving -> fault: front_left wheel",
        after=0.3,
    )
    with host.world.mcu.reversed_encoder(1):
        host.hold(NAV, "nav", 0.5, 2.0)
    host.run(1.0)
    host.note("the fault is cleared by anna", f"^clear: cleared; .* {by(ANNA)}")
    host.call("clear", ANNA)

    host.drive()
    with host.world.mcu.battery(50.0, 0.6):
        host.drive_until("warning")
        host.note(
            "low battery",
            "^battery: warning: .*the mean of the last seconds is below battery.warning_below = 30",
        )
        host.drive_until("stop")
    host.note(
        "empty battery",
        "^battery stop: .*the mean of the last seconds is below battery.stop_below = 10 %",
        r"^mode: driving -> stopped: battery below battery\.stop_below = 10 %",
    )
    with host.world.mcu.battery(90.0, 600.0):
        host.run(8.0)
        host.note("anna clears the stop after a charge", f"^clear: cleared; .* {by(ANNA)}")
        host.call("clear", ANNA)

    host.drive()
    with full_disk():
        host.hold(NAV, "nav", 0.5, 2.0)
    host.hold(NAV, "nav", 0.5, 4.0)
    host.note(
        "the disk has room again",
        r"^recording: the daemon records to .* again; \d+ steps are missing \(the error was: .*"
        r"No space left on device\)",
        r"^gap: \d+ steps are missing before this step",
    )
    host.hold(NAV, "nav", 0.5, 4.0)
    host.note("crash while driving", "^cut: the recording of this run ends without")
    host.crash()


def second_run(host: Host) -> None:
    """Restart after the crash, drive, and end in the ordinary way."""
    host.start(host.world.instant.wall_ns + 5 * NS_PER_S)
    host.note("restart after the crash", "^start: the daemon starts")
    host.run(2.0)
    host.drive()
    host.note(
        "ordinary end",
        "^mode: driving -> shutdown: the daemon is shutting down",
    )
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
    host.note(
        "restart of a stopped robot",
        "^start: the daemon starts",
        rf"^mode: start -> stopped: was stopped by {ANNA}/\w+ \(native\) .* before the restart",
    )
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
    """The incidents, and the lines of each output."""

    incidents: list[Incident]
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
    return Story(host.incidents, outputs, where)


def is_near(line: Line, incident: Incident) -> bool:
    """Return whether the time of a line agrees with the time of an incident."""
    return abs(line.seconds - incident.wall_ns / NS_PER_S) <= TOLERANCE_S


@pytest.mark.parametrize("output", ["show", "report", "export"])
def test_one_output_alone_reports_each_event_with_time_reason_and_client(
    output: str, story: Story
) -> None:
    lines = story.outputs[output]
    missing = [
        (incident.name, pattern)
        for incident in story.incidents
        for pattern in incident.patterns
        if not any(is_near(line, incident) and re.search(pattern, line.text) for line in lines)
    ]
    assert missing == []


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


@pytest.mark.parametrize(("begin", "end"), [(18.5, 19.5), (7.0, 9.7), (-40_000.0, 6.0)])
def test_show_and_export_of_a_part_have_the_same_lines(
    begin: float, end: float, story: Story, tmp_path: Path
) -> None:
    new = tmp_path / "new.mcap"
    times = [datetime.fromtimestamp(NINE / 1e9 + at).isoformat() for at in (begin, end)]
    words = ["--from", times[0], "--to", times[1], "--directory", str(story.where)]
    show = shown_lines(*words)
    assert len(show) > 1
    # The first argument is a file.
    first = str(listed(story.where)[1 if begin > 0 else 0])
    del words[4:]
    assert main(["recording", "export", first, str(new), *words]) == 0
    assert [line.text for line in log_of(new)] == [line.text for line in shown_lines(first, *words)]


def test_show_and_export_of_a_damaged_recording_have_the_same_lines(
    story: Story, tmp_path: Path
) -> None:
    bad, new = tmp_path / "bad.rec.zst", tmp_path / "new.mcap"
    data = bytearray(listed(story.where)[1].read_bytes())
    _, begin, end, *_ = [found.start() for found in re.finditer(re.escape(MAGIC), data)]
    data[(begin + end) // 2] ^= 0xFF
    bad.write_bytes(data)
    assert main(["recording", "export", str(bad), str(new)]) == Exit.INCOMPLETE
    show = shown_lines(str(bad))
    (gap,) = [number for number, line in enumerate(show) if line.text.startswith("gap: ")]
    assert len(show) - gap > 5
    assert [line.text for line in log_of(new)] == [line.text for line in show]

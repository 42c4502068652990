"""Starts a daemon as a user starts it, and measures it from both ends: the bus and the serial port.

    bench (bus client)  <- loopback TCP ->  daemon  <- pty ->  far_end.py (simulated MCU)

The three processes use the same monotonic clock, so their times can be compared. The measured
program is usually acsard. It may be any other program that accepts `--config` and `--port` and uses
the same Zenoh keys.
"""

from __future__ import annotations

import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Self, TypeVar

import msgspec
import zenoh

from acsard.bus.subscription import direct, encoded
from acsard.bus.zenoh_sessions import client_session
from acsard.core.config.parsing import effective
from acsard.core.config.settings import Config
from acsard.core.link.codec import Codec
from acsard.core.messages.encodings import Decoder, encode, encoding_name
from acsard.core.messages.keys_and_roles import full_key
from acsard.core.messages.schema import Odometry, RobotState, Twist, Vector3
from acsard.core.messages.signature import Signature
from acsard.core.motion.kinematics import Kinematics
from acsard.core.values import NS_PER_S, WheelSpeeds
from acsard.host import clock
from acsard.host.child import end, end_with_parent, environment
from acsard.host.errors import NoAnswerError, UnreachableError
from acsard.host.own_identity import sender_id
from tests.bench.matching import Record, RecordedTraffic, Sample, SentCommand

END_TIMEOUT_S = 5.0
"""Time limit for a process to end after the request to end, s. It usually takes 0.2 s."""


def processor_ns(pid: int) -> int:
    """Return the processor time of all threads of a process so far, ns."""
    return sum(
        int(task.joinpath("schedstat").read_text().split()[0])
        for task in Path(f"/proc/{pid}/task").iterdir()
    )


T = TypeVar("T")

ACSARD = (sys.executable, "-m", "acsard", "run")

START_TIMEOUT_S = 15.0
"""Time limit for each step of the daemon's start, s. A start takes 0.3 s, or 2.3 s if opening the
port resets the board."""

START_SAMPLES = 10
"""Number of odometry samples that must arrive before the daemon's start counts as complete."""


SIMULATOR_PROCESS = "the simulated microcontroller's process"

SPACING_S = (0.02, 0.06)
"""Shortest and longest random time between two commands, s. If this time were constant, all
commands could arrive at the same phase of the daemon's control period."""


class Rig:
    """Context manager that starts the measured program and waits until it publishes odometry.

    `command()` measures, and `end()` returns the record.

    Args:
        config: the configuration in `file`.
        file: the configuration file of the measured program.
        command_line: the command line that starts the measured program.
    """

    def __init__(self, config: Config, file: Path, command_line: Sequence[str] = ACSARD) -> None:
        self._config, self._file, self._command_line = config, file, command_line
        self._endpoint = config.bus.listen[0]
        self._codec = Codec(config.mcu.wheels, config.mcu.trailing_comma)
        self._kinematics = Kinematics(config.drive)
        # A sender with its own identity may drive as soon as it has sent a zero.
        self._attachment = Signature(sender_id("bench")).pack()
        self._stack = ExitStack()
        self._far_end: subprocess.Popen[bytes] | None = None
        self._session: zenoh.Session | None = None
        self._arrived: list[tuple[int, bytes]] = []
        self._sent: list[SentCommand] = []
        self._settled_ns = 0

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            where = Path(stack.enter_context(TemporaryDirectory(prefix="acsard-bench-")))
            self._log = where / "log"
            self._start_program(stack, self._start_far_end(stack, where))
            session = self._session = self._wait(self._connect, f"daemon at {self._endpoint}")
            stack.callback(session.close)
            key = full_key(self._config.robot.id, "odom")
            self._subscriber = session.declare_subscriber(key, direct(self._odometry))
            self._publisher = session.declare_publisher(
                full_key(self._config.robot.id, f"cmd/{self._config.commands.sources[0].name}"),
                encoding=encoding_name("msgpack", "Twist"),
                express=True,
            )
            self._wait(
                lambda: len(self._arrived) >= START_SAMPLES or None, "odometry from the daemon"
            )
            self._settled_ns = clock.mono_ns()
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *error: object) -> None:
        self._stack.close()

    # Starting

    def _start_far_end(self, stack: ExitStack, where: Path) -> str:
        part = where / "part.json"
        part.write_bytes(msgspec.json.encode(effective(self._config)))
        far_end = self._far_end = subprocess.Popen(
            [sys.executable, "-m", "tests.bench.far_end", str(part)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,
        )
        stack.callback(end, far_end, END_TIMEOUT_S)
        assert far_end.stdout is not None
        device = far_end.stdout.readline().decode().strip()
        assert device, f"{SIMULATOR_PROCESS} ended with {far_end.wait()}"
        return device

    def _start_program(self, stack: ExitStack, port: str) -> None:
        hidden = ("ACSARD_CONFIG", "ACSARD_TLS", "RUST_LOG", "STATE_DIRECTORY")
        words = [*self._command_line, "--config", str(self._file), "--port", port]
        env = {name: value for name, value in environment().items() if name not in hidden}
        # The measured daemon must not leave files behind, so it writes its latches to the temporary
        # directory.
        env["XDG_STATE_HOME"] = str(self._log.parent)
        with self._log.open("wb") as log:
            self.process = subprocess.Popen(
                words,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=log,
                env=env,
                start_new_session=True,
                # If the benchmark is killed, no daemon may remain.
                preexec_fn=partial(end_with_parent, signal.SIGTERM),
            )
        stack.callback(end, self.process, END_TIMEOUT_S)

    def _connect(self) -> zenoh.Session | None:
        try:
            return client_session(self._endpoint)
        except UnreachableError:
            return None

    def _wait(self, get: Callable[[], T | None], what: str) -> T:
        deadline_ns = clock.mono_ns() + int(START_TIMEOUT_S * NS_PER_S)
        while True:
            self._alive()
            result = get()
            if result is not None:
                return result
            if clock.mono_ns() > deadline_ns:
                raise TimeoutError(f"no {what} within {START_TIMEOUT_S:g} s{self._why()}")
            time.sleep(0.01)

    def _why(self) -> str:
        try:
            return f": {self.state().reason}"
        except NoAnswerError:
            return ""

    def _alive(self) -> None:
        if self._far_end is not None and self._far_end.poll() is not None:
            raise ChildProcessError(f"{SIMULATOR_PROCESS} ended with {self._far_end.returncode}")
        code = self.process.poll()
        if code is not None:
            raise ChildProcessError(f"the daemon ended with {code}: {self._log.read_text()}")

    # Measuring

    def _odometry(self, sample: zenoh.Sample) -> None:
        self._arrived.append((clock.mono_ns(), sample.payload.to_bytes()))

    def command(self, seconds: float, wheel_speed: Callable[[int], float], seed: int = 1) -> float:
        """Send commands at random intervals for `seconds` s, and return the daemon's processor use.

        The result is a share of one core. `wheel_speed` takes the number of a command (0, 1, ...)
        and returns the speed of all wheels, rad/s. `seed` determines the random intervals.
        """
        phases, number = random.Random(seed), 0
        self._neutral(phases)
        began_ns, used_ns = clock.mono_ns(), processor_ns(self.process.pid)
        while clock.mono_ns() - began_ns < seconds * NS_PER_S:
            time.sleep(phases.uniform(*SPACING_S))
            self._alive()
            self._sent.append(self._publish(wheel_speed(number)))
            number += 1
        # Wait for the line of the last command.
        time.sleep(0.1)
        self._publish(0.0)
        return self._share(began_ns, used_ns)

    def _neutral(self, phases: random.Random) -> None:
        """Send zeros until the daemon accepts one. At first it ignores a new sender."""
        before = self._counted()

        def send_zero() -> bool | None:
            self._publish(0.0)
            time.sleep(phases.uniform(*SPACING_S))
            return before is None or self._counted() != before or None

        self._wait(send_zero, "zero-speed command accepted by the daemon")
        time.sleep(0.2)

    def _counted(self) -> int | None:
        try:
            return self.state().counters.get("commands", 0)
        except NoAnswerError:
            return None

    def _share(self, began_ns: int, used_ns: int) -> float:
        self._alive()
        used_ns = processor_ns(self.process.pid) - used_ns
        return used_ns / (clock.mono_ns() - began_ns)

    def _publish(self, wheel_speed: float) -> SentCommand:
        speeds = WheelSpeeds(wheel_speed, wheel_speed, wheel_speed, wheel_speed)
        twist = self._kinematics.twist(speeds)
        message = Twist(Vector3(x=twist.linear), Vector3(z=twist.angular))
        payload, line = encode(message, "msgpack"), self._codec.encode(speeds).rstrip(b",\r\n")
        at_ns = clock.mono_ns()
        self._publisher.put(payload, attachment=self._attachment)
        return SentCommand(at_ns, line)

    def state(self) -> RobotState:
        key = full_key(self._config.robot.id, "state")
        for reply in self._session.get(key, timeout=3.0) if self._session else ():
            if reply.ok is not None:
                return Decoder(RobotState).decode(*encoded(reply.ok))
        raise NoAnswerError(f"no answer on {key}")

    def end(self) -> Record:
        """End the measured program and return the record. Do not use the rig afterward."""
        window_ns = (self._settled_ns, clock.mono_ns())
        # Wait for messages that have not arrived yet.
        time.sleep(0.1)
        self._alive()
        end(self.process, END_TIMEOUT_S)
        assert self._far_end is not None
        wire_data = _recorded_data(self._far_end)
        decoder = Decoder(Odometry)
        samples = []
        for at_ns, payload in self._arrived:
            if at_ns >= self._settled_ns:
                odometry = decoder.decode(encoding_name("msgpack"), payload)
                samples.append(Sample(at_ns, odometry.twist.twist.linear.x))
        return Record(window_ns, wire_data, self._sent, samples)


def _recorded_data(far_end: subprocess.Popen[bytes]) -> RecordedTraffic:
    assert far_end.stdin is not None
    assert far_end.stdout is not None
    far_end.stdin.close()
    output = far_end.stdout.read()
    assert far_end.wait(END_TIMEOUT_S) == 0, SIMULATOR_PROCESS
    return msgspec.msgpack.decode(output, type=RecordedTraffic)

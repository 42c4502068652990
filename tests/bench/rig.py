"""Measures a daemon from both ends: the bus and the serial port.

    bench (bus client)  <- loopback TCP ->  daemon  <- pty ->  far_end.py (simulated MCU)

The three processes use the same monotonic clock, so their times can be compared. The measured
program is usually acsard. It may be any other program that accepts `--config` and `--port` and uses
the same Zenoh keys. The processes and the bus are those of `tests/system/harness.py`.
"""

from __future__ import annotations

import random
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Self

import msgspec
import zenoh

from acsard.bus.subscription import direct
from acsard.core.config.parsing import effective
from acsard.core.config.settings import Config
from acsard.core.link.codec import Codec
from acsard.core.messages.encodings import Decoder, encode, encoding_name
from acsard.core.messages.schema import Odometry, Twist, Vector3
from acsard.core.messages.signature import Signature
from acsard.core.motion.kinematics import Kinematics
from acsard.core.values import NS_PER_S, WheelSpeeds
from acsard.host import clock
from acsard.host.own_identity import sender_id
from tests.bench.matching import Record, RecordedTraffic, Sample, SentCommand
from tests.system.harness import START_S, Bus, Program, acsard, until

ACSARD: Sequence[str] = acsard("run")

START_SAMPLES = 10
"""Number of odometry samples that must arrive before the daemon's start counts as complete."""

SPACING_S = (0.02, 0.06)
"""Shortest and longest random time between two commands, s. If this time were constant, all
commands could arrive at the same phase of the daemon's control period."""


def processor_ns(pid: int) -> int:
    """Return the processor time of all threads of a process so far, ns."""
    return sum(
        int(task.joinpath("schedstat").read_text().split()[0])
        for task in Path(f"/proc/{pid}/task").iterdir()
    )


class Rig:
    """Context manager that starts the measured program and waits until it publishes odometry.

    `command()` measures, and `end()` returns the record.

    Args:
        config: the configuration in `file`.
        file: the configuration file of the measured program, in a directory of its own.
        command_line: the command line that starts the measured program.
    """

    def __init__(self, config: Config, file: Path, command_line: Sequence[str] = ACSARD) -> None:
        self._config, where = config, file.parent
        self._codec = Codec(config.mcu.wheels, config.mcu.trailing_comma)
        self._kinematics = Kinematics(config.drive)
        # A sender with its own identity may drive as soon as it has sent a zero.
        self._attachment = Signature(sender_id("bench")).pack()
        part, self._record = where / "part.json", where / "record"
        part.write_bytes(msgspec.json.encode(effective(config)))
        far_end = [sys.executable, "-m", "tests.bench.far_end", str(part), str(self._record)]
        self._far_end = Program(far_end, where, stdin=subprocess.PIPE)
        self._words, self._where = [*command_line, "--config", str(file), "--port"], where
        self._arrived: list[tuple[int, bytes]] = []
        self._sent: list[SentCommand] = []
        self._settled_ns = 0

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            stack.enter_context(self._far_end)
            port = self._far_end.says("/dev/")
            # The measured daemon writes its latches to the temporary directory.
            self._program = stack.enter_context(Program([*self._words, port], self._where))
            self.process = self._program.process
            endpoint = self._config.bus.listen[0]
            self.bus = stack.enter_context(until(self._connect, START_S, f"{endpoint}"))
            key = f"{self.bus.root}/cmd/{self._config.commands.sources[0].name}"
            session, how = self.bus.session, encoding_name("msgpack", "Twist")
            self._subscriber = session.declare_subscriber(
                f"{self.bus.root}/odom", direct(self._odometry)
            )
            self._publisher = session.declare_publisher(key, encoding=how, express=True)
            until(
                lambda: self._alive() and len(self._arrived) >= START_SAMPLES, START_S, "odometry"
            )
            self._settled_ns = clock.mono_ns()
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *error: object) -> None:
        self._stack.close()

    def _connect(self) -> Bus | None:
        self._alive()
        try:
            return Bus(self._config.bus.listen[0], self._config.robot.id)
        except zenoh.ZError:
            return None

    def _alive(self) -> bool:
        for program in (self._far_end, self._program):
            assert program.process.poll() is None, f"{program.words} has ended\n{program}"
        return True

    def _odometry(self, sample: zenoh.Sample) -> None:
        self._arrived.append((clock.mono_ns(), sample.payload.to_bytes()))

    def command(self, seconds: float, wheel_speed: Callable[[int], float], seed: int = 1) -> float:
        """Send commands at random intervals for `seconds` s, and return the daemon's processor use.

        The result is a share of one core. `wheel_speed` takes the number of a command (0, 1, ...)
        and returns the speed of all wheels, rad/s. `seed` determines the random intervals.
        """
        phases, number = random.Random(seed), 0
        self._neutral()
        began_ns, used_ns = clock.mono_ns(), processor_ns(self.process.pid)
        while clock.mono_ns() - began_ns < seconds * NS_PER_S:
            time.sleep(phases.uniform(*SPACING_S))
            self._alive()
            self._sent.append(self._publish(wheel_speed(number)))
            number += 1
        # Wait for the line of the last command.
        time.sleep(0.1)
        self._publish(0.0)
        used_ns = processor_ns(self.process.pid) - used_ns
        return used_ns / (clock.mono_ns() - began_ns)

    def _neutral(self) -> None:
        """Send zeros until the daemon accepts one. At first it ignores a new sender.

        A program without a state accepts every command.
        """
        before = self.bus.count("commands") if self.bus.ask("state") else None

        def accepted() -> bool:
            self._publish(0.0)
            time.sleep(SPACING_S[0])
            return before is None or self.bus.count("commands") != before

        until(accepted, START_S, "a zero that the daemon accepts")
        time.sleep(0.2)

    def _publish(self, wheel_speed: float) -> SentCommand:
        speeds = WheelSpeeds(wheel_speed, wheel_speed, wheel_speed, wheel_speed)
        twist = self._kinematics.twist(speeds)
        message = Twist(Vector3(x=twist.linear), Vector3(z=twist.angular))
        payload, line = encode(message, "msgpack"), self._codec.encode(speeds).rstrip(b",\r\n")
        at_ns = clock.mono_ns()
        self._publisher.put(payload, attachment=self._attachment)
        return SentCommand(at_ns, line)

    def end(self) -> Record:
        """End the measured program and return the record. Do not use the rig afterward."""
        window_ns = (self._settled_ns, clock.mono_ns())
        # Wait for messages that have not arrived yet.
        time.sleep(0.1)
        self._alive()
        self._program.__exit__()
        assert self._far_end.process.stdin is not None
        self._far_end.process.stdin.close()
        assert self._far_end.ended(5.0) == 0, self._far_end
        traffic = msgspec.msgpack.decode(self._record.read_bytes(), type=RecordedTraffic)
        decoder, how = Decoder(Odometry), encoding_name("msgpack")
        samples = [
            Sample(at_ns, decoder.decode(how, payload).twist.twist.linear.x)
            for at_ns, payload in self._arrived
            if at_ns >= self._settled_ns
        ]
        return Record(window_ns, traffic, self._sent, samples)

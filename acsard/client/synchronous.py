"""The client for scripts. Each method blocks the calling thread until it has finished."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager

from acsard.bus.address import address_by_environment
from acsard.bus.subscription import Subscription
from acsard.client.connection import Connection, accepted, open_connection
from acsard.client.driving import Driver, Steps, UnheardError, drive, move, turn
from acsard.client.identity import ClientIdentity
from acsard.client.reads import Reads
from acsard.core.messages.schema import ServiceReply
from acsard.core.values import Plain, Pose
from acsard.host.errors import NoAnswerError


@contextmanager
def connect(
    endpoint: str | None = None,
    *,
    robot_id: str | None = None,
    source: str = "app",
    tls: str | None = None,
) -> Iterator[Client]:
    """Connect to a daemon, and yield a client that is connected until the end of the `with` block.

    If an argument is None, its value comes from the configuration file that the environment
    variable ACSARD_CONFIG names. The variable ACSARD_TLS overrides the certificate directory in
    that file.

    Args:
        endpoint: the endpoint of the daemon or a router, such as "tls/robot.local:7449". Without a
            configuration file, it is "tcp/127.0.0.1:7448".
        robot_id: the id of the robot. Without a configuration file, it is "acsar".
        source: the command source as which the client sends its commands, a name in
            `[[commands.sources]]`.
        tls: the directory with your certificate, for an endpoint that begins with "tls/". If it is
            None, and neither ACSARD_TLS nor ACSARD_CONFIG is set, the client uses no certificate.
    """
    with open_connection(address_by_environment(endpoint, robot_id, tls), source) as connection:
        yield Client(connection)


class Client(Reads):
    """A connection to one robot. Create it with `connect`."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection

    @property
    def name(self) -> str:
        """The name of this program in the robot's log of service calls. You may change it."""
        return self._connection.name

    @name.setter
    def name(self, name: str) -> None:
        self._connection.name = name

    def send(self, linear: float, angular: float = 0.0) -> None:
        """Send one command: `linear` m/s, `angular` rad/s (left is +).

        Repeat the call to keep the robot moving. Until the daemon's first beat has arrived, after
        about 0.05 s, nothing is sent. The first command is a zero (the speed 0) instead, because
        the daemon requires a zero before it follows a sender.
        """
        self._connection.send(linear, angular)

    def drive(self, linear: float, angular: float = 0.0, *, seconds: float) -> None:
        """Drive for `seconds` (above 0), then slow down, and return when the robot stands still.

        `linear` is in m/s and `angular` in rad/s (left is +). Speeds above the robot's `[limits]`
        are not an error: the robot drives at its limits. `get("config")` returns the limits, and
        `get("cmd_vel_out")` returns the applied speed.

        Raises:
            NotDrivenError: The robot does not follow the commands; the text is the daemon's reason.
                Or this program sent no command for more than 0.5 s during the drive, because the
                program was suspended or the network failed.
            NotPermittedError: The role of this client may not drive the robot.
            NoAnswerError: The daemon is silent.
            UsageError: An argument is not valid.
        """
        self._run(drive(linear, angular, seconds))

    def move(self, distance: float, *, speed: float = 0.3) -> None:
        """Drive `distance` m straight ahead (back if negative), and return when the robot stands.

        `odom` measures the way: in the simulator the robot stops within 5 mm. The errors are those
        of `drive`, and `NotDrivenError` if the robot comes no nearer to the end for 3 s, or if the
        pose is set meanwhile.
        """
        self._run(move(distance, speed))

    def turn(self, degrees: float, *, speed: float = 0.8) -> None:
        """Turn on the spot by an angle (left is +) at up to `speed` rad/s.

        `odom` measures the angle: in the simulator the robot stops within 0.5 degrees. The errors
        are those of `move`.
        """
        self._run(turn(degrees, speed))

    def _run(self, steps: Steps) -> None:
        driver = Driver(self._connection)
        try:
            with closing(steps(driver)) as pauses:
                for pause_s in pauses:
                    time.sleep(pause_s)
        except BaseException as error:
            for pause_s in driver.zeros():
                time.sleep(pause_s)
            if isinstance(error, UnheardError | NoAnswerError):
                raise self._connection.explain_error(error) from None
            raise
        finally:
            driver.end()

    def stop(self) -> ServiceReply:
        """Stop the robot until `clear`, and return its reply. Raises `ReplyError`."""
        return self.call("stop")

    def clear(self) -> ServiceReply:
        """Release the faults and stops from before this call. Raises `ReplyError`."""
        return self.call("clear")

    def call(self, service: str, **fields: object) -> ServiceReply:
        """Call a service, such as "reset_odometry", and return its reply.

        Raises `ReplyError` if the robot refuses. `fields` are the fields of the payload.

        The service "clear" releases faults and stops, and "activate" switches on an inactive robot.
        Both release only the causes whose `numbers` they name. Without the field `numbers`, this
        method names the `causes` in the key `state` that are older than the call. If a person
        decided to make the call because of an earlier state, pass the numbers of that state:
        `numbers=[cause.number for cause in state.causes]`. A later stop then stays.
        """
        return accepted(self._connection.call(service, **fields))

    def set(self, settings: Mapping[str, Plain]) -> ServiceReply:
        """Change settings of the daemon, for example `{"rates.odom": 5.0}`, and return the reply.

        The daemon changes all of the settings, or none and `ReplyError` is raised. The change lasts
        until the next start of the daemon.
        """
        return accepted(self._connection.set(settings))

    def whoami(self) -> ClientIdentity:
        """Return this client's role and name at the robot. The role is "" if it is unknown."""
        return self._connection.whoami()

    def pose(self) -> Pose:
        """Return the present pose of the robot in the odom frame, m and rad."""
        return self._connection.pose()

    def _reply(self, name: str) -> tuple[str, bytes]:
        return self._connection.reply(name)

    def _subscribe(self, name: str) -> Subscription:
        return self._connection.subscribe(name)

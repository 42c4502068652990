"""The keys of `acsard.toml`: names, defaults, ranges and units, with one frozen struct per table.

The file `acsard.toml` at the root of the repository is the commented reference. A test proves that
its values equal these defaults. The rules between keys are in `contradictions.py`.
"""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta, Struct

from acsard.core.config.wire_time import COMFORTABLE_USE, highest_rate, line_bytes
from acsard.core.values import NS_PER_S, TWO_WHEELS, WHEELS, BatteryLevel, Role

Name = Annotated[
    str,
    Meta(
        pattern=r"^[A-Za-z0-9_-]{1,32}\Z",
        extra={"unit": "1 to 32 characters of A-Z a-z 0-9 _ -", "example": "app"},
    ),
]
FrameId = Annotated[
    str,
    Meta(
        pattern=r"^[A-Za-z0-9_][A-Za-z0-9_/]{0,63}\Z",
        extra={
            "unit": "a frame or joint name: 1 to 64 characters of A-Z a-z 0-9 _ /, no leading slash"
        },
    ),
]
Text = Annotated[
    str,
    Meta(
        pattern=r"^[^\x00]{1,256}\Z",
        extra={"unit": "a text of 1 to 256 characters"},
    ),
]
Directory = Annotated[
    str,
    Meta(
        pattern=r"^[^\x00]{0,256}\Z",
        extra={"unit": "a directory, or empty"},
    ),
]
CommonName = Annotated[
    str,
    Meta(
        # The name becomes a part of keys on the bus, and the message `state` shows it.
        pattern=r"^(?!@)[\w .:@+-]{1,64}\Z",
        extra={
            "unit": "the common name of a certificate: 1 to 64 letters, digits, spaces and "
            "_.:@+-, and no @ at the start",
            "example": "operator",
        },
    ),
]
RosNamespace = Annotated[
    str,
    Meta(
        pattern=r"^(|[A-Za-z_][A-Za-z0-9_]{0,63}(/[A-Za-z_][A-Za-z0-9_]{0,63}){0,3})\Z",
        extra={"unit": "one or more ROS names with / between them, or empty", "example": "robot1"},
    ),
]
WebAddress = Annotated[
    str,
    Meta(
        pattern=r"^https?://(\[[0-9A-Fa-f:.]{2,45}\]|[A-Za-z0-9.-]{1,253}):[0-9]{1,5}\Z",
        extra={
            "unit": "http(s)://, an address, a colon and a port",
            "example": "http://127.0.0.1:8080",
        },
    ),
]
WebOrigin = Annotated[
    str,
    Meta(
        pattern=(
            r"^(?!http://.*:80\Z|https://.*:443\Z)"
            r"https?://(\[[0-9a-f:.]{2,45}\]|[a-z0-9.-]{1,253})(:[0-9]{1,5})?\Z"
        ),
        extra={
            "unit": "http(s):// and a host in lower case, then the port if it is not 80 or 443",
            "example": "http://127.0.0.1:5173",
        },
    ),
]
WebCamera = Annotated[
    str,
    Meta(
        pattern=(
            r"^(|https?://(\[[0-9A-Fa-f:.]{2,45}\]|[A-Za-z0-9.-]{1,253})(:[0-9]{1,5})?"
            r"(/[!-~]{0,200})?)\Z"
        ),
        extra={
            "unit": "the http(s):// address of an MJPEG stream, or empty",
            "example": "http://127.0.0.1:8081/stream",
        },
    ),
]
FaultName = Annotated[
    str,
    Meta(
        pattern=r"^[\x20-\x7e]{1,64}\Z",
        extra={"unit": "a fault that `acsard sim --fault` accepts, in quotes", "example": "ftdi"},
    ),
]
Length = Annotated[float, Meta(ge=0.001, le=10.0, extra={"unit": "m"})]
Offset = Annotated[float, Meta(ge=-10.0, le=10.0, extra={"unit": "m"})]
Angle = Annotated[float, Meta(ge=-6.2832, le=6.2832, extra={"unit": "rad"})]
Factor = Annotated[float, Meta(ge=0.1, le=10.0)]
LinearSpeed = Annotated[float, Meta(ge=0.0, le=10.0, extra={"unit": "m/s"})]
AngularSpeed = Annotated[float, Meta(ge=0.0, le=50.0, extra={"unit": "rad/s"})]
LinearRate = Annotated[float, Meta(ge=0.01, le=100.0, extra={"unit": "m/s2"})]
AngularRate = Annotated[float, Meta(ge=0.01, le=500.0, extra={"unit": "rad/s2"})]
LinearJerk = Annotated[float, Meta(ge=0.0, le=1000.0, extra={"unit": "m/s3 (0 = no limit)"})]
AngularJerk = Annotated[float, Meta(ge=0.0, le=5000.0, extra={"unit": "rad/s3 (0 = no limit)"})]
WheelSpeed = Annotated[float, Meta(ge=0.1, le=99.99, extra={"unit": "rad/s"})]
ErrorRate = Annotated[float, Meta(ge=0.0, le=10.0)]
Deviation = Annotated[float, Meta(ge=0.0, le=1.0)]
PublishRate = Annotated[float, Meta(ge=0.0, le=1000.0, extra={"unit": "Hz (0 = every sample)"})]
MOTOR_UNIT = 'a sign and the letter of a motor, such as "+a" (a to z without n and p)'
Motor = Annotated[
    str, Meta(pattern=r"^[+-][a-moq-z]\Z", extra={"unit": MOTOR_UNIT, "example": "+a"})
]
MotorOfTwo = Annotated[
    str,
    Meta(
        pattern=r"^([+-][a-moq-z])?\Z", extra={"unit": f"{MOTOR_UNIT}, or empty", "example": "+l"}
    ),
]
EncoderCounts = Annotated[
    int, Meta(ge=0, le=100_000, extra={"unit": "per wheel turn (0 = unknown)"})
]
Baud = Literal[9600, 19200, 38400, 57600, 115200, 250000, 500000]


class RobotConfig(Struct, frozen=True):
    id: Name = "acsar"


class WheelMap(Struct, frozen=True):
    front_right: Motor = "+a"
    front_left: Motor = "+b"
    rear_left: Motor = "+c"
    rear_right: Motor = "+d"
    left: MotorOfTwo = ""
    right: MotorOfTwo = ""

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the driven wheels: `right` and `left`, or those in `WHEELS`."""
        return TWO_WHEELS if self.left or self.right else WHEELS

    @property
    def motors(self) -> tuple[str, ...]:
        """Return the sign and the letter of the motor of each wheel, in the order of `names`."""
        return tuple(getattr(self, name) for name in self.names)

    @property
    def letters(self) -> str:
        """Return the letters of the motors in the order of a line."""
        return "".join(sorted(motor[1] for motor in self.motors))


SIMULATOR = "sim"
"""Value of `mcu.port` that selects the built-in simulator."""

MAX_REPLY_PERIOD_S = 0.25
"""Largest allowed interval between two feedback lines of the board, s. A board that is silent for
one second counts as restarted. With this interval, the loss of two lines in a row causes a silence
of only 0.75 s."""


class McuConfig(Struct, frozen=True):
    port: Text = SIMULATOR
    baud_rate: Baud = 115200
    trailing_comma: bool = False
    reply_period: Annotated[
        float,
        Meta(ge=0.0, le=MAX_REPLY_PERIOD_S, extra={"unit": "s between two lines of the board"}),
    ] = 0.0
    link_check: Literal["off", "on"] = "off"
    encoder_counts: EncoderCounts = 0
    wheels: WheelMap = WheelMap()

    @property
    def simulated(self) -> bool:
        """True if the built-in simulator is used instead of a serial device."""
        return self.port == SIMULATOR

    @property
    def checked(self) -> bool:
        """True if every line and every reply has a sequence number and a checksum."""
        return self.link_check == "on"

    @property
    def wants_samples(self) -> bool:
        """True if the daemon asks the board for its encoder counts with every line."""
        return self.checked and self.encoder_counts > 0

    @property
    def line_bytes(self) -> int:
        """Length of the longest serial line that the daemon or the board may send, bytes."""
        motors = len(self.wheels.names)
        return line_bytes(motors, self.trailing_comma, self.checked, self.wants_samples)


class ControlConfig(Struct, frozen=True):
    rate: Annotated[float, Meta(ge=10.0, le=1000.0, extra={"unit": "Hz"})] | Literal["auto"] = 100.0
    real_time: bool = True
    state_directory: Annotated[
        str,
        Meta(
            pattern=r"^(~?/[^\x00]{0,254})?\Z",
            extra={"unit": "a directory that begins with / or ~/, or empty"},
        ),
    ] = ""


class DriveConfig(Struct, frozen=True):
    wheel_radius: Length = 0.05
    wheel_separation: Length = 0.30
    wheel_separation_multiplier: Factor = 1.0
    left_wheel_radius_multiplier: Factor = 1.0
    right_wheel_radius_multiplier: Factor = 1.0


class JointsConfig(Struct, frozen=True):
    front_right: FrameId = "front_right_wheel_joint"
    front_left: FrameId = "front_left_wheel_joint"
    rear_left: FrameId = "rear_left_wheel_joint"
    rear_right: FrameId = "rear_right_wheel_joint"
    left: FrameId = "left_wheel_joint"
    right: FrameId = "right_wheel_joint"


class FeedbackConfig(Struct, frozen=True):
    encoders: bool = True
    wheel_speed: WheelSpeed = 80.0
    response_time: Annotated[float, Meta(ge=0.01, le=5.0, extra={"unit": "s"})] = 0.2


EstopUse = Literal["auto", "required", "off"]
Place = Literal["front", "rear", "left", "right"]
BumperUse = Literal["stop", "away", "off"]


class SafetyConfig(Struct, frozen=True):
    estop: EstopUse = "auto"
    bumpers: Annotated[tuple[Place, ...], Meta(max_length=4)] = ()
    bumper: BumperUse = "stop"

    @property
    def needs_bumpers(self) -> bool:
        """True if the robot must not drive unless its board reports the bumpers."""
        return bool(self.bumpers) and self.bumper != "off"


HYSTERESIS = 0.5  # V or %, by which the mean must exceed the threshold of a level that ends

Threshold = Annotated[float, Meta(ge=0.0, le=100.0, extra={"unit": "V or % (0 = off)"})]


class BatteryConfig(Struct, frozen=True):
    measure: Literal["volts", "percent"] = "volts"
    warning_below: Threshold = 0.0
    stop_below: Threshold = 0.0

    @property
    def bounds(self) -> dict[BatteryLevel, float]:
        """Threshold of each battery level, V or %, from the least to the most severe level.

        A level is left out if its threshold is 0.
        """
        thresholds: dict[BatteryLevel, float] = {
            "warning": self.warning_below,
            "stop": self.stop_below,
        }
        return {level: below for level, below in thresholds.items() if below}


class LimitsConfig(Struct, frozen=True):
    linear_speed: LinearSpeed = 1.0
    angular_speed: AngularSpeed = 4.0
    linear_acceleration: LinearRate = 1.0
    angular_acceleration: AngularRate = 4.0
    linear_deceleration: LinearRate = 1.0
    angular_deceleration: AngularRate = 4.0
    linear_stop_deceleration: LinearRate = 3.0
    angular_stop_deceleration: AngularRate = 12.0
    linear_jerk: LinearJerk = 0.0
    angular_jerk: AngularJerk = 0.0
    wheel_speed: WheelSpeed = 40.0


class Source(Struct, frozen=True):
    name: Name
    priority: Annotated[int, Meta(ge=0, le=1000, extra={"example": 50})]
    timeout: Annotated[float, Meta(ge=0.02, le=10.0, extra={"unit": "s"})] = 0.25
    neutral_first: Literal["zero", "pause"] = "zero"


class CommandsConfig(Struct, frozen=True):
    sources: tuple[Source, ...] = (
        Source("teleop", 100),
        Source("app", 50),
        Source("ros2_control", 20),
        Source("dock", 15),
        Source("nav", 10, neutral_first="pause"),
    )


# By the number of driven wheels, of the track's multiplier before a calibration. Four fixed wheels
# skid, and turn real robots as if they were 1.5 to 2 times as far apart.
UNCALIBRATED_STD = {4: 0.3, 2: 0.05}


class OdometryConfig(Struct, frozen=True):
    odom_frame: FrameId = "odom"
    base_frame: FrameId = "base_link"
    publish_tf: bool = True
    gyro: bool = False
    gyro_scale_std: Deviation = 0.03
    distance_variance_per_metre: ErrorRate = 1e-4
    yaw_variance_per_metre: ErrorRate = 1e-4
    yaw_variance_per_radian: ErrorRate = 1e-2
    wheel_separation_multiplier_std: Deviation | Literal["uncalibrated"] = "uncalibrated"
    wheel_radius_ratio_std: Deviation = 0.01
    distance_scale_std: Deviation = 0.02

    @property
    def calibrated(self) -> bool:
        """Whether anybody has measured the track, and has written how well."""
        return self.wheel_separation_multiplier_std != "uncalibrated"

    def track_std(self, wheels: int) -> float:
        """Return the standard deviation of the multiplier of the track of a robot with `wheels`."""
        given = self.wheel_separation_multiplier_std
        return UNCALIBRATED_STD[wheels] if given == "uncalibrated" else given


class LidarConfig(Struct, frozen=True):
    publish_tf: bool = True
    lidar_frame: FrameId = "lidar_link"
    lidar_x_offset: Offset = 0.0
    lidar_y_offset: Offset = 0.0
    lidar_yaw: Angle = 0.0


STATE_HZ = 10.0
DIAGNOSTICS_HZ = 1.0


class RatesConfig(Struct, frozen=True):
    odom: PublishRate = 0.0
    telemetry: PublishRate = 0.0

    @property
    def state_hz(self) -> float:
        """Rate of `state`, Hz."""
        return self.at_most(STATE_HZ)

    def at_most(self, hz: float) -> float:
        """Return the rate of a message that is built `hz` times a second unless it is limited."""
        return min(hz, self.telemetry or hz)


TLS_PREFIX = "tls/"
"""Prefix of endpoints with mutual TLS: the server and the client each present a
certificate."""


def is_tls(endpoint: str) -> bool:
    return endpoint.startswith(TLS_PREFIX)


class BusConfig(Struct, frozen=True):
    mode: Literal["peer", "client"] = "peer"
    listen: tuple[Text, ...] = ("tcp/127.0.0.1:7448",)
    connect: tuple[Text, ...] = ()
    tls: Directory = ""
    insecure: bool = False

    @property
    def plain(self) -> tuple[str, ...]:
        """The endpoints without TLS, at which the daemon listens."""
        return tuple(e for e in self.listening if not is_tls(e))

    @property
    def outside(self) -> tuple[str, ...]:
        """The endpoints with TLS, at which the TLS gateway listens."""
        return tuple(e for e in self.listening if is_tls(e))

    @property
    def tls_routers(self) -> tuple[str, ...]:
        """The endpoints in `connect` with TLS."""
        return tuple(e for e in self.connect if is_tls(e))

    @property
    def uses_tls(self) -> bool:
        """Whether the bus uses the certificates in `tls`; else only the page may."""
        return bool(self.tls_routers or self.outside)

    @property
    def listening(self) -> tuple[str, ...]:
        """The endpoints at which the daemon or its gateway listens: none if `mode` is "client"."""
        return self.listen if self.mode == "peer" else ()


class AccessConfig(Struct, frozen=True):
    viewers: tuple[CommonName, ...] = ("viewer",)
    operators: tuple[CommonName, ...] = ("operator",)
    maintainers: tuple[CommonName, ...] = ("maintainer",)
    wildcards: bool = False

    @property
    def members(self) -> dict[Role, tuple[str, ...]]:
        """The common names of the certificates that have each role."""
        return {
            "viewer": self.viewers,
            "operator": self.operators,
            "maintainer": self.maintainers,
        }


class RosConfig(Struct, frozen=True):
    bridge: bool = True
    rmw: bool = True
    domain: Annotated[int, Meta(ge=0, le=232)] = 0
    namespace: RosNamespace = ""


class LogConfig(Struct, frozen=True):
    level: Literal["debug", "info", "warning", "error"] = "info"


RECORD_VARIABLE = "ACSARD_RECORD"
"""Environment variable with which the systemd units set the directory of the recordings."""


class RecordConfig(Struct, frozen=True):
    directory: Directory = ""
    megabytes: Annotated[float, Meta(ge=10.0, le=1e6, extra={"unit": "MB"})] = 1000.0


class WebConfig(Struct, frozen=True):
    page: bool = True
    address: Annotated[tuple[WebAddress, ...], Meta(min_length=1, max_length=8)] = (
        "http://127.0.0.1:8080",
    )
    local: Role = "maintainer"
    origins: Annotated[tuple[WebOrigin, ...], Meta(max_length=16)] = ()
    camera: WebCamera = ""


class SimConfig(Struct, frozen=True):
    motor_time_constant: Annotated[float, Meta(ge=0.0, le=5.0, extra={"unit": "s"})] = 0.05
    encoder_counts: Annotated[int, Meta(ge=16, le=1_000_000, extra={"unit": "per turn"})] = 3200
    track_multiplier: Factor = 1.0
    faults: tuple[FaultName, ...] = ()


class FleetConfig(Struct, frozen=True):
    robots: tuple[Name, ...] = ()


class Config(Struct, frozen=True):
    robot: RobotConfig = RobotConfig()
    mcu: McuConfig = McuConfig()
    control: ControlConfig = ControlConfig()
    drive: DriveConfig = DriveConfig()
    joints: JointsConfig = JointsConfig()
    limits: LimitsConfig = LimitsConfig()
    feedback: FeedbackConfig = FeedbackConfig()
    safety: SafetyConfig = SafetyConfig()
    battery: BatteryConfig = BatteryConfig()
    commands: CommandsConfig = CommandsConfig()
    odometry: OdometryConfig = OdometryConfig()
    lidar: LidarConfig = LidarConfig()
    rates: RatesConfig = RatesConfig()
    bus: BusConfig = BusConfig()
    access: AccessConfig = AccessConfig()
    ros: RosConfig = RosConfig()
    log: LogConfig = LogConfig()
    record: RecordConfig = RecordConfig()
    web: WebConfig = WebConfig()
    fleet: FleetConfig = FleetConfig()
    sim: SimConfig = SimConfig()

    @property
    def rate_hz(self) -> float:
        """Control rate, Hz.

        The setting `"auto"` means the highest whole number of Hz, up to 100, at which the lines use
        at most 80 % of the serial wire's capacity.
        """
        if self.control.rate != "auto":
            return float(self.control.rate)
        mcu = self.mcu
        return float(min(100, highest_rate(mcu.baud_rate, mcu.line_bytes, COMFORTABLE_USE)))

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints of the driven wheels, in the order of `WheelMap.names`."""
        return tuple(getattr(self.joints, name) for name in self.mcu.wheels.names)

    @property
    def period_ns(self) -> int:
        """Control period, ns."""
        return int(NS_PER_S / self.rate_hz)

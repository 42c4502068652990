"""All mistakes in a configuration are reported at once.

Each has a line with key, value and correction.
"""

from __future__ import annotations

import tomllib
from pathlib import Path

import msgspec
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from msgspec import inspect

from acsard.core.config.contradictions import warnings
from acsard.core.config.parsing import ConfigError, effective, from_builtins, parse
from acsard.core.config.settings import Config, Source
from tests.each import each
from tests.unit.keys import KEYS, Key

REFERENCE = Path(__file__).parents[4] / "acsard.toml"

FLOATS = [key for key in KEYS if any(isinstance(kind, inspect.FloatType) for kind in key.numbers())]


def problems_of(
    text: str | bytes, overrides: dict[str, dict[str, object]] | None = None
) -> list[str]:
    with pytest.raises(ConfigError) as caught:
        parse(text if isinstance(text, bytes) else text.encode(), overrides)
    return caught.value.problems


def accepted(text: str) -> Config:
    return parse(text.encode())


# the file as a whole


def test_an_empty_file_gives_the_defaults() -> None:
    assert parse(b"") == Config()


def test_a_file_may_begin_with_a_byte_order_mark() -> None:
    # Notepad on Windows writes this mark.
    config = parse(b'\xef\xbb\xbf[robot]\r\nid = "r7"\r\n')
    assert config.robot.id == "r7"


def test_the_reference_file_decodes_to_exactly_the_defaults() -> None:
    assert parse(REFERENCE.read_bytes()) == Config()


def test_the_reference_file_has_every_key_of_every_table_and_no_other() -> None:
    table = tomllib.loads(REFERENCE.read_text(encoding="utf-8"))
    for source in table["commands"]["sources"]:
        source.setdefault("timeout", 0.25)
    assert table == msgspec.json.decode(msgspec.json.encode(effective(Config())))


@each("key", KEYS)
def test_the_reference_file_gives_each_key_its_default(key: Key) -> None:
    place = tomllib.loads(REFERENCE.read_text(encoding="utf-8"))
    *tables, name = key.path.replace("[0]", "").split(".")
    for table in tables:
        place = place[table]
    if isinstance(place, list):
        assert name in place[0]
    else:
        assert msgspec.convert(place[name], key.field.type) == key.field.default


def test_the_reference_file_explains_each_table_in_a_comment() -> None:
    lines = REFERENCE.read_text(encoding="utf-8").splitlines()
    heads = [i for i, line in enumerate(lines) if line.startswith("[")]
    silent = [
        lines[head]
        for head, end in zip(heads, [*heads[1:], len(lines)], strict=True)
        if not any(line.startswith("#") for line in lines[head:end])
        and not lines[head].startswith("[[")
    ]
    assert silent == []


def test_the_effective_configuration_reads_back_as_the_same_configuration() -> None:
    config = accepted('[robot]\nid = "x"\n[control]\nrate = "auto"\n[commands]\nsources = []')
    assert from_builtins(effective(config)) == config
    assert from_builtins(msgspec.json.decode(msgspec.json.encode(effective(config)))) == config


def test_every_value_of_a_file_is_in_the_configuration() -> None:
    config = accepted(
        """
        [mcu]
        port = "/dev/ttyUSB0"
        baud_rate = 57600
        wheels.front_left = "-b"
        [control]
        rate = 50
        [[commands.sources]]
        name = "only"
        priority = 1
        timeout = 0.5
        [odometry]
        yaw_variance_per_metre = 1
        """
    )
    assert config.mcu.port == "/dev/ttyUSB0"
    assert config.mcu.baud_rate == 57600
    assert config.mcu.wheels.front_left == "-b"
    assert config.rate_hz == 50.0
    assert config.commands.sources == (Source("only", 1, 0.5),)
    assert config.odometry.yaw_variance_per_metre == 1.0
    assert config.drive == Config().drive


# the command line


def test_the_command_line_overrides_the_file() -> None:
    config = parse(b'[mcu]\nport = "/dev/a"\nbaud_rate = 9600\n[control]\nrate = 20', {
        "mcu": {"port": "/dev/b"}, "robot": {"id": "r2"},
    })  # fmt: skip
    assert config.mcu.port == "/dev/b"
    assert config.mcu.baud_rate == 9600
    assert config.robot.id == "r2"


def test_a_mistake_on_the_command_line_is_reported_like_one_in_the_file() -> None:
    (line,) = problems_of(b"", {"mcu": {"baud_rate": 1200}})
    assert line.startswith("mcu.baud_rate = 1200: expected one of 9600, 19200")


def test_the_command_line_does_not_hide_that_the_file_has_a_value_instead_of_a_table() -> None:
    (line,) = problems_of(b"mcu = 5", {"mcu": {"port": "/dev/b"}})
    assert line.startswith("mcu = 5: expected a table")


# planted mistakes

PLANTED = [
    # wrong kinds
    ("[robot]\nid = 7", "robot.id", "7", "1 to 32 characters of A-Z a-z 0-9 _ -"),
    ("[robot]\nid = 2020-01-01", "robot.id", "2020-01-01", 'the default is id = "acsar"'),
    ('[mcu]\nbaud_rate = "9600"', "mcu.baud_rate", '"9600"', "one of 9600, 19200"),
    ("[mcu]\nport = false", "mcu.port", "false", "a text of 1 to 256 characters"),
    ("[mcu]\ntrailing_comma = 1", "mcu.trailing_comma", "1", "true or false"),
    ('[drive]\nwheel_radius = "0.05"', "drive.wheel_radius", '"0.05"', "0.001 to 10 m"),
    ("[drive]\nwheel_radius = true", "drive.wheel_radius", "true", "0.001 to 10 m"),
    ("[lidar]\npublish_tf = 'yes'", "lidar.publish_tf", '"yes"', "true or false"),
    ('[bus]\nlisten = "tcp/127.0.0.1:1"', "bus.listen", '"tcp/127.0.0.1:1"', "expected a list"),
    ("[bus]\nconnect = [1]", "bus.connect", "[1]", "the default is connect = []"),
    ("robot = 5", "robot", "5", "write it as [robot]"),
    ("[[drive]]", "drive", "[{}]", "write it as [drive]"),
    ("[commands.sources]\nx = 1", "commands.sources", "{x = 1}", "[[commands.sources]]"),
    # out of range
    ('[robot]\nid = "a/b"', "robot.id", '"a/b"', "A-Z a-z 0-9 _ -"),
    ('[robot]\nid = ""', "robot.id", '""', "1 to 32"),
    ('[robot]\nid = "acsar\\n"', "robot.id", '"acsar\\n"', "1 to 32"),
    ('[odometry]\nodom_frame = "odom\\n"', "odometry.odom_frame", '"odom\\n"', "1 to 64"),
    ('[joints]\nrear_left = "x\\n"', "joints.rear_left", '"x\\n"', "1 to 64"),
    ('[mcu]\nport = ""', "mcu.port", '""', "1 to 256 characters"),
    ("[mcu]\nbaud_rate = 14400", "mcu.baud_rate", "14400", "115200"),
    ("[mcu]\nreply_period = -0.1", "mcu.reply_period", "-0.1", "from 0 to 0.25 s"),
    ('[mcu.wheels]\nrear_left = "c"', "mcu.wheels.rear_left", '"c"', '"+c"'),
    ("[control]\nrate = 0", "control.rate", "0", 'from 10 to 1000 Hz or one of "auto"'),
    ("[control]\nrate = 4", "control.rate", "4", "from 10"),
    *(
        (f'[control]\nstate_directory = "{one}"', "control.state_directory", f'"{one}"',
         "begins with / or ~/")
        for one in ("states", "./states", "~joe/states")
    ),
    ('[control]\nrate = "fast"', "control.rate", '"fast"', "the default is rate = 100.0"),
    ("[drive]\nwheel_radius = 0.0", "drive.wheel_radius", "0.0", "from 0.001 to 10 m"),
    ("[drive]\nwheel_separation = -0.3", "drive.wheel_separation", "-0.3", "from 0.001 to 10 m"),
    ("[limits]\nlinear_speed = 11", "limits.linear_speed", "11", "from 0 to 10 m/s"),
    ("[limits]\nwheel_speed = 100.0", "limits.wheel_speed", "100.0", "0.1 to 99.99 rad/s"),
    ("[limits]\nlinear_jerk = -1", "limits.linear_jerk", "-1", "(0 = no limit)"),
    ('[joints]\nrear_left = "/x"', "joints.rear_left", '"/x"', "no leading slash"),
    ("[lidar]\nlidar_yaw = 180", "lidar.lidar_yaw", "180", "from -6.2832 to 6.2832 rad"),
    ("[rates]\nodom = 2000", "rates.odom", "2000", "(0 = every sample)"),
    ('[log]\nlevel = "loud"', "log.level", '"loud"', '"debug"'),
    ("[sim]\nencoder_counts = 3200.5", "sim.encoder_counts", "3200.5", "a whole number from 16"),
    # sources
    (
        '[[commands.sources]]\nname = "x"',
        "commands.sources[0].priority",
        "",
        "missing; write priority = 50",
    ),
    (
        '[[commands.sources]]\nname = "x"\npriority = 1\n[[commands.sources]]\npriority = 1',
        "commands.sources[1].name",
        "",
        'missing; write name = "app"',
    ),
    (
        '[[commands.sources]]\nname = "x"\npriority = 1001',
        "commands.sources[0].priority",
        "1001",
        "from 0 to 1000",
    ),
    (
        '[[commands.sources]]\nname = "a/b"\npriority = 1',
        "commands.sources[0].name",
        '"a/b"',
        'for example "app"',
    ),
    (
        "[commands]\nsources = [1]",
        "commands.sources[0]",
        "1",
        "expected a table; write it as [[commands.sources]]",
    ),
    # misspelt
    ('[robto]\nid = "x"', "robto", '{id = "x"}', "did you mean robot?"),
    ("[mcu]\nbaudrate = 9600", "mcu.baudrate", "9600", "did you mean baud_rate?"),
    ("[drive]\nwheel_seperation = 1", "drive.wheel_seperation", "1", "mean wheel_separation?"),
    ('[mcu.wheels]\nfront_rigth = "+a"', "mcu.wheels.front_rigth", '"+a"', "front_right?"),
    ("[limits]\nlinear_accel = 1", "limits.linear_accel", "1", "linear_acceleration?"),
    ("[odometry]\npublish_tff = true", "odometry.publish_tff", "true", "did you mean publish_tf?"),
    ("colour = 3", "colour", "3", "known here: robot, mcu, control, drive"),
    (
        '[[commands.sources]]\nname = "x"\npriority = 1\ntimeuot = 1',
        "commands.sources[0].timeuot",
        "1",
        "did you mean timeout?",
    ),
    # contradictory keys
    ("[mcu]\nbaud_rate = 9600", "control.rate", "100", "mcu.baud_rate = 38400 or more"),
    ('[mcu.wheels]\nfront_right = "-b"', "mcu.wheels.front_left", '"b"', "write another"),
    ('[joints]\nfront_left = "x"\nrear_left = "x"', "joints.rear_left", '"x"', "write another"),
    ('[odometry]\nbase_frame = "odom"', "odometry.base_frame", '"odom"', "already has this frame"),
    ('[lidar]\nlidar_frame = "base_link"', "lidar.lidar_frame", '"base_link"', "has this frame"),
    (
        "[limits]\nlinear_stop_deceleration = 0.5",
        "limits.linear_stop_deceleration",
        "0.5",
        "write 1 or more",
    ),
    (
        "[limits]\nangular_deceleration = 20",
        "limits.angular_stop_deceleration",
        "12",
        "write 20 or more",
    ),
    (
        '[control]\nrate = 10\n[[commands.sources]]\nname = "x"\npriority = 1\ntimeout = 0.15',
        "commands.sources[0].timeout",
        "0.15",
        "write 0.2 or more",
    ),
    (
        '[[commands.sources]]\nname = "x"\npriority = 1\n'
        '[[commands.sources]]\nname = "x"\npriority = 2',
        "commands.sources[1].name",
        '"x"',
        "write another",
    ),
    # robots that would not stop in time, or would fault in normal driving
    (
        "[limits]\nlinear_deceleration = 0.19",
        "limits.linear_deceleration",
        "0.19",
        "at most 5 s are allowed; either write 0.2 or more",
    ),
    (
        "[limits]\nangular_deceleration = 0.1",
        "limits.angular_deceleration",
        "0.1",
        "at most 5 s are allowed; either write 0.8 or more",
    ),
    (
        "[limits]\nangular_deceleration = 1\nangular_stop_deceleration = 1.5",
        "limits.angular_stop_deceleration",
        "1.5",
        "at most 2 s are allowed; either write 2 or more",
    ),
    ("[feedback]\nwheel_speed = 30", "feedback.wheel_speed", "30", "write 35.2 or more"),
    ("[mcu]\nreply_period = 0.26", "mcu.reply_period", "0.26", "from 0 to 0.25 s"),
    (
        "[mcu]\nreply_period = 0.15\n[feedback]\nfault_time = 0.2",
        "mcu.reply_period",
        "0.15",
        "write 0.1 or less and make the firmware report more often; "
        "or write feedback.fault_time = 0.3",
    ),
    ("[bus]\nlisten = []", "bus.listen", "[]", 'write bus.listen = ["tcp/127.0.0.1:7448"]'),
    ('[bus]\nlisten = ["7448"]', "bus.listen", '"7448"', 'like "tcp/127.0.0.1:7448"'),
    ('[bus]\nconnect = ["tcp/10.0.0.2:1"]', "bus.connect", '"tcp/10.0.0.2:1"', "insecure = true"),
    (
        '[bus]\nlisten = ["tcp/127.0.0.1:1", "tcp/[::1]:1", "tcp/127.0.0.1:1"]',
        "bus.listen[2]",
        '"tcp/127.0.0.1:1"',
        "bus.listen[0] already has this host and port; write another",
    ),
    # lists that are too long, and entries that look right
    ("[web]\naddress = []", "web.address", "[]", "a list of 1 to 8 entries, each http(s)://"),
    ("[web]\norigins = 5", "web.origins", "5", "a list of at most 16 entries, each http(s)://"),
    ("[safety]\nbumpers = [1]", "safety.bumpers", "[1]", "a list of at most 4 entries, each one"),
    ('[access]\nviewers = ["@x"]', "access.viewers", '["@x"]', "and no @ at the start"),
    # addresses at which the page would not start
    (
        '[web]\naddress = ["http://0.0.0.0:8080"]',
        "web.address",
        '"http://0.0.0.0:8080"',
        "http is only for this machine; write 127.0.0.1, or https://",
    ),
    (
        '[web]\naddress = ["http://192.168.0.1:80"]',
        "web.address",
        '"http://192.168.0.1:80"',
        "http is only for this machine; write 127.0.0.1, or https://",
    ),
    (
        '[web]\naddress = ["https://0.0.0.0:8443"]',
        "web.address",
        '"https://0.0.0.0:8443"',
        "needs a certificate; `acsard tls init` makes it",
    ),
    (
        '[web]\naddress = ["http://127.0.0.1:0"]',
        "web.address",
        '"http://127.0.0.1:0"',
        "a port is a number from 1 to 65535",
    ),
    (
        '[web]\naddress = ["http://[::1]:1", "http://[::1]:2", "http://[::1]:2"]',
        "web.address[2]",
        '"http://[::1]:2"',
        "web.address[1] already has this host and port; write another",
    ),
    (
        '[bus]\nlisten = ["tcp/[::1]:1", "tcp/10.0.0.1:2", "tcp/localhost:3"]',
        "bus.listen",
        '"tcp/10.0.0.1:2"',
        "this endpoint is on the network",
    ),
]  # fmt: skip


@each(("text", "key", "value", "mend"), PLANTED)
def test_a_mistake_gives_exactly_one_line_with_key_value_and_remedy(
    text: str, key: str, value: str, mend: str
) -> None:
    (line,) = problems_of(text)
    assert line.startswith(f"{key} = {value}: " if value else f"{key}: ")
    assert mend in line
    assert "\n" not in line


def test_each_of_many_mistakes_gives_one_line() -> None:
    messages = problems_of(
        """
        colour = 1
        [robot]
        id = ""
        [mcu]
        baudrate = 9600
        port = 1
        [drive]
        wheel_radius = inf
        wheel_separation = 0
        [[commands.sources]]
        name = "x"
        [bus]
        insecure = 1
        """
    )
    starts = ["colour", "robot.id", "mcu.baudrate", "mcu.port", "drive.wheel_radius"]
    starts += ["drive.wheel_separation", "commands.sources[0].priority", "bus.insecure"]
    assert len(messages) == len(starts)
    assert all(sum(line.startswith(start) for line in messages) == 1 for start in starts)


def test_all_contradictions_are_reported_together() -> None:
    messages = problems_of(
        """
        [mcu]
        baud_rate = 9600
        [mcu.wheels]
        front_left = "+a"
        [limits]
        linear_stop_deceleration = 0.5
        angular_stop_deceleration = 0.5
        [bus]
        listen = ["nonsense", "tcp/0.0.0.0:7448"]
        """
    )
    assert len(messages) == 6


def test_broken_rules_between_keys_are_reported_with_the_mistakes_of_other_keys() -> None:
    messages = problems_of(
        """
        colour = 1
        [drive]
        wheel_radius = "big"
        [mcu]
        baud_rate = 9600
        [control]
        rate = 100.0
        [mcu.wheels]
        front_left = "+a"
        front_right = "+z"
        [joints]
        front_left = "wheel"
        rear_left = "wheel"
        [limits]
        linear_jerk = 0.001
        angular_jerk = "soft"
        [bus]
        mode = "peer"
        listen = ["tcp/0.0.0.0:7448"]
        """
    )
    starts = ["colour", "drive.wheel_radius", "control.rate", "mcu.wheels.front_right"]
    starts += ["joints.rear_left", "limits.linear_jerk", "limits.angular_jerk", "bus.listen"]
    assert [next(s for s in starts if line.startswith(s)) for line in messages]
    assert sorted(line.split(" = ")[0] for line in messages) == sorted(starts)


def test_a_rule_is_not_applied_to_a_key_with_an_unknown_value() -> None:
    """The rules must not complain about keys whose values are unknown.

    Here the baud rate is invalid, so no rule may compare it with the rate. `insecure` is misspelt,
    so no rule may complain about the endpoints.
    """
    text = """
        [mcu]
        baudrate = 9600
        [control]
        rate = 400.0
        [bus]
        insecur = true
        listen = ["tcp/0.0.0.0:7448"]
        """
    assert [line.split(" = ")[0] for line in problems_of(text)] == ["mcu.baudrate", "bus.insecur"]


def test_an_invalid_router_does_not_hide_a_problem_of_the_endpoints_to_listen_at() -> None:
    text = """
        [bus]
        connect = 5
        listen = ["tcp/0.0.0.0:7448", "nowhere"]
        """
    names = [line.partition(":")[0] for line in problems_of(text)]
    assert names[0].startswith("bus.connect = 5")
    assert names[1:] == ['bus.listen = "tcp/0.0.0.0', 'bus.listen = "nowhere"']


def test_the_error_message_lists_all_problems() -> None:
    with pytest.raises(ConfigError) as caught:
        parse(b"a = 1\nb = 2")
    assert str(caught.value) == "\n".join(caught.value.problems)


# numbers


@pytest.mark.slow
@each("text", ["inf", "-inf", "nan"])
@each("key", FLOATS)
def test_a_number_that_is_not_finite_is_refused_at_every_key(key: Key, text: str) -> None:
    items = len(key.field.default) if isinstance(key.field.default, tuple) else 0
    for place in range(max(1, items)):
        value = (
            f"[{', '.join(text if i == place else '1' for i in range(items))}]" if items else text
        )
        (line,) = problems_of(key.document(value))
        assert line.startswith(f"{key.path} = {value}: expected a ")


# text that is not a configuration


@each(
    "text",
    ["[mcu", "mcu", "[mcu]\nport = /dev/ttyUSB0", "a = 1\na = 2", "[a]\n[a]", "a = 1 = 2", "\x00",
     "a = True", 'a = "\\q"', "a = 2020-13-01", '"', "a.b = 1\na = 2", "[[a]]\n[a]\n[a]"],
)  # fmt: skip
def test_text_that_is_not_toml_gives_one_line_with_the_position(text: str) -> None:
    (line,) = problems_of(text)
    assert line.startswith("not TOML: ")
    assert "line" in line or "end of document" in line
    assert "\n" not in line


@each("text", [b"\xff", "[robot]".encode("utf-16"), b'id = "\xe9"', b"\x80" * 99])
def test_bytes_that_are_not_utf8_give_one_line(text: bytes) -> None:
    (line,) = problems_of(text)
    assert line.startswith("not UTF-8 text: ")
    assert line.endswith("; save the file as UTF-8")
    assert "\n" not in line


# the wire (MCU.md section 2)


def wire(baud: int, rate: object, comma: bool = False) -> str:
    flag = str(comma).lower()
    return f"[mcu]\nbaud_rate = {baud}\ntrailing_comma = {flag}\n[control]\nrate = {rate}\n"


@each(
    ("baud", "rate", "comma"),
    [(9600, 23, False), (9600, 22, True), (19200, 46, False), (38400, 93, False),
     (57600, 139, False), (115200, 279, False), (115200, 271, True)],
)  # fmt: skip
def test_a_rate_up_to_80_percent_of_the_wire_passes_without_a_warning(
    baud: int, rate: int, comma: bool
) -> None:
    assert warnings(accepted(wire(baud, rate, comma))) == []


@each(
    ("baud", "rate", "comma", "comfortable"),
    [(9600, 24, False, 23), (9600, 29, False, 23), (9600, 23, True, 22), (38400, 94, False, 93),
     (38400, 116, False, 93), (115200, 280, False, 279), (115200, 349, False, 279)],
)  # fmt: skip
def test_a_rate_between_80_and_100_percent_of_the_wire_passes_with_a_warning(
    baud: int, rate: int, comma: bool, comfortable: int
) -> None:
    (text,) = warnings(accepted(wire(baud, rate, comma)))
    assert text.startswith(f"control.rate = {rate} takes ")
    assert f"write {comfortable} or less" in text


@each(
    ("baud", "rate", "comma", "numbers", "faster"),
    [
        (9600, 30, False, ("33 B at 9600 baud takes 34.4 ms", 29, 23), 19200),
        (9600, 100, False, ("33 B at 9600 baud takes 34.4 ms", 29, 23), 38400),
        (9600, 29, True, ("34 B at 9600 baud takes 35.4 ms", 28, 22), 19200),
        (19200, 59, False, ("33 B at 19200 baud takes 17.2 ms", 58, 46), 38400),
        (38400, 117, False, ("33 B at 38400 baud takes 8.6 ms", 116, 93), 57600),
        (57600, 175, False, ("33 B at 57600 baud takes 5.7 ms", 174, 139), 115200),
        (115200, 350, False, ("33 B at 115200 baud takes 2.9 ms", 349, 279), None),
    ],
)  # fmt: skip
def test_a_rate_above_the_wire_capacity_is_refused_with_the_numbers_and_both_remedies(
    baud: int, rate: int, comma: bool, numbers: tuple[str, int, int], faster: int | None
) -> None:
    (line,) = problems_of(wire(baud, rate, comma))
    takes, most, slower = numbers
    assert line.startswith(
        f"control.rate = {rate}: a line of {takes}, so at most {most} Hz is possible, and "
        f"{slower} Hz uses 80 % of the wire; write "
    )
    assert ("mcu.baud_rate" in line) == (faster is not None)
    if faster is not None:
        assert f"write mcu.baud_rate = {faster} or more" in line
        accepted(wire(faster, rate, comma))
    assert f'control.rate = {slower} or "auto"' in line
    accepted(wire(baud, slower, comma))
    accepted(wire(baud, '"auto"', comma))


@each("baud", [9600, 19200, 38400, 57600, 115200])
@each("comma", [False, True])
def test_an_automatic_rate_never_causes_a_warning(baud: int, comma: bool) -> None:
    config = accepted(wire(baud, '"auto"', comma))
    assert warnings(config) == []
    assert config.rate_hz * (34 if comma else 33) * 10 <= 0.8 * baud


# clients that can reach the bus (SAFETY section 3)


@each("key", ["listen", "connect"])
@each("host", ["127.0.0.1", "127.8.9.1", "[::1]", "localhost"])
def test_an_endpoint_may_name_this_machine(key: str, host: str) -> None:
    config = accepted(f'[bus]\n{key} = ["tcp/{host}:7448"]')
    assert getattr(config.bus, key) == (f"tcp/{host}:7448",)


@each("key", ["listen", "connect"])
@each(
    "host", ["0.0.0.0", "[::]", "192.168.1.2", "[fe80::1]", "robot.local", "*", "128.0.0.1",
             "localhost.evil.org", "127.0.0.1.evil.org", "1"],
)  # fmt: skip
def test_an_endpoint_on_the_network_is_refused_unless_insecure_is_set(key: str, host: str) -> None:
    text = f'[bus]\n{key} = ["tcp/{host}:7448"]\n'
    (line,) = problems_of(text)
    assert line.startswith(f'bus.{key} = "tcp/{host}:7448": this endpoint is on the network')
    assert line.endswith("bus.insecure = true")
    config = accepted(text + "insecure = true")
    assert any("every program that reaches the bus can drive" in text for text in warnings(config))


@each(
    "endpoint",
    ["", "tcp", "tcp/", "tcp/127.0.0.1", "tcp/127.0.0.1:", "tcp/:7448", "tcp/127.0.0.1:65536",
     "tcp/127.0.0.1:-1", "tcp/127.0.0.1:x", "udp/127.0.0.1:7448", "127.0.0.1:7448",
     "tcp/127.0.0.1:7448#iface=eth0", "tcp/127.0.0.1:٧", " tcp/127.0.0.1:7448"],
)  # fmt: skip
def test_an_invalid_endpoint_is_refused_even_when_insecure(endpoint: str) -> None:
    (line,) = problems_of(f'[bus]\nlisten = ["{endpoint}"]\ninsecure = true')
    assert line.startswith("bus.listen = ")
    assert "tcp/127.0.0.1:7448" in line


# contradictions at their limits


@each(
    "text",
    [
        # A stop brakes exactly as hard as a timeout; a timeout is exactly two control periods.
        "[limits]\nlinear_stop_deceleration = 1.0\nangular_stop_deceleration = 4.0",
        '[control]\nrate = 10\n[[commands.sources]]\nname = "x"\npriority = 1\ntimeout = 0.2',
        '[mcu.wheels]\nfront_right = "-d"\nfront_left = "+c"\nrear_left = "-b"\nrear_right = "+a"',
        '[control]\nstate_directory = ""',
        '[control]\nstate_directory = "/states"',
        '[control]\nstate_directory = "~/states"',
    ],
)
def test_a_value_at_a_limit_passes(text: str) -> None:
    accepted(text)


def test_a_frame_that_is_not_published_may_have_any_name() -> None:
    text = '[lidar]\nlidar_frame = "base_link"\npublish_tf = '
    accepted(text + "false")
    (line,) = problems_of(text + "true")
    assert line.startswith('lidar.lidar_frame = "base_link"')
    assert "odometry.base_frame already has this frame" in line


def test_a_speed_the_wheels_cannot_reach_is_a_warning() -> None:
    (text,) = warnings(accepted("[limits]\nlinear_speed = 3.0"))
    assert text.startswith("limits.linear_speed = 3 m/s needs wheels at 60.0 rad/s")
    assert "limits.wheel_speed = 40" in text


# random input

NAMES = sorted({key.path.rpartition(".")[2] for key in KEYS} | {"id_", "x", "prot"})
TABLES = sorted({key.path.rpartition(".")[0] for key in KEYS} - {"commands.sources[0]"})
VALUES = st.one_of(
    st.integers().map(str),
    st.floats().map(str),
    st.sampled_from(
        ["true", "false", '"sim"', '"auto"', '"+a"', '"-d"', "[]", "{}", "{a = 1}", "[{}]", "''",
         "1979-05-27", "07:32:00", "1979-05-27T07:32:00Z", "0x10", "1_000", "[1, [2, 'x']]", "-0.0",
         '["tcp/127.0.0.1:7448"]', "[1, 1, 1, 1, 1, 1]", '"\\u0000"', '"""a\nb"""', "9600"],
    ),
)  # fmt: skip
DOTTED = [key.path for key in KEYS if key.table is not Source]
LINES = st.one_of(
    st.builds("{} = {}".format, st.sampled_from(DOTTED), VALUES),
    st.builds("{} = {}".format, st.sampled_from(NAMES), VALUES),
    st.sampled_from(
        [f"[{table}]" for table in TABLES] + ["[[commands.sources]]", "# x", "[[mcu]]"]
    ),
)


def outcome(data: bytes) -> Config | list[str]:
    """Return the configuration or its problems. Any other error from `parse` fails the test."""
    try:
        return parse(data)
    except ConfigError as error:
        return error.problems


def is_config_or_lines(result: Config | list[str]) -> bool:
    if isinstance(result, Config):
        return from_builtins(effective(result)) == result
    return bool(result) and not any("\n" in line for line in result)


@pytest.mark.slow
@given(st.lists(LINES, max_size=12).map("\n".join))
@settings(max_examples=400)
def test_any_toml_like_text_gives_a_configuration_or_a_list_of_problems(text: str) -> None:
    assert is_config_or_lines(outcome(text.encode()))


@pytest.mark.slow
@given(st.binary(max_size=60) | st.text(max_size=60).map(lambda text: text.encode("utf-8")))
@settings(max_examples=300)
@example(b"\xef\xbb\xbf[robot]")
def test_any_bytes_give_a_configuration_or_a_list_of_problems(data: bytes) -> None:
    assert is_config_or_lines(outcome(data))


@pytest.mark.slow
@given(data=st.data())
@settings(max_examples=150)
def test_a_damaged_reference_file_gives_a_configuration_or_a_list_of_problems(
    data: st.DataObject,
) -> None:
    good = REFERENCE.read_bytes()
    start = data.draw(st.integers(0, len(good)))
    end = data.draw(st.integers(start, min(len(good), start + 30)))
    damaged = good[:start] + data.draw(st.binary(max_size=8)) + good[end:]
    assert is_config_or_lines(outcome(damaged))


@each(
    "text",
    [
        '"a\\nb" = 1',
        '[robot]\n"a\\nb" = 1',
        '"\\u001b[2J" = 1',
    ],
)
def test_a_key_with_control_characters_is_reported_in_one_printable_line(text: str) -> None:
    (line,) = problems_of(text)
    assert line.isprintable()


@each(
    "text",
    [
        b"a = 1" + b"0" * 5000,
        b"[drive]\nwheel_radius = 0x1" + b"0" * 5000,
        b"a = 0x1" + b"0" * 5000,
        b"a = " + b"[" * 5000,
        b"a = " + b"[" * 600 + b"]" * 600,
        b"a" + b".a" * 3000 + b" = 1",
    ],
)
def test_a_very_long_number_or_very_deep_nesting_gives_one_problem(text: bytes) -> None:
    assert len(problems_of(text)) == 1


# names of certificates


@each("name", ["anna", "laptop anna", "a_b.c:d@e+f-g", "J\u00fcrgen", "x" * 64])
def test_a_certificate_may_have_any_name_that_fits_into_a_key(name: str) -> None:
    assert accepted(f'[access]\noperators = ["{name}"]').access.operators == (name,)


@each("name", ["", "a/b", "a*", "a$b", "a#b", "a?b", "@a", "a[b]", "two\\nlines", "x" * 65])
def test_a_certificate_name_that_fits_into_no_key_is_refused_with_the_valid_characters(
    name: str,
) -> None:
    (problem,) = problems_of(f'[access]\noperators = ["{name}"]')
    assert problem.startswith("access.operators = ")
    assert "letters, digits" in problem

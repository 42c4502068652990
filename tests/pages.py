"""What the pages say to type, and what runs each of it: a command that is not here fails a test."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]

PAGES = tuple(
    str(path.relative_to(ROOT))
    for pattern in ("README.md", "acsard/README.md", "tests/README.md", "deploy/*/README.md")
    for path in sorted(ROOT.glob(pattern))
)

_FENCED = re.compile(r"^```([a-z0-9]*)\n(.*?)^```$", re.M | re.S)

LANGUAGES = {"", "console", "json5", "python", "sh", "toml", "yaml"}


class Block(NamedTuple):
    """A fenced block and where it is."""

    page: str
    line: int
    language: str
    text: str

    @property
    def where(self) -> str:
        return f"{self.page}:{self.line}"

    def commands(self) -> list[str]:
        """What it says to type, without comments and what is printed."""
        lines = self.text.splitlines()
        if self.language == "console":
            lines = [line.removeprefix("$ ") for line in lines if line.startswith("$ ")]
        elif self.language != "sh":
            return []
        bare = [re.sub(r"(^|\s)#.*", "", line).strip() for line in lines]
        return [re.sub(r"\s+", " ", line) for line in bare if line]


def text_of(page: str) -> str:
    return (ROOT / page).read_text(encoding="utf-8")


def blocks(*languages: str) -> list[Block]:
    """The fenced blocks of all pages, of these languages or of any."""
    return list(_blocks(languages))


def _blocks(languages: tuple[str, ...]) -> Iterator[Block]:
    for page in PAGES:
        text = text_of(page)
        for match in _FENCED.finditer(text):
            if match[1] in languages or not languages:
                line = text.count("\n", 0, match.start()) + 1
                yield Block(page, line, match[1], match[2])


def prose(page: str) -> str:
    """A page without its fenced blocks."""
    return _FENCED.sub("", text_of(page))


# what runs each command


class Run(NamedTuple):
    """tests/system/test_pages.py types it beside a daemon on the simulator; what it then says."""

    says: str = ""
    """A pattern in its output."""
    codes: tuple[int, ...] = (0,)


class Elsewhere(NamedTuple):
    """That file runs it, with other addresses and places; the words there that show it."""

    file: str
    words: str


class Collected(NamedTuple):
    """A call of pytest: tests/system/test_pages.py asks it whether it finds tests."""


class Shown(NamedTuple):
    """Nothing runs it; why."""

    why: str


How = Run | Elsewhere | Collected | Shown

HERE = "tests/system/test_pages.py"
CLI, FLEET, MCU = (f"tests/system/test_{name}.py" for name in ("cli", "fleet", "mcu"))
CALIBRATE = "tests/unit/cli/test_calibrate.py"
SERVICE, CONTAINER = "tests/systemd/test_service.py", "tests/systemd/container.py"
ROS_FILES, BRIDGE = "tests/test_deploy_ros2.py", "tests/system/test_ros_bridge.py"

NO_ROS = Shown("needs ROS 2; the page says that it was not tried")
TWO_MACHINES = Shown("needs a second machine")
BY_ROOT = Shown("makes places for a user of the system that only zenohd's package has")
PYTEST = Collected()

_BRIDGE_FILE = "deploy/ros2/zenoh-bridge-ros2dds.json5"
_LAUNCH_FILE = "deploy/ros2/acsar.launch.py"
_ROUTER = "--id robot1 --connect tls/router.local:7447 --tls"
_RMW_ROUTER = """ZENOH_CONFIG_OVERRIDE='listen/endpoints=["tcp/127.0.0.1:7447"]'"""

COMMANDS: dict[str, How] = {
    # README.md
    "python3 -m venv .venv && .venv/bin/pip install . && .venv/bin/acsard run": Elsewhere(
        HERE, "def test_the_first_command_of_the_readme"
    ),
    "python3 -m venv .venv && .venv/bin/pip install -e '.[test]' && .venv/bin/pytest": Elsewhere(
        ".ci/run", "-e '.[test]'"
    ),
    ". .venv/bin/activate": Run(),
    "acsard drive": Elsewhere(CLI, '"drive", "--config"'),
    "acsard echo odom -n 1": Run('"child_frame_id":"base_link"'),
    "acsard echo state -n 1": Run('"mode":"[a-z]+","reason":'),
    "acsard hz odom -n 1": Run(" Hz "),
    "acsard top": Run("pose and twist"),
    "acsard call stop": Run("^stopped and latched; srv/clear releases it$"),
    "acsard call clear": Run("^cleared; each source must be neutral once before it drives$"),
    "acsard ports": Run(codes=(0, 1)),
    "acsard mcu check --port DEVICE": Elsewhere(MCU, '"mcu", "check", "--port", port'),
    "acsard run --port DEVICE": Elsewhere("tests/system/test_start.py", '"run", "--port", device'),
    "acsard doctor": Run("daemon", codes=(0, 1)),
    # acsard/README.md
    ".venv/bin/python -m pydoc acsard": Run("Where to look"),
    ".venv/bin/ruff check .": Elsewhere(".ci/run", ".venv/bin/ruff check ."),
    ".venv/bin/ruff format --check .": Elsewhere(".ci/run", ".venv/bin/ruff format --check ."),
    ".venv/bin/mypy": Elsewhere(".ci/run", ".venv/bin/mypy"),
    ".venv/bin/lint-imports": Elsewhere("tests/test_shape.py", "lint-imports"),
    ".venv/bin/pytest tests/unit tests/scenarios": PYTEST,
    # tests/README.md
    ".venv/bin/pytest": PYTEST,
    ".venv/bin/pytest -m '(slow or network or systemd or firmware) and not soak'": PYTEST,
    ".venv/bin/pytest -m soak -s": PYTEST,
    "bash .ci/run": Shown("it is what runs everything here"),
    ".venv/bin/python -m tests.mutation": Shown("takes hours, for who changes the core"),
    "acsard bench": Elsewhere("tests/system/test_bench.py", 'acsard("bench"'),
    # deploy/firmware
    "sudo apt install make gcc-avr avr-libc binutils-avr avrdude": Elsewhere(".ci/run", "gcc-avr"),
    "make": Elsewhere("tests/firmware/board.py", '"make"'),
    "make flash PORT=/dev/ttyACM0": Elsewhere(HERE, '"make", "-n", "flash"'),
    "sudo systemctl stop acsard": Elsewhere(CONTAINER, '"systemctl", "stop", DOOR, UNIT'),
    "acsard mcu check --port sim --yes": Run("PASS +watchdog"),
    "acsard sim --link ./mcu --fault comma_latched --fault reversed_motor=b": Elsewhere(
        HERE, "def test_the_broken_board"
    ),
    "acsard mcu check --port ./mcu --yes": Elsewhere(HERE, "def test_the_broken_board"),
    "acsard calibrate --log drive.csv": Elsewhere(CALIBRATE, '"calibrate", "--log"'),
    "acsard calibrate --log drive.csv --distance straight=4.03 --write": Elsewhere(
        CALIBRATE, '"--distance", "straight='
    ),
    "sudo apt install gcc libsimavr-dev libelf-dev": Elsewhere(".ci/run", "libsimavr-dev"),
    ".venv/bin/pytest tests/firmware": PYTEST,
    '.venv/bin/pytest -s -m "firmware and not soak" tests/firmware': PYTEST,
    # deploy/ros2
    "source /opt/ros/jazzy/setup.bash": NO_ROS,
    "export RMW_IMPLEMENTATION=rmw_cyclonedds_cpp": Run(),
    "export RMW_IMPLEMENTATION=rmw_zenoh_cpp": Run(),
    "export ROS_DOMAIN_ID=0": Run(),
    "export ZENOH_ROUTER_CHECK_ATTEMPTS=10": Run(),
    """export ZENOH_CONFIG_OVERRIDE='mode="client";connect/endpoints=["tcp/127.0.0.1:7447"]'""": (
        Run()
    ),
    f"zenoh-bridge-ros2dds -c {_BRIDGE_FILE}": Elsewhere(BRIDGE, '"zenoh-bridge-ros2dds"'),
    f"{_RMW_ROUTER} ros2 run rmw_zenoh_cpp rmw_zenohd": NO_ROS,
    "ssh -N -L 7448:127.0.0.1:7448 USER@ROBOT": TWO_MACHINES,
    "ssh -N -R 7447:127.0.0.1:7447 USER@ROBOT": TWO_MACHINES,
    "ssh -N -L 7447:127.0.0.1:7447 USER@ROBOT": TWO_MACHINES,
    "ros2 daemon stop": NO_ROS,
    "ros2 topic list": NO_ROS,
    "ros2 topic hz /odom": NO_ROS,
    "ros2 topic echo --once /odom nav_msgs/msg/Odometry": NO_ROS,
    "ros2 run tf2_ros tf2_echo odom base_link": NO_ROS,
    "ros2 service call /acsard/stop std_srvs/srv/Trigger": NO_ROS,
    "ros2 service call /acsard/clear std_srvs/srv/Trigger": NO_ROS,
    "ros2 param list /acsard": NO_ROS,
    "ros2 param get /acsard drive.wheel_radius": NO_ROS,
    "ros2 run teleop_twist_keyboard teleop_twist_keyboard --ros-args "
    "-r cmd_vel:=cmd_vel_teleop": NO_ROS,
    f"ros2 launch {_LAUNCH_FILE} use_rviz:=true": Elsewhere(ROS_FILES, "generate_launch"),
    f"ros2 launch {_LAUNCH_FILE} use_ros2_control:=true": Elsewhere(ROS_FILES, "generate_launch"),
    "sudo apt install ros-$ROS_DISTRO-ros2-controllers "
    "ros-$ROS_DISTRO-joint-state-topic-hardware-interface": NO_ROS,
    # deploy/systemd
    "sudo python3 -m venv /opt/acsard/venv": Elsewhere(HERE, "def test_the_service_s_venv"),
    "sudo /opt/acsard/venv/bin/pip install -r deploy/systemd/requirements.lock": Elsewhere(
        HERE, "def test_the_service_s_venv"
    ),
    "sudo /opt/acsard/venv/bin/pip install --no-deps .": Elsewhere(
        HERE, "def test_the_service_s_venv"
    ),
    "sudo /opt/acsard/venv/bin/acsard service install": Elsewhere(SERVICE, '"service", "install")'),
    "sudo systemctl restart acsard": Elsewhere(SERVICE, '"systemctl", "restart", UNIT'),
    "sudo /opt/acsard/venv/bin/acsard doctor --config /etc/acsard/acsard.toml": Elsewhere(
        "tests/system/test_doctor.py", '"doctor", "--config"'
    ),
    'sudo sh -c "/opt/acsard/venv/bin/pip install -r deploy/systemd/requirements.lock && '
    "/opt/acsard/venv/bin/pip install --no-deps . && /opt/acsard/venv/bin/acsard service install "
    '--force && systemctl restart acsard"': Elsewhere(SERVICE, '"service", "install", "--force"'),
    "systemctl status acsard": Elsewhere(SERVICE, 'show("StatusText")'),
    "journalctl -u acsard ACSARD_EVENT=link_down": Elsewhere(CONTAINER, '"journalctl"'),
    "/opt/acsard/venv/bin/acsard service status": Elsewhere(SERVICE, '"service", "status"'),
    "sudo /opt/acsard/venv/bin/acsard lan init --write /etc/acsard/acsard.toml": Elsewhere(
        SERVICE, '"lan", "init", "--write"'
    ),
    'sudo sh -c "systemctl daemon-reload && systemctl restart acsard"': Elsewhere(
        SERVICE, '"systemctl", "daemon-reload"'
    ),
    "acsard echo state --connect tls/robot.local:7449 --tls clients/viewer": Elsewhere(
        SERVICE, '"--connect", "tls/127.0.0.1:7449", "--tls"'
    ),
    # deploy/zenoh
    "pip install 'acsard[lan]'": Elsewhere(HERE, "def test_the_service_s_venv"),
    "acsard lan init --directory fleet": Run("^Wrote "),
    "acsard lan add router.local --address 192.168.1.10 --directory fleet": Run("router.local"),
    "acsard lan add robot1 --directory fleet": Run("robot1"),
    "acsard lan add robot2 --directory fleet": Run("robot2"),
    "acsard lan add laptop-anna --role operator --directory fleet": Run("operators = "),
    "sudo install -d -o zenohd -m 0700 /etc/zenohd/tls": BY_ROOT,
    "sudo install -o zenohd -m 0400 ca.pem certificate.pem key.pem /etc/zenohd/tls/": BY_ROOT,
    "sudo install -m 0644 router.json5 /etc/zenohd/": BY_ROOT,
    "zenohd -c /etc/zenohd/router.json5": Elsewhere(FLEET, "ROUTER_FILE"),
    "acsard check": Run("effective configuration"),
    f"acsard echo state -n 1 {_ROUTER} laptop-anna": Elsewhere(HERE, "def test_the_laptop"),
    f"acsard drive {_ROUTER} laptop-anna": Elsewhere(CLI, '"drive", "--config"'),
    f"acsard call stop {_ROUTER} laptop-anna": Elsewhere(HERE, "def test_the_laptop"),
    f"acsard echo state -n 1 {_ROUTER} fleet/clients/viewer": Elsewhere(
        HERE, "def test_the_laptop"
    ),
    f"acsard call clear {_ROUTER} fleet/clients/viewer": Elsewhere(HERE, "def test_the_laptop"),
    f"acsard call clear {_ROUTER} fleet/clients/operator": Elsewhere(HERE, "def test_the_laptop"),
    f"acsard call stop {_ROUTER} fleet/clients/viewer": Elsewhere(HERE, "def test_the_laptop"),
}


def promises() -> list[list[str]]:
    """What pytest is given for each row of the promises, and in each call of it in a block."""
    spans = []
    for row in re.findall(r"^\| .* \|$", text_of("tests/README.md"), re.M):
        cell = row.rstrip(" |").rpartition(" | ")[2]
        spans += [span for span in re.findall(r"`([^`]+)`", cell) if "tests/" in span]
    spans += [c.removeprefix(".venv/bin/pytest") for c, how in COMMANDS.items() if how == PYTEST]
    return [shlex.split(span) for span in spans]

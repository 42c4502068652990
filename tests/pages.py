"""Lists every command that the documentation asks the reader to type, with the test that runs it.

A test fails if a command of the documentation is missing in this list.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from glob import glob
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]

PAGES = tuple(
    str(path.relative_to(ROOT))
    for pattern in (
        "README.md",
        "acsard/README.md",
        "tests/README.md",
        "deploy/README.md",
        "deploy/*/README.md",
    )
    for path in sorted(ROOT.glob(pattern))
)

_FENCED = re.compile(r"^```([a-z0-9]*)\n(.*?)^```$", re.M | re.S)

LANGUAGES = {"", "console", "html", "js", "json5", "python", "sh", "toml", "yaml"}


class Block(NamedTuple):
    """A fenced block and its place on a page."""

    page: str
    line: int
    language: str
    text: str

    @property
    def where(self) -> str:
        return f"{self.page}:{self.line}"

    def commands(self) -> list[str]:
        """Return the commands of the block, without comments and without printed output."""
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
    """Return the fenced code blocks of all pages.

    `languages` selects blocks by their language; without it all blocks are returned.
    """
    return list(_blocks(languages))


def _blocks(languages: tuple[str, ...]) -> Iterator[Block]:
    for page in PAGES:
        text = text_of(page)
        for match in _FENCED.finditer(text):
            if match[1] in languages or not languages:
                line = text.count("\n", 0, match.start()) + 1
                yield Block(page, line, match[1], match[2])


def prose(page: str) -> str:
    """Return a page without its fenced blocks."""
    return _FENCED.sub("", text_of(page))


# the check that runs each command


class Run(NamedTuple):
    """A command that tests/system/test_pages.py types against a daemon on the simulator."""

    says: str = ""
    """A pattern that the command's output must match."""
    codes: tuple[int, ...] = (0,)


class Elsewhere(NamedTuple):
    """A command that the named test runs, with other addresses and directories."""

    file: str
    test: str
    but: str = ""
    """Any further difference between the test and the page. The test is the nearest one there is.
    """


class InCi(NamedTuple):
    """A command that `.ci/run` contains literally."""

    words: str


class Collected(NamedTuple):
    """A call of pytest. tests/system/test_pages.py checks that the call finds tests."""


class UntestedCommand(NamedTuple):
    """A command that no test runs, and the reason."""

    why: str


How = Run | Elsewhere | InCi | Collected | UntestedCommand

HERE = "tests/system/test_pages.py"
FLEET, UNIT = "tests/system/test_fleet.py", "tests/systemd/test_unit.py"
ROUTER = "tests/system/test_router.py"
LOG = "tests/unit/cli/test_recording.py"
TRANSCRIPT = Elsewhere(
    "tests/unit/cli/test_transcripts.py", "test_each_command_prints_what_its_transcript_says"
)
UPGRADE = "tests/systemd/test_upgrade.py"
PACKAGE = "tests/release/test_debian_package.py"
TWO_COMMANDS = Elsewhere(
    PACKAGE, "test_two_commands_lead_from_a_bare_debian_to_driving_in_a_browser"
)
PACKAGING = Elsewhere(PACKAGE, "test_the_same_source_gives_the_same_bytes")
SERVICE, OPEN = "tests/systemd/test_service.py", "tests/systemd/test_web.py"
WEB = "tests/system/test_web_strangers.py"
CALIBRATE = "tests/unit/cli/test_calibrate.py"
PRINTED = Elsewhere(CALIBRATE, "test_the_result_is_printed_as_text_and_the_file_stays")
CLIENTS = "tests/system/test_languages.py"
GUIDED = "tests/system/test_calibrate.py"
BRIDGED = "tests/system/test_ros_dds.py"

NO_ROS = UntestedCommand("needs ROS 2; the page says what was tried with it")
TWO_MACHINES = UntestedCommand("needs a second machine")
PLACES = Elsewhere(
    "tests/systemd/test_fleet.py",
    "test_a_router_runs_as_its_own_user_in_the_directories_that_the_page_creates",
)
PYTEST = Collected()
FIRST = Elsewhere(HERE, "test_the_first_command_of_the_readme_installs_it_and_the_robot_is_up")
BY_UV = Elsewhere(
    "tests/test_installed.py",
    "test_every_subcommand_of_an_installed_wheel_works_or_names_its_extra",
)
VENV = Elsewhere(HERE, "test_the_service_s_venv_has_all_that_lan_and_service_need")
AUTHORITY = Elsewhere(
    HERE, "test_the_install_line_of_the_fleet_page_suffices_to_make_its_authority"
)
TEN = Elsewhere(HERE, "test_one_authority_and_one_file_serve_the_ten_robots_of_the_fleet_page")
LAPTOP = Elsewhere(HERE, "test_the_laptop_of_the_fleet_page_does_what_its_role_may")
MANY = Elsewhere(
    "tests/system/test_many.py",
    "test_over_tls_a_wildcard_finds_no_robot_and_says_why_and_named_robots_are_found",
    "robot2 is not there",
)
IN_ONE_VIEW = Elsewhere(
    "tests/system/test_many.py", "test_the_two_robots_of_the_fleet_page_are_in_one_view"
)
BROKEN = Elsewhere(HERE, "test_the_broken_board_of_the_firmware_page_is_found_broken")
CABLE = Elsewhere(
    HERE, "test_the_robot_of_the_first_page_waits_after_its_cable_is_pulled_until_it_is_back"
)
DRIVE = Elsewhere(
    "tests/system/test_cli.py", "test_a_held_key_drives_and_its_release_stops_the_robot"
)
INSTALLED = Elsewhere(
    SERVICE, "test_the_service_runs_after_install_and_leaves_no_file_after_uninstall"
)
OPENED = Elsewhere(SERVICE, "test_after_lan_init_the_service_listens_on_the_network")
LAUNCH = Elsewhere(
    "tests/test_deploy_ros2.py",
    "test_the_launch_file_puts_the_namespace_before_every_topic",
    "the file is run, with what ROS has in it stood in for",
)

FOXGLOVE = "tests/system/test_foxglove.py"

IN_TYPESCRIPT = Elsewhere(
    CLIENTS, "test_the_typescript_example_follows_the_robot_through_the_bridge"
)
TYPED = Elsewhere(
    CLIENTS, "test_types_made_by_datamodel_code_generator_compile_and_parse_the_daemon_s_messages"
)

_AWAY = "--tls tls --address https://0.0.0.0:8443"
INVITED = Elsewhere(WEB, "test_an_invitation_prints_a_link_and_a_qr_code_that_give_access")
COOKIE = Elsewhere(WEB, "test_a_token_becomes_a_cookie_that_no_script_reads_and_ends_when_revoked")

BY_THE_SERVICE = Elsewhere(
    OPEN, "test_an_invited_phone_drives_and_stops_the_installed_robot_until_it_is_revoked"
)

_BRIDGE_FILE = "deploy/ros2/zenoh-bridge-ros2dds.json5"
_LAUNCH_FILE = "deploy/ros2/acsar.launch.py"
_ROUTER = "--id robot1 --connect tls/router.local:7447 --tls"
_PLAIN = "--connect tcp/127.0.0.1:7447"
_ROUTERS = _ROUTER.replace("robot1", "robot1,robot2")
_RMW_ROUTER = """ZENOH_CONFIG_OVERRIDE='listen/endpoints=["tcp/127.0.0.1:7447"]'"""

COMMANDS: dict[str, How] = {
    "sudo apt install mmdebstrap binutils binutils-aarch64-linux-gnu debian-archive-keyring": (
        UntestedCommand("the test says which of these packages is missing")
    ),
    "python3 -m venv tools": PACKAGING,
    "deploy/release/build --out dist": Elsewhere(
        "tests/test_release.py", "test_two_builds_of_a_commit_give_the_same_files"
    ),
    "tools/bin/pip install -r deploy/release/requirements.lock": PACKAGING,
    "tools/bin/python deploy/release/debian.py acsard-0.2.0-py3-none-any.whl packages": PACKAGING,
    "sudo ACSARD_TEST_DEBS=/var/tmp/debs .venv/bin/pytest -n 0 -s -m systemd "
    "tests/release/test_debian_package.py": PACKAGING,
    "lintian packages/*.deb": UntestedCommand("lintian differs between releases of Debian"),
    "sudo piuparts -d bookworm -i /opt/ packages/acsard_*deb12_amd64.deb": Elsewhere(
        PACKAGE,
        "test_an_upgrade_switches_nothing_and_purge_leaves_nothing",
        but="piuparts was typed by hand; the test compares the same lists of files",
    ),
    "sudo piuparts -d trixie -i /opt/ -i /var/cache/debconf/tmp.ci/ "
    "packages/acsard_*deb13_amd64.deb": Elsewhere(
        PACKAGE,
        "test_an_upgrade_switches_nothing_and_purge_leaves_nothing",
        but="piuparts was typed by hand; the test compares the same lists of files",
    ),
    "sudo apt install ./acsard_0.2.0-1~deb12_arm64.deb": TWO_COMMANDS,
    "acsard run --port sim": TWO_COMMANDS,
    "sudo systemctl disable --now acsard acsard-web acsard-gateway": Elsewhere(
        PACKAGE, "test_the_first_installation_starts_the_service_and_no_upgrade_restarts_it"
    ),
    # README.md
    "python3 -m venv .venv && .venv/bin/pip install '.[tools]' && .venv/bin/acsard run": FIRST,
    "python3 -m venv .venv && .venv/bin/pip install -e '.[test]' && .venv/bin/pytest": InCi(
        "-e '.[test]'"
    ),
    ". .venv/bin/activate": Run(),
    "acsard drive": DRIVE,
    "acsard echo odom -n 1 --short": Run(r"^x +[+-]\d.* m  y .* m  yaw .*°  forward .* m/s  turn"),
    "acsard echo odom -n 1": Run('"child_frame_id":"base_link"'),
    "acsard echo state -n 1 --short": Run(r"^x .*°  forward .* m/s  turn .* rad/s  [a-z]+: "),
    "acsard top": Run("wheels, rad/s"),
    "acsard call stop": Run("^stopped and latched; srv/clear releases it$"),
    "acsard call clear": Run("^cleared; each sender must send a zero before it drives$"),
    "acsard ports": Run(codes=(0, 1)),
    "acsard mcu check --port DEVICE": Elsewhere(
        "tests/system/test_mcu.py", "test_a_person_at_a_real_port_is_asked_after_each_motor"
    ),
    "acsard run --port DEVICE": Elsewhere(
        "tests/system/test_start.py", "test_permission_granted_within_2_s_of_the_start_is_enough"
    ),
    "acsard doctor": Run("daemon", codes=(0, 1)),
    # deploy/README.md
    "acsard run": FIRST,
    "acsard sim --link ./mcu": CABLE,
    "acsard run --port ./mcu": CABLE,
    "acsard check > robot.toml": Run(),
    "export ACSARD_CONFIG=$PWD/robot.toml": Run(),
    "acsard mcu check --port DEVICE --write": Elsewhere(
        "tests/system/test_mcu.py",
        "test_the_operator_s_answers_become_the_wheel_map",
        "the port is the simulator",
    ),
    "acsard drive --linear 0.2 --angular 0.5": DRIVE._replace(but="at the default speeds"),
    # acsard/README.md
    ".venv/bin/python -m pydoc acsard": Run("Where to look"),
    ".venv/bin/ruff check .": InCi(".venv/bin/ruff check ."),
    ".venv/bin/ruff format --check .": InCi(".venv/bin/ruff format --check ."),
    ".venv/bin/mypy": InCi(".venv/bin/mypy"),
    ".venv/bin/lint-imports": Elsewhere(
        "tests/test_shape.py", "test_the_import_contracts_are_kept"
    ),
    ".venv/bin/pytest tests/unit tests/scenarios tests/test_*.py": PYTEST,
    ".venv/bin/pre-commit install": UntestedCommand("changes the hooks of this clone"),
    # tests/README.md
    ".venv/bin/pytest": PYTEST,
    ".venv/bin/pytest "
    "-m '(slow or network or systemd or firmware) and not (soak or nightly)'": PYTEST,
    ".venv/bin/pytest -m 'nightly and not soak'": PYTEST,
    ".venv/bin/pytest -m languages": PYTEST,
    ".venv/bin/pytest -m bridge": PYTEST,
    ".venv/bin/pip install -e '.[test,dds]'": UntestedCommand(
        "downloads what only the tests of DDS need"
    ),
    "sudo apt install cmake g++ libclang-dev": UntestedCommand(
        "installs what builds the bridge of the tests"
    ),
    ".venv/bin/pytest -m soak -s": PYTEST,
    "bash .ci/run": UntestedCommand("it is what runs everything here"),
    ".venv/bin/python -m tests.pythons python3.12 python3.13": UntestedCommand(
        "installs into venvs of other Pythons, for who has them"
    ),
    ".venv/bin/python -m tests.simulate --seed 1 --hours 24": UntestedCommand("takes half an hour"),
    ".venv/bin/python -m tests.simulate --replay 17": Elsewhere(
        "tests/simulate/test_simulate.py", "test_a_seed_of_a_replay_is_played_and_reported"
    ),
    ".venv/bin/python -m tests.simulate --shrink 17 --keep NAME": Elsewhere(
        "tests/simulate/test_simulate.py", "test_shrinking_leaves_what_the_finding_needs"
    ),
    ".venv/bin/python -m tests.simulate --seed 1 --hours 24 --against ../other": Elsewhere(
        "tests/simulate/test_simulate.py",
        "test_a_paired_run_finds_no_difference_to_the_same_code_and_names_the_first_one_else",
    ),
    "git worktree add --detach ../other HEAD~1": UntestedCommand("needs the history"),
    ".venv/bin/coverage run": InCi(".venv/bin/coverage run"),
    ".venv/bin/coverage report": InCi(".venv/bin/coverage report"),
    ".venv/bin/python -m tests.simulate.planted": UntestedCommand("takes hours"),
    ".venv/bin/python -m tests.simulate.planted --again": Elsewhere(
        "tests/simulate/test_planted.py",
        "test_a_row_whose_seed_finds_nothing_any_more_is_listed",
    ),
    ".venv/bin/python -m tests.power compare": Elsewhere(
        "tests/power/test_compare.py", "test_a_test_that_is_deleted_is_a_loss"
    ),
    ".venv/bin/python -m tests.power baseline --anew": UntestedCommand("takes hours"),
    ".venv/bin/python -m tests.power mutants --sample 240": UntestedCommand("takes long"),
    ".venv/bin/python -m tests.power mutants --safety": UntestedCommand("takes long"),
    ".venv/bin/python -m tests.pictures pictures": Elsewhere(
        "tests/system/test_page.py",
        "test_every_view_is_drawn_on_a_phone_in_both_orientations_and_on_a_desktop",
    ),
    ".venv/bin/pytest -s -m bench tests/bench/test_figures.py": UntestedCommand("is a test"),
    # deploy/clients
    "python deploy/clients/python/follow.py": Elsewhere(
        CLIENTS, "test_the_python_example_follows_the_robot"
    ),
    "sh deploy/clients/curl/robot.sh stop": Elsewhere(
        CLIENTS, "test_the_program_for_curl_stops_and_releases_the_robot"
    ),
    "node deploy/clients/node/drive.mjs": Elsewhere(
        CLIENTS, "test_the_node_program_drives_the_robot"
    ),
    "cd deploy/clients/go && go run .": Elsewhere(CLIENTS, "test_the_go_program_drives_the_robot"),
    "java deploy/clients/java/Drive.java": Elsewhere(
        CLIENTS, "test_the_java_program_drives_the_robot"
    ),
    "cd deploy/clients/rust && cargo run": Elsewhere(
        CLIENTS, "test_the_rust_example_follows_the_robot"
    ),
    "cargo install zenoh-bridge-remote-api@1.10.2 --locked": IN_TYPESCRIPT,
    "zenoh-bridge-remote-api -m client -e tcp/127.0.0.1:7448 --no-multicast-scouting "
    "--ws-port 127.0.0.1:10000": IN_TYPESCRIPT,
    "cd deploy/clients/typescript && npm install && npm run build && npm start": IN_TYPESCRIPT,
    "python deploy/clients/python/schemas.py schemas": TYPED,
    "npx quicktype --lang typescript --src-lang schema --src schemas/*.json -o acsard.ts": (
        Elsewhere(CLIENTS, "test_types_made_by_quicktype_compile_and_parse_the_daemon_s_messages")
    ),
    "pip install datamodel-code-generator": TYPED,
    "datamodel-codegen --input schemas --input-file-type jsonschema "
    "--output-model-type pydantic_v2.BaseModel --output acsard_types": TYPED,
    # deploy/foxglove
    ".venv/bin/pip install '.[foxglove]'": UntestedCommand(
        "an install with extras is made by other tests"
    ),
    ".venv/bin/acsard foxglove": Elsewhere(
        FOXGLOVE, "test_a_viewer_can_stop_the_robot_and_do_nothing_else"
    ),
    "ssh -N -L 8765:127.0.0.1:8765 USER@ROBOT": TWO_MACHINES,
    "acsard foxglove --connect tls/robot.local:7449 --tls clients/viewer": Elsewhere(
        "tests/system/test_whoami.py",
        "test_foxglove_with_a_viewer_s_certificate_shows_and_stops_the_robot",
    ),
    # deploy/firmware
    "sudo apt install make gcc-avr avr-libc binutils-avr avrdude": InCi("gcc-avr"),
    "make": Elsewhere(
        "tests/firmware/test_board.py", "test_the_board_boots_stopped_and_sends_its_identity"
    ),
    "make flash PORT=/dev/ttyACM0": Elsewhere(
        HERE,
        "test_the_flash_of_the_firmware_page_calls_avrdude_with_its_port",
        "make only says what it would do",
    ),
    "stty -F /dev/ttyACM0 115200 raw -echo && cat /dev/ttyACM0": UntestedCommand("needs a board"),
    "sudo systemctl stop acsard": Elsewhere(
        UNIT, "test_stop_ramps_down_ends_with_stop_and_exits_0"
    ),
    "acsard mcu check --port sim --yes": Run("PASS +watchdog"),
    "acsard sim --link ./mcu --fault comma_latched --fault reversed_motor=b": BROKEN,
    "acsard sim --link ./mcu --fault reversed_motor=b": BROKEN._replace(but="and needs a comma"),
    "acsard mcu check --port ./mcu --yes": BROKEN,
    "acsard echo sim/pose -n 1": Run('"frame_id":"sim"'),
    "acsard calibrate drive": Elsewhere(
        GUIDED, "test_a_person_with_a_gyro_is_guided_from_the_start_to_the_written_file"
    ),
    "acsard calibrate drive --method tape --write": Elsewhere(
        GUIDED, "test_a_person_with_a_tape_alone_is_guided_to_the_written_file"
    ),
    "acsard calibrate drive --poses sim/pose --yes": Elsewhere(
        GUIDED, "test_the_simulator_is_calibrated_by_its_true_pose_without_a_person"
    ),
    "acsard calibrate log drive.csv": PRINTED,
    # deploy/calibration
    "acsard calibrate log drive.csv --config acsard.toml": PRINTED,
    "acsard calibrate log drive.csv --config acsard.toml --write": Elsewhere(
        CALIBRATE, "test_write_keeps_the_comments_and_a_second_time_finds_nothing_to_improve"
    ),
    "pip install rosbags": UntestedCommand("a library of PyPI that the tests have"),
    "python3 bag_to_csv.py drive drive.csv --wheels /joint_states --left left_wheel "
    "--right right_wheel --imu /imu/data": Elsewhere(
        "tests/unit/calibration/test_cases.py", "test_the_command_of_the_page_converts_a_bag"
    ),
    "acsard calibrate log drive.csv --distance 4.03 --write": Elsewhere(
        CALIBRATE, "test_a_distance_measures_the_wheels"
    ),
    "sudo apt install gcc libsimavr-dev libelf-dev": InCi("libsimavr-dev"),
    '.venv/bin/pytest -m "not (firmware or soak)" tests/firmware': PYTEST,
    '.venv/bin/pytest -s -m "firmware and not soak" tests/firmware': PYTEST,
    # deploy/web
    "acsard tls init --directory tls": Elsewhere(
        "tests/unit/cli/test_tls_verb.py",
        "test_init_makes_an_authority_the_robots_certificate_and_one_for_each_role",
    ),
    f"acsard web {_AWAY} invite operator --name phone --days 30": INVITED,
    "acsard web --tls tls --address https://0.0.0.0:8443": INVITED,
    "acsard web tokens": COOKIE,
    "acsard web revoke phone": COOKIE,
    "sudo acsard tls init": BY_THE_SERVICE,
    "sudo install -D -m 0644 -t /etc/systemd/system/acsard-web.service.d "
    "/opt/acsard/current/lib/acsard/deploy/systemd/lan.conf": BY_THE_SERVICE,
    'sudo sh -c "systemctl daemon-reload && systemctl restart acsard-web"': BY_THE_SERVICE,
    "sudo acsard web invite operator --config /etc/acsard/acsard.toml --name phone": BY_THE_SERVICE,
    "sudo acsard web revoke phone --config /etc/acsard/acsard.toml": BY_THE_SERVICE,
    'sudo sh -c "acsard tls renew && '
    'systemctl try-reload-or-restart acsard-web acsard-gateway"': Elsewhere(
        OPEN, "test_a_renewed_certificate_is_shown_after_the_reload_and_tokens_still_count"
    ),
    # deploy/ros2
    "source /opt/ros/jazzy/setup.bash": NO_ROS,
    "export RMW_IMPLEMENTATION=rmw_cyclonedds_cpp": Run(),
    "export RMW_IMPLEMENTATION=rmw_zenoh_cpp": Run(),
    "export ROS_DOMAIN_ID=0": Run(),
    "export ZENOH_ROUTER_CHECK_ATTEMPTS=10": Run(),
    """export ZENOH_CONFIG_OVERRIDE='mode="client";connect/endpoints=["tcp/127.0.0.1:7447"]'""": (
        Run()
    ),
    f"zenoh-bridge-ros2dds -c {_BRIDGE_FILE}": Elsewhere(
        BRIDGED,
        "test_a_bridge_that_starts_before_the_robot_joins_it_and_joins_it_again",
        "by a program of the tests around the same plugin",
    ),
    f"zenoh-bridge-ros2dds -c {_BRIDGE_FILE} -e tcp/ROBOT:7448 -n /robot1": Elsewhere(
        BRIDGED, "test_a_command_to_one_robot_drives_only_that_one", "on one machine"
    ),
    "python3 deploy/ros2/drive.py 0.2 0.0 3": Elsewhere(
        "tests/system/test_ros_drive.py",
        "test_the_command_line_of_the_pages_drives_the_robot",
        "by stand-ins for rclpy and the messages",
    ),
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
    "ros2 param describe /acsard limits.linear_speed": NO_ROS,
    "ros2 param set /acsard limits.linear_speed 0.8": NO_ROS,
    "ros2 run teleop_twist_keyboard teleop_twist_keyboard --ros-args "
    "-r cmd_vel:=cmd_vel_teleop": NO_ROS,
    'ros2 topic pub --once /speed_limit nav2_msgs/msg/SpeedLimit "{speed_limit: 0.0}"': NO_ROS,
    "ros2 run diagnostic_aggregator aggregator_node --ros-args "
    "--params-file deploy/ros2/diagnostics.yaml": NO_ROS,
    f"ros2 launch {_LAUNCH_FILE} use_rviz:=true": LAUNCH,
    f"ros2 launch {_LAUNCH_FILE} use_ros2_control:=true": LAUNCH,
    "sudo apt install ros-$ROS_DISTRO-ros2-controllers "
    "ros-$ROS_DISTRO-joint-state-topic-hardware-interface": NO_ROS,
    # deploy/systemd
    "python3 -m venv .venv": VENV,
    ".venv/bin/pip install -r deploy/systemd/requirements.lock": VENV,
    ".venv/bin/pip install --no-deps --no-build-isolation .": VENV,
    "sudo .venv/bin/acsard service install": INSTALLED,
    "git pull && .venv/bin/pip install '.[tools]'": UntestedCommand("needs a newer commit"),
    "uv tool install -c constraints.txt './acsard-0.2.0-py3-none-any.whl[tools]'": BY_UV,
    "sudo ~/.local/bin/acsard service install": INSTALLED._replace(but="from a venv"),
    "sudo systemctl restart acsard": OPENED,
    "sudo acsard service upgrade .venv": Elsewhere(
        UPGRADE, "test_an_environment_is_upgraded_to_by_its_directory"
    ),
    "sudo acsard service upgrade acsard_0.3.0-1~deb12_arm64.deb": Elsewhere(
        UPGRADE, "test_a_package_is_upgraded_to_and_dpkg_alone_changes_nothing"
    ),
    "sudo acsard service rollback": Elsewhere(UPGRADE, "test_twenty_upgrades_and_rollbacks"),
    "sudo acsard doctor --config /etc/acsard/acsard.toml": Elsewhere(
        "tests/system/test_doctor.py",
        "test_the_text_output_has_a_line_for_each_finding_and_one_for_its_remedy",
    ),
    "sudo acsard recording": TRANSCRIPT,
    "sudo acsard recording --from yesterday": Elsewhere(
        LOG, "test_the_list_has_a_row_for_each_recording_of_the_range"
    ),
    "sudo acsard recording show --from 14:05": Elsewhere(
        LOG, "test_the_newest_recording_or_all_of_a_range_are_shown"
    ),
    "sudo acsard recording replay": TRANSCRIPT,
    "sudo acsard recording export 12 drive.mcap": Elsewhere(
        "tests/unit/cli/test_recording_export.py",
        "test_export_takes_a_number_and_a_name_and_overwrites_no_file",
    ),
    "acsard recording report FILE": Elsewhere(
        "tests/unit/cli/test_recording_report.py",
        "test_the_numbers_of_the_file_are_those_of_the_recording",
    ),
    "systemctl status acsard": INSTALLED._replace(but="the status line is asked for alone"),
    "journalctl -u acsard ACSARD_EVENT=link_down": Elsewhere(
        UNIT, "test_journal_entries_have_the_event_fields", "the event is chosen by the test"
    ),
    "acsard service status": INSTALLED,
    "sudo acsard tls init --write /etc/acsard/acsard.toml": OPENED,
    'sudo sh -c "systemctl daemon-reload && systemctl restart acsard"': OPENED,
    "acsard echo state --connect tls/robot.local:7449 --tls clients/viewer": OPENED._replace(
        but="it calls `stop` instead"
    ),
    # deploy/zenoh
    "acsard router two.json5": IN_ONE_VIEW,
    f"acsard run --id robot1 --namespace robot1 --listen tcp/127.0.0.1:7451 {_PLAIN}": IN_ONE_VIEW,
    f"acsard run --id robot2 --namespace robot2 --listen tcp/127.0.0.1:7452 {_PLAIN}": IN_ONE_VIEW,
    f"acsard fleet {_PLAIN}": IN_ONE_VIEW,
    f"acsard drive --id robot2 {_PLAIN}": DRIVE._replace(but="without the router"),
    f"acsard call stop --id '*' {_PLAIN}": IN_ONE_VIEW,
    "python3 -m venv .venv && .venv/bin/pip install '.[tools]'": AUTHORITY,
    "acsard tls init --directory fleet": Run("^Wrote "),
    "acsard tls add router.local --address 192.168.1.10 --directory fleet": Run("router.local"),
    "for n in {1..10}; do acsard tls add robot$n --directory fleet; done": TEN,
    "acsard tls router robot{1..10} --operator laptop-anna > router.json5": TEN,
    "acsard tls add laptop-anna --role operator --directory fleet": Run("operators = "),
    "acsard tls renew --name laptop-anna --directory fleet": Run("has a new certificate"),
    "sudo install -d -o zenohd -m 0700 /etc/zenohd/tls": PLACES,
    "sudo install -o zenohd -m 0400 ca.pem certificate.pem key.pem /etc/zenohd/tls/": PLACES,
    "sudo install -m 0644 router.json5 /etc/zenohd/": PLACES,
    "acsard router /etc/zenohd/router.json5": Elsewhere(
        ROUTER,
        "test_a_signal_ends_the_router",
        "with the file's addresses and certificates changed",
    ),
    "zenohd -c /etc/zenohd/router.json5": Elsewhere(
        FLEET,
        "test_each_certificate_may_do_exactly_what_the_access_table_allows",
        "by Zenoh's own router mode in the place of the program",
    ),
    "acsard check": Run("effective configuration"),
    f"acsard echo state -n 1 {_ROUTER} laptop-anna": LAPTOP,
    f"acsard drive {_ROUTER} laptop-anna": DRIVE._replace(
        but="without the router; `laptop-anna` calls by it"
    ),
    f"acsard call stop {_ROUTER} laptop-anna": LAPTOP,
    f"acsard fleet {_ROUTERS} laptop-anna": MANY,
    f"acsard call stop {_ROUTERS} laptop-anna": MANY,
    "sudo acsard set limits.linear_speed 0.8 --keep --config /etc/acsard/acsard.toml": Elsewhere(
        "tests/system/test_keep.py",
        "test_a_kept_setting_survives_a_restart_and_its_comments_stay",
    ),
    f"acsard set limits.linear_speed 0.8 {_ROUTERS} fleet/clients/maintainer": Elsewhere(
        "tests/system/test_many.py",
        "test_set_changes_named_robots_and_prints_a_line_for_each",
        "without certificates",
    ),
    f"acsard echo state -n 1 {_ROUTER} fleet/clients/viewer": LAPTOP,
    f"acsard call clear {_ROUTER} fleet/clients/viewer": LAPTOP,
    f"acsard call clear {_ROUTER} fleet/clients/operator": LAPTOP,
    f"acsard call stop {_ROUTER} fleet/clients/viewer": LAPTOP,
}


def promises() -> list[list[str]]:
    """Return the arguments of each pytest call on the pages.

    The calls come from the table of promises, one per row, and from code blocks.
    """
    spans = []
    for row in re.findall(r"^\| .* \|$", text_of("tests/README.md"), re.M):
        cell = row.rstrip(" |").rpartition(" | ")[2]
        spans += [span for span in re.findall(r"`([^`]+)`", cell) if "tests/" in span]
    spans += [c.removeprefix(".venv/bin/pytest") for c, how in COMMANDS.items() if how == PYTEST]
    return [_expanded(shlex.split(span)) for span in spans]


def _expanded(words: list[str]) -> list[str]:
    # As a shell does it.
    return [name for word in words for name in sorted(glob(word, root_dir=ROOT)) or [word]]

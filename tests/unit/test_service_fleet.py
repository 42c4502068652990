"""The loop that upgrades a fleet stops at the first robot that does not run the new version."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest

from tests.pages import blocks

ROBOTS = ("robot1", "robot2", "robot3")

# Stands for both: notes the robot and the command, and fails as the robot's file says. A robot that
# went back ends `acsard service upgrade` with 1 (tests/systemd), a lost connection ssh with 255.
STAND_IN = """\
#!/bin/sh
case "$0 $*" in
*/scp*) robot=${2%.local:} ;;
*) robot=${2%.local}; shift 2; echo "$robot: $*" >> log ;;
esac
exit "$(cat "${0##*/}.$robot" 2>/dev/null || echo 0)"
"""


@pytest.mark.parametrize(
    ("failing", "code", "reached"),
    [("", 0, 3), ("ssh.robot1", 1, 1), ("ssh.robot2", 1, 2), ("ssh.robot2", 255, 2),
     ("ssh.robot3", 1, 3), ("scp.robot2", 1, 1)],
)  # fmt: skip
def test_the_loop_of_the_page_leaves_the_robots_after_the_first_failure(
    tmp_path: Path, failing: str, code: int, reached: int
) -> None:
    (loop,) = (block.text for block in blocks("sh") if "for robot in robot1.local" in block.text)
    for name in ("ssh", "scp"):
        (tmp_path / name).write_text(STAND_IN)
        (tmp_path / name).chmod(0o755)
    if failing:
        (tmp_path / failing).write_text(str(code))
    env = os.environ | {"PATH": f"{tmp_path}:{os.environ['PATH']}"}
    done = subprocess.run(
        ["sh", "-c", loop], cwd=tmp_path, env=env, capture_output=True, text=True, timeout=20
    )
    log = tmp_path / "log"
    calls = log.read_text().splitlines() if log.exists() else []
    upgrade = "sudo acsard service upgrade acsard_0.3.0-1~deb12_arm64.deb"
    assert calls == [f"{robot}: {upgrade}" for robot in ROBOTS[:reached]]
    upgraded = [
        f"{robot}.local is upgraded" for robot in ROBOTS if f"{robot}.local is" in done.stdout
    ]
    last = failing.partition(".")[2]
    assert upgraded == [
        f"{robot}.local is upgraded" for robot in ROBOTS if not last or robot < last
    ]
    end = "look which version it runs; the robots after it are as before"
    assert done.stdout.splitlines() == [
        *upgraded, *([f"STOPPED at {last}.local: {end}"] if last else [])
    ]  # fmt: skip

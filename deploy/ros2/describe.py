"""Write the files of this directory again, with the sizes, names, frames and limits of a robot.

    acsard check --json > robot.json             # on the robot, for the service with --config
    python3 describe.py robot.json DIRECTORY     # where ROS runs; it needs no ROS

The directory gets acsar.urdf, controllers.yaml, nav2_params.yaml and ekf.yaml with the robot's
values, and acsar.launch.py, acsar.rviz and nav2.py as they are. A frame such as robot1/base_link
becomes the link base_link: give the part before it to the launch file, `frame_prefix:=robot1/`.
"""

import json
import re
import shutil
import sys
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent

# Of acsar.urdf: half of the wheelbase and of a tyre's width, and half of the chassis's length, m.
HALF_WHEELBASE, HALF_TYRE, HALF_CHASSIS = 0.12, 0.02, 0.17

SIDES = {"front_right": -1, "front_left": 1, "rear_left": 1, "rear_right": -1}


def described(robot: dict[str, Any]) -> dict[str, str]:
    """Return the text of each file with the values that `acsard check --json` prints."""
    texts = {
        name: (HERE / name).read_text(encoding="utf-8")
        for name in ("acsar.urdf", "controllers.yaml", "nav2_params.yaml", "ekf.yaml")
    }
    two = bool(robot["mcu"]["wheels"]["left"])
    texts["acsar.urdf"] = _urdf(texts["acsar.urdf"], robot, two)
    texts["controllers.yaml"] = _controllers(texts["controllers.yaml"], robot, two)
    texts["nav2_params.yaml"] = _nav2(texts["nav2_params.yaml"], robot)
    frames = robot["odometry"]
    texts["ekf.yaml"] = _put(
        texts["ekf.yaml"],
        odom_frame=frames["odom_frame"],
        world_frame=frames["odom_frame"],
        base_link_frame=frames["base_frame"],
    )
    return texts


def _urdf(text: str, robot: dict[str, Any], two: bool) -> str:
    drive, lidar, joints = robot["drive"], robot["lidar"], robot["joints"]
    radius, half = drive["wheel_radius"], drive["wheel_separation"] / 2
    x = 0.0 if two else HALF_WHEELBASE
    if two:
        text = _replace(text, r'(?m:^) *<(link|joint) name="rear_(?s:.*?)</\1>\n\n?', "")
    for place, side in SIDES.items():
        if two and place.startswith("rear"):
            continue
        at = f'<origin xyz="{x if place[0] == "f" else -x:g} {side * half:g} {radius:g}"'
        joint = rf'<joint name="{place}_wheel_joint" type="continuous">(?s:.*?)'
        text = _replace(text, rf'(?P<kept>{joint})<origin xyz="[^"]*"', at)
        name = joints[place.partition("_")[2]] if two else joints[place]
        text = _replace(text, f'"{place}_wheel_joint"', f'"{name}"')
    text = _replace(text, r'radius="0\.05"', f'radius="{radius:g}"')
    text = _replace(text, r'velocity="40\.0"', f'velocity="{robot["limits"]["wheel_speed"]:g}"')
    x, y, yaw = (lidar[f"lidar_{name}"] for name in ("x_offset", "y_offset", "yaw"))
    at = f'<origin xyz="{x:g} {y:g} 0" rpy="0 0 {yaw:g}"/>'
    text = _replace(text, r'(?P<kept><child link="lidar_link"/>\s*)<origin [^>]*/>', at)
    text = _replace(text, '"base_link"', f'"{_link(robot["odometry"]["base_frame"])}"')
    text = _replace(text, '"lidar_link"', f'"{_link(lidar["lidar_frame"])}"')
    # The comment at the top is about the defaults.
    head = "<!-- Written by describe.py -->\n"
    return _replace(text, r"\A(?P<kept>[^\n]*\n)<!--\n(?s:.*?)-->\n", head)


def _controllers(text: str, robot: dict[str, Any], two: bool) -> str:
    drive, limits, joints = robot["drive"], robot["limits"], robot["joints"]
    places = ("left", "right") if two else tuple(SIDES)
    values: dict[str, Any] = {
        f"{side}_wheel_names": [joints[place] for place in places if side in place]
        for side in ("left", "right")
    }
    values |= {
        "odom_frame_id": robot["odometry"]["odom_frame"],
        "base_frame_id": robot["odometry"]["base_frame"],
    }
    values |= {
        key: drive[key]
        for key in (
            "wheel_separation",
            "wheel_radius",
            "wheel_separation_multiplier",
            "left_wheel_radius_multiplier",
            "right_wheel_radius_multiplier",
        )
    }
    for axis, kind in (("linear.x", "linear"), ("angular.z", "angular")):
        speed, up, down = (limits[f"{kind}_{n}"] for n in ("speed", "acceleration", "deceleration"))
        values |= {
            f"{axis}.max_velocity": speed,
            f"{axis}.min_velocity": -speed,
            f"{axis}.max_acceleration": up,
            f"{axis}.max_deceleration": -down,
            f"{axis}.max_acceleration_reverse": -up,
            f"{axis}.max_deceleration_reverse": down,
        }
    return _put(text, **values)


def _nav2(text: str, robot: dict[str, Any]) -> str:
    limits, frames = robot["limits"], robot["odometry"]
    odom, base = frames["odom_frame"], frames["base_frame"]
    text = _replace(text, "global_frame: odom\n", f"global_frame: {odom}\n")
    below = f"{base.removesuffix(_link(base))}base_footprint"
    text = _replace(text, "base_frame_id: base_footprint\n", f"base_frame_id: {below}\n")
    x = max(HALF_CHASSIS, HALF_WHEELBASE + robot["drive"]["wheel_radius"])
    y = robot["drive"]["wheel_separation"] / 2 + HALF_TYRE
    corners = ((x, y), (x, -y), (-x, -y), (-x, y))
    footprint = ", ".join(f"[{a:g}, {b:g}]" for a, b in corners)
    speed, turn = limits["linear_speed"], limits["angular_speed"]
    up, turn_up = limits["linear_acceleration"], limits["angular_acceleration"]
    down, turn_down = limits["linear_deceleration"], limits["angular_deceleration"]
    return _put(
        text,
        odom_frame_id=odom,
        local_frame=odom,
        fixed_frame=odom,
        robot_base_frame=base,
        base_frame=base,
        footprint=f"[{footprint}]",
        vx_max=speed,
        wz_max=turn,
        ax_max=up,
        ax_min=-down,
        az_max=turn_up,
        max_rotational_vel=min(1.0, turn),
        rotational_acc_lim=turn_up,
        max_velocity=[speed, 0.0, turn],
        min_velocity=[-speed, 0.0, -turn],
        max_accel=[up, 0.0, turn_up],
        max_decel=[-down, 0.0, -turn_down],
    )


def _put(text: str, **values: Any) -> str:
    """Replace the value of each key, wherever it stands; JSON is YAML, too."""
    for key, value in values.items():
        pattern = rf"(?m:^)(?P<kept> *{re.escape(key)}: )[^#\n]*"
        text = _replace(text, pattern, json.dumps(value))
    return text


def _replace(text: str, pattern: str, new: str) -> str:
    """Replace what fits the pattern, except its group `kept`; exit if nothing fits."""
    text, count = re.subn(pattern, lambda m: m.groupdict().get("kept", "") + new, text)
    if not count:
        raise SystemExit(
            f"describe.py: a file has no text that fits {pattern!r}: take all files of one version"
        )
    return text


def _link(frame: str) -> str:
    return frame.rpartition("/")[2]


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    out = Path(sys.argv[2])
    texts = described(json.loads(Path(sys.argv[1]).read_text(encoding="utf-8")))
    out.mkdir(parents=True, exist_ok=True)
    for name, text in texts.items():
        (out / name).write_text(text, encoding="utf-8")
    for name in ("acsar.launch.py", "acsar.rviz", "nav2.py"):
        shutil.copy(HERE / name, out)

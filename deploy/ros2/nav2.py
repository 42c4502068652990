"""Print the parameters of Nav2 (first file) with those of this robot (second file) in their place.

python3 nav2.py NAV2_PARAMS nav2_params.yaml > nav2.yaml
"""

import sys
from pathlib import Path
from typing import Any

import yaml


def merged(nav2: Any, robot: Any) -> Any:
    """A mapping keeps the keys that the robot's file does not have; anything else is replaced."""
    if not (isinstance(nav2, dict) and isinstance(robot, dict)):
        return robot
    return nav2 | {key: merged(nav2.get(key), value) for key, value in robot.items()}


if len(sys.argv) != 3:
    sys.exit(__doc__)
nav2, robot = (yaml.safe_load(Path(name).read_text(encoding="utf-8")) for name in sys.argv[1:])
print(yaml.safe_dump(merged(nav2, robot), sort_keys=False), end="")

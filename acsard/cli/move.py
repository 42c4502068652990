"""Drive the robot straight ahead or turn it on the spot, by its odometry, and print its pose. For
example: acsard move forward 1 left 90. Ctrl-C stops the robot, and its pose is printed, too. The
exit code is 1 if the robot does not follow, comes no nearer to the end for 3 s, or gets a new pose.
"""

from __future__ import annotations

import argparse
import sys

from acsard.cli.common import add_speeds, between
from acsard.cli.robot_options import add_bus, connected
from acsard.client import Client
from acsard.core.messages.short_texts import place
from acsard.core.messages.state_warnings import WARNING, warnings
from acsard.host.errors import UsageError

# By the typed word: whether it is a turn, and the sign.
_WAYS = {"forward": (False, 1), "back": (False, -1), "left": (True, 1), "right": (True, -1)}


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "way",
        nargs="+",
        metavar="WAY",
        help="forward METRES, back METRES, left DEGREES or right DEGREES; several are driven one "
        "after the other",
    )
    add_speeds(parser, 0.3, 0.8, 0.02, "highest speed")
    add_bus(parser)


def main(args: argparse.Namespace) -> int:
    ways = _parsed(args.way)
    with connected(args) as connection:
        robot = Client(connection)
        try:
            for is_turn, amount in ways:
                if is_turn:
                    robot.turn(amount, speed=args.angular)
                else:
                    robot.move(amount, speed=args.linear)
        except KeyboardInterrupt:
            _print_pose(robot)
            raise
        _print_pose(robot)
    return 0


def _print_pose(robot: Client) -> None:
    pose = robot.pose()
    print("  ".join(place(pose.x, pose.y, pose.yaw)), flush=True)
    for problem in warnings(robot.get("state")):
        print(f"{WARNING}: {problem}", file=sys.stderr)


def _parsed(words: list[str]) -> list[tuple[bool, float]]:
    ways, amount = [], between(0.0, 1e4, "metres or degrees")
    for word, number in zip(words[::2], [*words[1::2], ""], strict=False):
        try:
            is_turn, sign = _WAYS[word]
            ways.append((is_turn, sign * amount(number)))
        except (KeyError, ValueError, argparse.ArgumentTypeError):
            raise UsageError(
                f"'{f'{word} {number}'.strip()}' is not a way; type for example `acsard move "
                "forward 1 left 90`, in metres and degrees"
            ) from None
    return ways

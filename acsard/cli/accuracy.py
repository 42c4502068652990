"""`acsard accuracy`: show what makes odometry wrong now, and how to improve it.

`calibration/error_budget/budget.py` computes it.
"""

from __future__ import annotations

import argparse
import sys
import time
from typing import TYPE_CHECKING

from acsard.cli.common import add_bus, load, robot_address
from acsard.host.errors import Exit, ExitError

if TYPE_CHECKING:
    from acsard.calibration.error_budget.budget import Budget
    from acsard.calibration.error_budget.daemon_messages import Feed
    from acsard.client import Client, Subscription
    from acsard.core.config.settings import Config

DESCRIPTION = """\
Follow the robot while it is driven, and print how much each cause alone makes its odometry wrong if
the drive goes on like that: in mm after 100 m, and in degrees after a turn of 360 degrees. The
causes are the times of the feedback lines, their rounding, gaps, slip, wheel radii and track width,
and the gyro if there is one. The tool also says how to reduce the largest error. It sends nothing.
While the robot stands still, it prints only the errors that follow from the settings.
"""

LOOK_S = 0.05


def add(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the verb and its options."""
    parser = verbs.add_parser(
        "accuracy",
        help="show the causes of odometry error now, and their fixes",
        description=DESCRIPTION,
    )
    parser.add_argument(
        "--seconds",
        type=_seconds,
        default=5.0,
        metavar="S",
        help="how long to measure (default: 5)",
    )
    parser.add_argument(
        "--follow",
        action="store_true",
        help="continue until Ctrl-C; every S seconds print the result since the start, or of "
        "the last ten minutes at most",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object a line")
    add_bus(parser)
    parser.set_defaults(main=main)


def main(args: argparse.Namespace) -> int:
    """Follow the robot and print its error budget."""
    from acsard.calibration.error_budget.budget import budget
    from acsard.calibration.error_budget.daemon_messages import KEYS, Feed
    from acsard.client import connect

    endpoint, robot_id, tls = robot_address(args)
    with connect(endpoint, robot_id=robot_id, tls=tls) as robot:
        config = _config(robot, args.config)
        queues = {key: robot.subscribe(key) for key in KEYS}
        try:
            _await_line(robot, queues["wheel_states"])
            feed = Feed(config, robot.get("state"))
            while True:
                _follow(feed, queues, args.seconds)
                received = feed.received(robot.get("state"), robot.get("diagnostics"))
                _print(budget(received, config), args.json)
                if not args.follow:
                    return int(Exit.OK)
        except KeyboardInterrupt:
            return int(Exit.OK)


def _seconds(text: str) -> float:
    seconds = float(text)
    if not 1.0 <= seconds <= 600.0:
        raise argparse.ArgumentTypeError(f"{text} is not from 1 to 600")
    return seconds


def _config(robot: Client, path: str | None) -> Config:
    """Return the daemon's configuration, or the local file's if the robot does not give it.

    Over the network only a maintainer may query the configuration.
    """
    import msgspec

    from acsard.core.config.settings import Config
    from acsard.host.errors import NoAnswerError, NotPermittedError

    try:
        return msgspec.convert(robot.get("config"), Config)
    except (NoAnswerError, NotPermittedError, msgspec.ValidationError):
        where, config = load(path)
        print(
            f"acsard: the robot does not answer with its configuration, so the tool uses {where}",
            file=sys.stderr,
        )
        return config


def _await_line(robot: Client, lines: Subscription) -> None:
    """Wait for the first feedback line, after which all keys are published.

    Raises `ExitError` with the robot's reason if none arrives within `FIRST_S`.
    """
    from acsard.client.follower import FIRST_S

    end = time.monotonic() + FIRST_S
    while lines.try_recv() is None:
        if time.monotonic() > end:
            state = robot.get("state")
            raise ExitError(Exit.FAILURE, f"no feedback lines come: {state.reason}")
        time.sleep(LOOK_S)


def _follow(feed: Feed, queues: dict[str, Subscription], seconds: float) -> None:
    """Pass all messages of the next `seconds` s to `feed`."""
    from acsard.client.synchronous import decoder
    from acsard.core.messages.encodings import DecodeError
    from acsard.daemon.bus.subscription import encoded

    decoders = {key: decoder(key) for key in queues}
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        time.sleep(LOOK_S)
        for key, queue in queues.items():
            while (sample := queue.try_recv()) is not None:
                try:
                    feed.add(decoders[key].decode(*encoded(sample)))
                except DecodeError as error:
                    raise ExitError(
                        Exit.FAILURE,
                        f"cannot read {key} ({error}); does the daemon have another version?",
                    ) from None


def _print(found: Budget, as_json: bool) -> None:
    import msgspec

    from acsard.calibration.error_budget.budget_report import advice, parts
    from acsard.terminal.output import SENTENCES, show

    if not as_json:
        show(*parts(found), most=SENTENCES)
        return
    millimetres, degrees = found.total()
    told = msgspec.to_builtins(found)
    told |= {"mm_per_100_m": millimetres, "deg_per_turn": degrees, "advice": advice(found)}
    print(msgspec.json.encode(told).decode(), flush=True)

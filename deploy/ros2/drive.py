"""Drive the robot from a ROS machine: zeros first, then one speed for a while, then zeros.

acsard follows a publisher only after the publisher has sent a zero. `ros2 topic pub` with a speed
never sends a zero, so use this script instead.

    python3 drive.py [LINEAR m/s] [ANGULAR rad/s] [SECONDS] [--ros-args -r __ns:=/robot1]
"""

import signal
import sys
import time
from typing import NoReturn

import rclpy
from geometry_msgs.msg import Twist
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

PERIOD_S = 0.05
PATIENCE_S = 10.0
"""Longest wait for a subscriber, s. A bridge creates its route only when a publisher appears."""
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
ZEROS_S = 1.5
"""Duration of the zeros before the drive, s. Behind a bridge all publishers look like one sender,
so a zero counts only when no speed has followed it for 1 s. Over rmw_zenoh 0.25 s is enough."""


def end(number: int, frame: object) -> NoReturn:
    """End the program after a signal.

    The final zeros are still sent. While they are sent, further signals are ignored.
    """
    for one in SIGNALS:
        signal.signal(one, signal.SIG_IGN)
    sys.exit(128 + number)


def main(argv: list[str]) -> None:
    given = [float(word) for word in remove_ros_args(argv)[1:]]
    linear, angular, seconds = given + [0.2, 0.0, 3.0][len(given) :]
    # rclpy's own signal handlers would end the context first, so that no zero could be sent.
    rclpy.init(args=argv, signal_handler_options=SignalHandlerOptions.NO)
    for number in SIGNALS:
        # With nohup, SIGHUP is ignored already: the program goes on when its terminal closes.
        if number != signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, end)
    try:
        drive(linear, angular, seconds)
    finally:
        rclpy.try_shutdown()


def drive(linear: float, angular: float, seconds: float) -> None:
    node = rclpy.create_node("acsar_drive")
    publisher = node.create_publisher(Twist, "cmd_vel", 10)
    deadline = time.monotonic() + PATIENCE_S
    while not publisher.get_subscription_count():
        if time.monotonic() > deadline:
            sys.exit("no program listens on cmd_vel: see page howto/ros-trouble of the manual")
        time.sleep(PERIOD_S)

    def hold(linear: float, angular: float, seconds: float) -> None:
        twist = Twist()
        twist.linear.x, twist.angular.z = linear, angular
        for _ in range(round(seconds / PERIOD_S)):
            publisher.publish(twist)
            time.sleep(PERIOD_S)

    hold(0.0, 0.0, ZEROS_S)
    try:
        hold(linear, angular, seconds)
    finally:
        hold(0.0, 0.0, 2 * PERIOD_S)


if __name__ == "__main__":
    main(sys.argv)

"""Prints where the robot is: `python follow.py [ENDPOINT [ID]]`; needs only eclipse-zenoh."""

import json
import sys

import zenoh

endpoint = sys.argv[1] if len(sys.argv) > 1 else "tcp/127.0.0.1:7448"
robot = sys.argv[2] if len(sys.argv) > 2 else "acsar"

config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("connect/endpoints", json.dumps([endpoint]))

with zenoh.open(config) as session:
    # Keep the subscriber in a variable: Zenoh undeclares a subscriber that nothing refers to.
    odometry = session.declare_subscriber(f"acsard/{robot}/json/odom")
    for sample in odometry:
        odom = json.loads(sample.payload.to_bytes())
        at, speed = odom["pose"]["pose"]["position"], odom["twist"]["twist"]["linear"]["x"]
        print(f"x {at['x']:.3f} m, y {at['y']:.3f} m, {speed:.3f} m/s", flush=True)

"""Programs of strangers: plain Zenoh and JSON, nothing of acsard. The text is what they run."""

from __future__ import annotations

import sys

_OPEN = """\
import json, sys, time
import zenoh

def open_session(endpoint):
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    config.insert_json5("scouting/multicast/enabled", "false")
    while True:
        try:
            return zenoh.open(config)
        except zenoh.ZError:
            time.sleep(0.01)
"""

FIRST_ODOMETRY = (
    _OPEN
    + """
print("ready", flush=True)
session = open_session(sys.argv[1])
subscriber = session.declare_subscriber("acsard/acsar/odom", zenoh.handlers.FifoChannel(10))
sample = subscriber.recv()
print("first", time.monotonic(), sample.encoding, flush=True)
session.close()
"""
)
"""Waits for the daemon, then for its first odometry; prints when that came."""

DRIVE = (
    _OPEN
    + """
session = open_session(sys.argv[1])
speed, seconds = float(sys.argv[2]), float(sys.argv[3])

def put(linear):
    session.put("acsard/acsar/cmd/app", json.dumps({"linear": {"x": linear}, "angular": {"z": 0}}))

put(0.0)
time.sleep(0.05)
start = time.monotonic()
for step in range(round(20 * seconds)):
    put(speed)
    time.sleep(max(0.0, start + (step + 1) / 20 - time.monotonic()))
put(0.0)
print("took", time.monotonic() - start, flush=True)
session.close()
"""
)
"""One zero, `speed` m/s at 20 Hz for `seconds`, one zero."""

STUCK = (
    _OPEN
    + """
session = open_session(sys.argv[1])
subscriber = session.declare_subscriber("acsard/acsar/**", lambda sample: None)
print("listening", flush=True)
sys.stdin.read()
time.sleep(600)
"""
)
"""Subscribes to everything and stays, to be stopped with SIGSTOP."""


FLOOD = (
    _OPEN
    + """
session = open_session(sys.argv[1])
speed, seconds = float(sys.argv[2]), float(sys.argv[3])

def command(linear):
    return json.dumps({"linear": {"x": linear}, "angular": {"z": 0}})

key = "acsard/acsar/cmd/app"
session.put(key, command(0.0))
time.sleep(0.05)
print("flooding", flush=True)
publisher, payload, count = session.declare_publisher(key), command(speed), 0
end = time.monotonic() + seconds
while time.monotonic() < end:
    publisher.put(payload)
    count += 1
print("flooded", count, flush=True)
session.close()
"""
)
"""One zero, then `speed` m/s as fast as one process can for `seconds`."""


def words(program: str, *arguments: object) -> list[str]:
    """The words that run such a program."""
    return [sys.executable, "-c", program, *map(str, arguments)]

"""Programs that use plain Zenoh and JSON, and nothing of acsard, like those of other people.

Each constant is the source text of a program.
"""

from __future__ import annotations

import sys

_OPEN = """\
import json, signal, sys, time
import zenoh

SENDER = json.dumps({"sender": "program/%d" % time.time_ns()})

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
"""Waits for the daemon, then for its first odometry; prints the time of its arrival."""


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
"""Subscribes to everything and stays, until a test stops it with SIGSTOP."""


FLOOD = (
    _OPEN
    + """
session = open_session(sys.argv[1])
speed, seconds = float(sys.argv[2]), float(sys.argv[3])

def command(linear):
    return json.dumps({"linear": {"x": linear}, "angular": {"z": 0}})

key = "acsard/acsar/cmd/app"
session.put(key, command(0.0), attachment=SENDER)
time.sleep(0.05)
print("flooding", flush=True)
publisher, payload, count = session.declare_publisher(key), command(speed), 0
end = time.monotonic() + seconds
while time.monotonic() < end:
    publisher.put(payload, attachment=SENDER)
    count += 1
print("flooded", count, flush=True)
session.close()
"""
)
"""Sends one zero, then `speed` m/s as fast as one process can for `seconds`."""


COMMANDER = (
    _OPEN
    + """
session = open_session(sys.argv[1])
source, speed, zeros = sys.argv[2], float(sys.argv[3]), int(sys.argv[4])

def put(linear):
    sec, nanosec = divmod(time.time_ns(), 10**9)
    header = {"stamp": {"sec": sec, "nanosec": nanosec}}
    twist = {"linear": {"x": linear}, "angular": {"z": 0}}
    print("put", repr(time.monotonic()), flush=True)
    wish = json.dumps({"header": header, "twist": twist})
    session.put("acsard/acsar/cmd/" + source, wish, attachment=SENDER)

for _ in range(zeros):
    put(0.0)
    time.sleep(0.05)
lets_go = []
signal.signal(signal.SIGUSR1, lambda *_: lets_go.extend([0.0] * 30))
start, step = time.monotonic(), 0
while True:
    put(lets_go.pop() if lets_go else speed)
    step += 1
    time.sleep(max(0.0, start + step / 20 - time.monotonic()))
"""
)
"""Sends this number of zeros, then `speed` m/s at 20 Hz for ever, stamped.

Prints the time just before each put. On SIGUSR1 it returns to neutral: it sends thirty zeros.
"""


HOARDER = (
    _OPEN.replace(
        "    while True:",
        "    config.insert_json5('transport/link/tx/lease', '600000')\n    while True:",
    )
    + """
session = open_session(sys.argv[1])
subscriber = session.declare_subscriber("acsard/acsar/**", lambda sample: None)
print("listening", flush=True)
time.sleep(600)
"""
)
"""Subscribes to everything and announces a lifetime of ten minutes, until SIGSTOP."""

ROUTER = """\
import json, signal, sys, time
import zenoh
config = zenoh.Config()
config.insert_json5("mode", '"router"')
config.insert_json5("listen/endpoints", json.dumps([sys.argv[1]]))
config.insert_json5("connect/endpoints", json.dumps(sys.argv[2:]))
config.insert_json5("scouting/multicast/enabled", "false")
session = zenoh.open(config)
print("routing", repr(time.monotonic()), flush=True)
time.sleep(600)
"""
"""A Zenoh router at an address, connected to the routers at the other addresses."""


def command_line(program: str, *arguments: object) -> list[str]:
    """Return the command line that runs a program of this module."""
    return [sys.executable, "-c", program, *map(str, arguments)]


HOSTILE = """\
import json, os, sys, time
import zenoh
form, door, settings, seconds = sys.argv[1:]
os.nice(19)

def session():
    config = zenoh.Config()
    mode = form.partition("as_")[2] or "client"
    config.insert_json5("mode", json.dumps(mode))
    config.insert_json5("listen/endpoints", "[]")
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("connect/endpoints", json.dumps([door]))
    config.insert_json5("transport/link/tls", settings)
    return zenoh.open(config)

def deep(end, before="acsard/"):
    return before + "**/a/" * 11 + end

def chunk(end):
    return "acsard/" + "$*a" * 11 + "$*" + end

adv, lv = "acsard/acsar/tf_static/@adv/", "@ros2_lv/"
# Each of the two in a session of its own, which does not have to compare them.
one, two = session(), session()
hold = lambda sample: None
pair = {
    "subscribe": lambda s, end: s.declare_subscriber(deep(end), hold),
    "chunk": lambda s, end: s.declare_subscriber(chunk(end), hold),
    "late": lambda s, end: s.declare_subscriber(deep(end, adv), hold),
    "ros": lambda s, end: s.liveliness().declare_subscriber(deep(end, lv), hold),
    "alive": lambda s, end: s.liveliness().declare_subscriber(deep(end), hold),
    "token": lambda s, end: s.liveliness().declare_token(deep(end)),
    "ask": lambda s, end: s.get(deep(end)),
    "serve": lambda s, end: s.declare_queryable(deep(end), hold),
    "name": lambda s, end: s.declare_keyexpr(deep(end)),
    "publish": lambda s, end: s.declare_publisher(deep(end)),
    "querier": lambda s, end: s.declare_querier(deep(end)),
}
form, _, number = form.partition("@")
many = {
    "many": "acsard/**/x%d/**/odom",
    "many_chunks": "acsard/$*x%d$*",
    "many_exact": "acsard/acsar/x%d",
}
# What every role may, as fast as one process can.
may = {
    "may_stop": lambda: one.put("acsard/acsar/stop", b""),
    "may_call": lambda: one.get("acsard/acsar/srv/stop", hold),
    "may_ask": lambda: one.get("acsard/acsar/state", hold),
}
print("begun", flush=True)
end = time.monotonic() + float(seconds)
if form == "come_and_go":
    while time.monotonic() < end:
        session().close()
elif form == "flood":
    # As much as goes through: calls of all a viewer may call, and puts on what he may not.
    while time.monotonic() < end:
        one.put("acsard/acsar/cmd/app", b"x" * 60000)
        two.get("acsard/acsar/state", hold)
        one.put("acsard/acsar/stop/not", b"x")
elif form in may:
    while time.monotonic() < end:
        may[form]()
elif form == "sessions":
    kept = [one, two]
    while time.monotonic() < end:
        try:
            kept.append(session())
        except zenoh.ZError:
            time.sleep(0.01)
elif form in many:
    kept = [one.declare_subscriber(many[form] % i, hold) for i in range(int(number or 700))]
else:
    if form.startswith("as_"):
        form = "publish"
    kept = [pair[form](one, "b"), pair[form](two, "c")]
print("declared", flush=True)
time.sleep(max(0.0, end - time.monotonic()))
os._exit(0)
"""
"""A client that is admitted with some certificate and attacks.

It uses key expressions that are slow to compare, many that are slow to remove (`many@1500` for 1500
of them), endless permitted actions, or all available sessions. It leaves after the given number of
seconds.
"""

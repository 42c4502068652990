"""Writes the JSON Schemas of a robot: `python schemas.py DIRECTORY [ENDPOINT [ID]]`."""

import json
import sys
from pathlib import Path

import zenoh

directory = Path(sys.argv[1])
endpoint = sys.argv[2] if len(sys.argv) > 2 else "tcp/127.0.0.1:7448"
robot = sys.argv[3] if len(sys.argv) > 3 else "acsar"

config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("connect/endpoints", json.dumps([endpoint]))

directory.mkdir(exist_ok=True)
with zenoh.open(config) as session:
    for reply in session.get(f"acsard/{robot}/schema/*"):
        name = str(reply.ok.key_expr).rpartition("/")[2]
        (directory / f"{name}.json").write_bytes(reply.ok.payload.to_bytes())
        print(name)

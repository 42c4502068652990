"""Two versions of acsard, each a wheel of this tree that is installed in its own venv.

The newer one is the same wheel with more in it: a field in everything that a client receives, in
each attachment and in each file, and a verb, words and a code that the older one does not know.
"""

from __future__ import annotations

import re
import subprocess
import sys
import sysconfig
from collections.abc import Mapping
from pathlib import Path

from tests.system.harness import ROOT, environment

MODE, LEVEL, CODE, REASON = "poised", "notice", "pondering", "thinks about the next command"
"""Words of the newer version: of a mode, a level, and of a code with its text."""

VERB, LATCH_CODE = "dance", "stopped_by_music"

ONLY_SENT = {
    "RobotState", "SourceState", "BatterySummary", "Beat", "Cause", "Spread", "Latency", "LogEvent",
    "Events", "Change", "ReplyData", "ServiceReply", "Info", "HardwareInterface", "Interfaces",
    "TopicInfo", "Topics", "WhoAmI",
}  # fmt: skip
"""Messages and parts that only the daemon sends and that are no ROS types: the newer version's
clients know the new field of these. In all others it is only on the wire."""

LATER = '''\
"""Adds a field to each part of a message, as a later version may do."""

import msgspec

from acsard.core.messages import encodings


def grown(value, grows=True):
    match value:
        case msgspec.Struct():
            fields = {
                name: grown(getattr(value, name), name == "counters")
                for name in value.__struct_fields__
            }
            return {"later": [1]} | fields
        case dict():
            parts = {key: grown(item) for key, item in value.items()}
            return parts | {"later": 1} if grows else parts
        case list() | tuple():
            return [grown(item) for item in value]
    return value


def encode(message, form):
    return encodings.encode(message if form == "cdr" else grown(message), form)
'''


class Version:
    """An installed wheel in a venv, which finds the libraries of the tests' own environment."""

    def __init__(self, place: Path, wheel: Path) -> None:
        self.place = place
        _run(sys.executable, "-m", "venv", "--without-pip", str(place))
        self.python, self.acsard = str(place / "bin/python"), str(place / "bin/acsard")
        (site,) = place.glob("lib/python3*/site-packages")
        (site / "libraries.pth").write_text(f"{sysconfig.get_path('purelib')}\n")
        pip = [sys.executable, "-m", "pip", "--python", self.python, "install", "--quiet"]
        _run(*pip, "--no-deps", "--no-index", "--no-compile", str(wheel))
        self.package = site / "acsard"

    def swap(self, file: str, changes: Mapping[str, str]) -> None:
        """Replace texts in the source of a module; each must be there once."""
        path = self.package / file
        text = path.read_text()
        for old, new in changes.items():
            assert text.count(old) == 1, f"{file} has {old!r} {text.count(old)} times"
            text = text.replace(old, new)
        path.write_text(text)


def built_wheel(where: Path) -> Path:
    """Build the wheel of this tree without a network."""
    pip = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation"]
    _run(*pip, "-w", str(where), str(ROOT))
    (wheel,) = where.glob("acsard-*.whl")
    return wheel


def plain_environment(**more: str) -> dict[str, str]:
    """Return the environment for an installed version: no import from this tree."""
    return {key: value for key, value in environment(**more).items() if key != "PYTHONPATH"}


def _run(*words: str) -> None:
    done = subprocess.run(
        words, env=plain_environment(), capture_output=True, text=True, check=False, timeout=120
    )
    assert done.returncode == 0, f"{words}\n{done.stdout}\n{done.stderr}"


def grow(newer: Version) -> None:
    """Make an installed version the newer one."""
    (newer.package / "core/messages/later.py").write_text(LATER)
    for file in ("daemon/bus/outlets.py", "core/messages/frames.py", "core/incoming/queries.py"):
        path = newer.package / file
        path.write_text(
            f"{path.read_text()}\nfrom acsard.core.messages.later import encode  # noqa\n"
        )
    schema = newer.package / "core/messages/schema.py"
    names = "|".join(sorted(ONLY_SENT))
    text, count = re.subn(
        rf"^(class (?:{names})\(Message, frozen=True\):\n(?:(?:[ #)].*)?\n)+)",
        lambda found: f"{found[1].rstrip()}\n    later: list[int] = []\n\n\n",
        schema.read_text(),
        flags=re.M,
    )
    assert count == len(ONLY_SENT)
    schema.write_text(text)
    _say_more(newer)
    _keep_more(newer)
    _record_more(newer)


def _say_more(newer: Version) -> None:
    newer.swap(
        "core/messages/report.py",
        {
            "            mode=status.mode,": f"""\
            mode="{MODE}" if status.mode == "ready" else status.mode,""",
            "            reason=status.reason,\n            code=status.code,": f"""\
            reason="{REASON}" if status.code == "no_command" else status.reason,
            code="{CODE}" if status.code == "no_command" else status.code,""",
        },
    )
    newer.swap(
        "core/messages/diagnostics.py",
        {
            "OK), status.reason, values": f'OK), "{REASON}" if status.code == "no_command" '
            "else status.reason, values"
        },
    )
    newer.swap(
        "core/messages/recent_events.py",
        {
            "event.level, event.text, event.by, event.count, event.code": f'"{LEVEL}", event.text, '
            f'event.by, event.count, event.code or "{CODE}"'
        },
    )
    newer.swap("core/values.py", {'"set_pose", "set"]': f'"set_pose", "set", "{VERB}"]'})
    newer.swap(
        "core/robot.py",
        {
            '            case "deactivate":': f"""\
            case "{VERB}":
                return "dances", ()
            case "deactivate":"""
        },
    )
    newer.swap(
        "core/messages/keys_and_roles.py",
        {
            '    "set_pose": Service(': f"""\
    "{VERB}": Service("operator", "dance on the spot"),
    "set_pose": Service("""
        },
    )
    newer.swap(
        "core/messages/signature.py",
        {
            "return msgspec.msgpack.encode(self)": "return msgspec.msgpack.encode("
            'msgspec.to_builtins(self) | {"later": 1})'
        },
    )
    newer.swap(
        "core/config/settings.py",
        {
            "    megabytes: Annotated[float, Meta(ge=10.0,": """\
    later: int = 1
    megabytes: Annotated[float, Meta(ge=10.0,"""
        },
    )


def _keep_more(newer: Version) -> None:
    # The files that outlive the process: the latches and the tokens.
    newer.swap(
        "daemon/latch_file.py",
        {
            "msgspec.json.encode(content), indent": "msgspec.json.encode("
            "_grown(msgspec.to_builtins(content))), indent",
        },
    )
    rules = newer.package / "daemon/latch_file.py"
    rules.write_text(
        f"""{rules.read_text()}

def _grown(content):
    for cause in content["causes"]:
        cause |= {{"later": [1]}} | ({{"code": "{LATCH_CODE}"}} if cause["by"] else {{}})
    return content | {{"later": 1}}
"""
    )
    newer.swap(
        "web/tokens.py",
        {
            "    robot: str  # whose page it opens\n": """\
    robot: str  # whose page it opens
    later: int = 1
"""
        },
    )


def _record_more(newer: Version) -> None:
    # A field in each struct: at the end of a row, and first in a map.
    newer.swap(
        "recording/file.py",
        {
            "_encode = msgspec.msgpack.Encoder().encode\n": """\


def _encode(record):
    plain = msgspec.to_builtins(record, builtin_types=(bytes,))
    for row in plain.get("rows", ()):
        row[2] = [[*read, 1] for read in row[2]]
        row.append({"later": 1})
    return msgspec.msgpack.encode(_grown(plain))


def _grown(part):
    if isinstance(part, dict):
        grown = {key: _grown(value) for key, value in part.items() if key != "reasons"}
        return {"later": [1]} | part | grown
    return [_grown(item) for item in part] if isinstance(part, list | tuple) else part
"""
        },
    )
    newer.swap(
        "recording/state.py",
        {
            "    layout: int = 0  # `LAYOUT` of the version that wrote it\n": """\
    layout: int = 0
    later: int = 1
"""
        },
    )

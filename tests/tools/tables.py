"""Writes the generated pages, and parts of others, of the router's and of the bridge's file. In a
release it also writes the public names.

`python -m tests.tools.tables` writes them, and `tests/test_tables.py` compares them.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

from acsard import __version__
from acsard.core.config.settings import Config
from acsard.core.messages.keys_and_roles import (
    PUBLISHED,
    TOPICS,
    Topic,
    full_key,
    json_key,
    source_keys,
)
from acsard.core.messages.permissions import (
    COMMAND_ROLE,
    USES,
    Use,
    has,
    keys_for,
)
from acsard.core.ros.transports import ros_names
from acsard.core.values import ROLES, Role
from acsard.machine.router_file import EXAMPLE_ROBOT
from tests.tools.interface import file_of_release
from tests.tools.reference import GENERATED, ros, table

ROOT = Path(__file__).parents[2]


# the tables of the pages


def keytable() -> str:
    return table(
        ("key", "direction", "least role", "type", "rate", "meaning"),
        ((f"`{t.key}`", t.direction, _least(t), t.type, t.rate, t.note) for t in TOPICS),
    )


def _least(topic: Topic) -> str:
    if topic.local:
        return "on the robot"
    if topic.query == "<role>":
        return "that role"
    return topic.publish or topic.query or topic.subscribe or ""


# the router's file

RULES: dict[tuple[Role, Use], str] = {
    ("viewer", "subscribe"): "see",
    ("viewer", "query"): "see",
    ("viewer", "publish"): "stop",
    ("operator", "query"): "operate",
    ("operator", "publish"): "slow",
    ("maintainer", "query"): "keep",
    ("maintainer", "publish"): "sense",
}
"""The rule of `router.json5` that grants the keys of a role for a use.

A key of another role and use needs a new rule there and a row here.
"""


def router_file(text: str) -> str:
    """Return the router's configuration: keys of each access rule, and rules of each role."""
    for rule, keys in _rule_keys().items():
        lines = "".join(f'          "{key}",\n' for key in keys)
        text = _replaced(
            rf'(^ *id: "{rule}",\n(?:(?! *id: ).*\n)*? *key_exprs: \[\n(?: *// ROBOT\n)?)'
            r'(?: *"[^"\n]*",\n)*',
            lines,
            text,
        )
    for role in ROLES:
        rules = [rule for (least, _), rule in RULES.items() if has(role, least)]
        names = " ".join(f'"{rule}-{EXAMPLE_ROBOT}",' for rule in dict.fromkeys(rules))
        text = _replaced(
            rf'(^ *subjects: \["{role}s"\],\n *rules: \[\n.*\n *// ROBOT\n).*\n',
            f"          {names}\n",
            text,
        )
    return text


def _rule_keys() -> dict[str, list[str]]:
    followed = [key for topic in PUBLISHED for key in (topic.key, json_key(topic.key))]
    rules = {"hear": [full_key("*", key) for key in followed]}
    # The samples of a gyro go from a client to its robot only, never to other clients.
    rows = [row for row in TOPICS if row.direction != "in"]
    for role in ROLES:
        for use in USES:
            keys = keys_for(role, use, TOPICS if use == "publish" else rows)
            if keys:
                rule = rules.setdefault(f"{RULES[role, use]}-{EXAMPLE_ROBOT}", [])
                rule += [full_key(EXAMPLE_ROBOT, key) for key in keys]
    own = [row.pattern for row in TOPICS if not row.local and "<key>" not in row.key]
    own += [json_key(topic.key) for topic in PUBLISHED]
    rules[f"own-{EXAMPLE_ROBOT}"] = [full_key(EXAMPLE_ROBOT, key) for key in own]
    sources = [source.name for source in Config().commands.sources]
    for role in ROLES:
        if has(role, COMMAND_ROLE):
            keys = source_keys(sources, role)
            rules[f"commands of {role}"] = [full_key(EXAMPLE_ROBOT, key) for key in keys]
    return {rule: list(dict.fromkeys(keys)) for rule, keys in rules.items()}


# the file of the bridge


def bridge_file(text: str) -> str:
    """Return the bridge's configuration with the ROS names of the daemon."""
    names = ros_names()
    lists = {
        "publishers": [row.name for row in names if row.direction == "in"],
        "subscribers": [row.name for row in names if row.direction == "out"],
        "service_clients": [row.name for row in names if row.direction in ("service", "query")],
    }
    for kind, rows in lists.items():
        lines = "".join(f'          "/{name}",\n' for name in dict.fromkeys(rows))
        text = _replaced(rf'(^ *{kind}: \[\n)(?: *"[^"\n]*",\n)*', lines, text)
    return text


# all files


def _marked(mark: str, table: str) -> Callable[[str], str]:
    """Return a function that replaces the table below this mark in a page's text."""
    return lambda text: _replaced(rf"(^<!-- {mark}: .* -->\n)(?:\|.*\n)*", table, text)


def _whole(write: Callable[[], str]) -> Callable[[str], str]:
    return lambda _: write()


def _replaced(pattern: str, part: str, text: str) -> str:
    """Replace the only match of the pattern by its first group followed by `part`."""
    changed, count = re.subn(pattern, lambda match: match[1] + part, text, flags=re.M)
    assert count == 1, f"{count} places match {pattern}"
    return changed


FILES: dict[str, Callable[[str], str]] = {
    "deploy/manual/pages/reference/keys.md": _marked("keys", keytable()),
    "deploy/manual/pages/reference/ros.md": _marked("names", ros()),
    "deploy/ros2/zenoh-bridge-ros2dds.json5": bridge_file,
    "deploy/zenoh/router.json5": router_file,
    **{name: _whole(write) for name, write in GENERATED.items()},
}
if ".dev" not in __version__:
    FILES[f"tests/vectors/interface/{__version__}.txt"] = _whole(file_of_release)
"""Maps each file to the function that writes its generated parts again."""


if __name__ == "__main__":
    for name, write in FILES.items():
        file = ROOT / name
        file.write_text(write(file.read_text() if file.exists() else ""))

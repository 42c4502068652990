"""Writes the router's configuration for a fleet, from `deploy/zenoh/router.json5` for one robot.

The lines between the marks ROBOT and END are repeated for each robot. Those between PERSON and END
PERSON are repeated for each certificate that may command. The module edits the file as text.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Mapping, Sequence

from acsard.host.errors import UsageError
from acsard.values import ROLES, Role

EXAMPLE = "robot1"
"""Id of the robot in the template."""

IS_FOR = "// It is for {}. For yours:\n"
"""Line at the head of the template."""

_BLOCK = re.compile(r"^ *// ROBOT\n(.*?)^ *// END\n", re.M | re.S)
_NAME = re.compile(rf"\b{EXAMPLE}\b")

PERSON: Role = "operator"
"""Common name in the template's lines for a person."""

_PERSONS = re.compile(r"^ *// PERSON\n(.*?)^ *// END PERSON\n", re.M | re.S)
# Match a whole name, or the last part of a key, because a robot may be called operator-1.
_PERSON = re.compile(rf'(?<=[/" ]){PERSON}(?=")')


def router_file(template: str, robots: Sequence[str], people: Mapping[Role, Sequence[str]]) -> str:
    """Return the configuration for these robots and for the further certificates of people.

    `people` maps a role to the common names of further certificates. Raises `UsageError` for a name
    that occurs twice, because a certificate belongs to one robot or to one role.
    """
    names = [*robots, *ROLES, *(name for role in ROLES for name in people.get(role, ()))]
    twice = [name for name, count in Counter(names).items() if count > 1]
    if twice:
        raise UsageError(
            f"{', '.join(twice)}: there twice; a certificate is one robot's, or in the list of one "
            f"role, and {', '.join(ROLES)} are in theirs"
        )
    # The replacement is a function, since an id or a name may look like a reference to a group.
    text = _BLOCK.sub(lambda block: "".join(_for(one, block[1]) for one in robots), template)
    text = text.replace(IS_FOR.format(EXAMPLE), IS_FOR.format(", ".join(robots)))
    for role in ROLES:
        listed = ", ".join(json.dumps(name) for name in (role, *people.get(role, ())))
        alone = _SUBJECT.format(f"{role}s", f'"{role}"')
        text = text.replace(alone, _SUBJECT.format(f"{role}s", listed))
    # The template has lines for the certificate "maintainer" as well as for "operator".
    drivers = [PERSON, *people.get("operator", ()), *people.get("maintainer", ())]
    return _PERSONS.sub(lambda block: "".join(_by(one, block[1]) for one in drivers), text)


_SUBJECT = 'id: "{}", link_protocols: ["tls"], cert_common_names: [{}]'


def _by(person: str, block: str) -> str:
    return _PERSON.sub(lambda _: json.dumps(person)[1:-1], block)


def _for(robot: str, block: str) -> str:
    return _NAME.sub(lambda _: robot, block)

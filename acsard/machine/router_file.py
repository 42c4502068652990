"""Makes the configuration file of a fleet's router.

It repeats lines of `deploy/zenoh/router.json5`, the template for one robot: those between ROBOT and
END for each robot, and those between PERSON and END PERSON for each certificate that may command.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Mapping, Sequence

from acsard.core.values import ROLES, Role
from acsard.host.errors import UsageError

EXAMPLE_ROBOT = "robot1"  # id in the template

# The ids of the robots replace {}.
ROBOTS_COMMENT = "// This file is for {}. To make a file for your own robots:\n"

_BLOCK = re.compile(r"^ *// ROBOT\n(.*?)^ *// END\n", re.M | re.S)
_NAME = re.compile(rf"\b{EXAMPLE_ROBOT}\b")

EXAMPLE_OPERATOR: Role = "operator"  # the common name of a certificate that may command replaces it

_PERSONS = re.compile(r"^ *// PERSON\n(.*?)^ *// END PERSON\n", re.M | re.S)
# Match a whole name or the last part of a key, but not the beginning of a robot's id "operator-1".
_PERSON = re.compile(rf'(?<=[/" ]){EXAMPLE_OPERATOR}(?=")')


def router_file(template: str, robots: Sequence[str], people: Mapping[Role, Sequence[str]]) -> str:
    """Return the text of the router's file. Raises `UsageError` if a name occurs twice.

    `people` are the common names of each role, without those of the name of their role.
    """
    names = [*robots, *ROLES, *(name for role in ROLES for name in people.get(role, ()))]
    twice = [name for name, count in Counter(names).items() if count > 1]
    if twice:
        raise UsageError(
            f"these names occur more than once: {', '.join(twice)}. Name each certificate once, "
            "either as a robot or in the list of one role. Leave out the names "
            f"{', '.join(ROLES)}: these certificates have their roles already"
        )
    text = _BLOCK.sub(
        lambda block: "".join(_with(_NAME, robot, block[1]) for robot in robots), template
    )
    text = text.replace(
        ROBOTS_COMMENT.format(EXAMPLE_ROBOT), ROBOTS_COMMENT.format(", ".join(robots))
    )
    for role in ROLES:
        listed = ", ".join(json.dumps(name) for name in (role, *people.get(role, ())))
        template_list = _SUBJECT.format(f"{role}s", f'"{role}"')
        text = text.replace(template_list, _SUBJECT.format(f"{role}s", listed))
    # The template has separate lines for the certificate "maintainer", which may command too.
    commanders = [EXAMPLE_OPERATOR, *people.get("operator", ()), *people.get("maintainer", ())]
    names = [json.dumps(name)[1:-1] for name in commanders]
    return _PERSONS.sub(
        lambda block: "".join(_with(_PERSON, name, block[1]) for name in names), text
    )


# Lists the certificates of a role.
_SUBJECT = 'id: "{}", link_protocols: ["tls"], cert_common_names: [{}]'


def _with(pattern: re.Pattern[str], name: str, block: str) -> str:
    # The replacement is a function, because a name may look like a reference to a group.
    return pattern.sub(lambda _: name, block)

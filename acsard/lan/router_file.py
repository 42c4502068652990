"""The router's configuration for a fleet: `deploy/zenoh/router.json5`, which is for one robot, for
as many as there are, and for the people who may be let in.

What stands between the marks ROBOT and END is repeated; the words are those of the file.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Mapping, Sequence

from acsard.host.errors import UsageError
from acsard.values import ROLES, Role

EXAMPLE = "robot1"
"""The robot that the file is for as it is."""

IS_FOR = "// It is for {}. For yours:\n"
"""What its head says."""

_BLOCK = re.compile(r"^ *// ROBOT\n(.*?)^ *// END\n", re.M | re.S)
_NAME = re.compile(rf"\b{EXAMPLE}\b")


def router_file(template: str, robots: Sequence[str], people: Mapping[Role, Sequence[str]]) -> str:
    """For these ids, and these certificates of people beside the one that each role has.

    Raises `UsageError` for a name that is there twice: a certificate has one place.
    """
    names = [*robots, *ROLES, *(name for role in ROLES for name in people.get(role, ()))]
    twice = [name for name, count in Counter(names).items() if count > 1]
    if twice:
        raise UsageError(
            f"{', '.join(twice)}: there twice; a certificate is one robot's, or in the list of one "
            f"role, and {', '.join(ROLES)} are in theirs"
        )
    # A function, since an id or a name may look like a reference to a group.
    text = _BLOCK.sub(lambda block: "".join(_for(one, block[1]) for one in robots), template)
    text = text.replace(IS_FOR.format(EXAMPLE), IS_FOR.format(", ".join(robots)))
    for role in ROLES:
        listed = ", ".join(json.dumps(name) for name in (role, *people.get(role, ())))
        text = text.replace(f'cert_common_names: ["{role}"]', f"cert_common_names: [{listed}]")
    return text


def _for(robot: str, block: str) -> str:
    return _NAME.sub(lambda _: robot, block)

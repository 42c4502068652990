"""The router's configuration for a fleet: `deploy/zenoh/router.json5`, which is for one robot, for
as many as there are, and for the people who may be let in.

The lines between the marks ROBOT and END are repeated for each robot, those between PERSON and END
PERSON for each certificate that commands. The words are those of the file.
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

PERSON: Role = "operator"
"""The certificate that the lines of a person are for as they are."""

_PERSONS = re.compile(r"^ *// PERSON\n(.*?)^ *// END PERSON\n", re.M | re.S)
# As a whole name, or as the last chunk of a key: a robot may be called operator-1.
_PERSON = re.compile(rf'(?<=[/" ]){PERSON}(?=")')


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
        alone = _SUBJECT.format(f"{role}s", f'"{role}"')
        text = text.replace(alone, _SUBJECT.format(f"{role}s", listed))
    # The lines of the certificate "maintainer" are in the file beside those of "operator".
    drivers = [PERSON, *people.get("operator", ()), *people.get("maintainer", ())]
    return _PERSONS.sub(lambda block: "".join(_by(one, block[1]) for one in drivers), text)


_SUBJECT = 'id: "{}", link_protocols: ["tls"], cert_common_names: [{}]'


def _by(person: str, block: str) -> str:
    return _PERSON.sub(lambda _: json.dumps(person)[1:-1], block)


def _for(robot: str, block: str) -> str:
    return _NAME.sub(lambda _: robot, block)

"""What this process calls itself to a daemon whose services it calls."""

from __future__ import annotations

import os
import pwd
import sys
from pathlib import Path


def own_name() -> str:
    """Like `alice@laptop patrol`: the user, the machine, and the program if it has a name."""
    try:
        user = pwd.getpwuid(os.getuid()).pw_name
    except KeyError:
        user = str(os.getuid())
    machine = os.uname().nodename.partition(".")[0]
    path = Path(sys.argv[0])
    program = path.parent.name if path.stem == "__main__" else path.stem
    return f"{user}@{machine} {program.removeprefix('-c')}".rstrip()

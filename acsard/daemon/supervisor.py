"""Runs the process of the TLS gateway or of the web page, and restarts it.

One without signs of life is killed. systemd supervises a gateway that is a service, because only
systemd can set that service's limits.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence

from msgspec import Struct

from acsard.core.values import Event, EventName
from acsard.host.child import Child, acsard, how_it_ended
from acsard.host.errors import Exit
from acsard.host.threads import in_thread

LONG_RESTART_PAUSE_S = 2.0  # after an exit code above 1, or if the process could not be started


class Kind(Struct, frozen=True):
    """A kind of process, with its name in messages and the rules for its restart."""

    name: str
    ended: EventName  # event
    final: frozenset[int] = frozenset()  # exit codes without a restart
    restart_pause_s: float = 0.1  # or `LONG_RESTART_PAUSE_S`
    # Exit codes without a restart of the first process: later, a person may be changing its files.
    final_at_first: frozenset[int] = frozenset()
    remedy: str = ""  # advice after a final exit code


# Always restarted: a person may correct its files while the robot drives.
GATEWAY = Kind("the TLS gateway", "gateway_ended")

# It reports itself why it ends. It is final if a person ends it, another program has its port, or
# its files are bad at first. Starts must not take time from the robot, so the pause is long.
PAGE = Kind(
    "the robot's page",
    "page_ended",
    final=frozenset({Exit.OK, Exit.IN_USE}),
    restart_pause_s=LONG_RESTART_PAUSE_S,
    final_at_first=frozenset({Exit.USAGE, Exit.NO_PERMISSION, Exit.BAD_CONFIG}),
    remedy="to serve the page again, run `acsard web` or restart the daemon",
)


async def keep_running(words: Sequence[str], log: Callable[[Event], None], kind: Kind) -> int:
    """Run `acsard` with these arguments, and restart it until cancelled.

    Return an exit code that `kind` declares final. Each end is an event, with the remedy if it is
    final.
    """
    final = kind.final | kind.final_at_first
    while True:
        child = Child(acsard(*words, "--supervised"))
        try:
            code = await in_thread(child.run, None)
            why = child.silent or how_it_ended(code)
        # The system could not start another process or thread.
        except (OSError, RuntimeError) as error:
            code, why = Exit.USAGE, f"could not be started ({error})"
        else:
            if code in final:
                text = f"{kind.name} {why}; it is not restarted: {kind.remedy}"
                log(Event(kind.ended, text, "warning"))
                return code
            final = kind.final
        finally:
            child.release()
        log(Event(kind.ended, f"{kind.name} {why}; it is restarted", "warning"))
        await asyncio.sleep(kind.restart_pause_s if code <= Exit.FAILURE else LONG_RESTART_PAUSE_S)

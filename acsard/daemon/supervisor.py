"""Runs the process of the TLS gateway or of the web page, and restarts it.

A process that sends no signs of life is killed and started again. If the gateway runs as a service,
systemd supervises it instead (`acsard-gateway.service`), because only systemd can set the limits of
that service.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence

from msgspec import Struct

from acsard.core.values import Event, EventName
from acsard.host.child import Child, acsard, how_it_ended
from acsard.host.errors import Exit
from acsard.host.threads import in_thread

LONG_RESTART_PAUSE_S = 2.0
"""Longer pause before a restart, s. It applies if the process has ended with an exit code above 1,
or could not be started."""


class Kind(Struct, frozen=True):
    """A kind of process, with its name in messages and the rules for its restart."""

    name: str
    ended: EventName
    """Name of the log event that reports the end of the process."""
    final: frozenset[int] = frozenset()
    """Exit codes after which the process is not started again."""
    restart_pause_s: float = 0.1
    """Pause before a restart, s.

    After an exit code above 1 the pause is `LONG_RESTART_PAUSE_S` instead.
    """
    final_at_first: frozenset[int] = frozenset()
    """Exit codes after which the first process of this kind is not started again. A later process
    is, because a person may be changing its files."""
    remedy: str = ""
    """Advice on how to start the process again after a final exit code, for the log event."""


GATEWAY = Kind("the TLS gateway", "gateway_ended")
"""The TLS gateway. It is always restarted, because a person may correct its files while the robot
drives."""

PAGE = Kind(
    "the robot's page",
    "page_ended",
    final=frozenset({Exit.OK, Exit.IN_USE}),
    restart_pause_s=LONG_RESTART_PAUSE_S,
    final_at_first=frozenset({Exit.USAGE, Exit.NO_PERMISSION, Exit.BAD_CONFIG}),
    remedy="to serve the page again, run `acsard web` or restart the daemon",
)
"""The process of the web page, which itself reports why it ends.

The page is not started again in three cases: a person ends it, another program uses its port, or
its files are unusable at the first start. The pause before a restart is longer, because repeated
starts must not take processor time from the robot."""


async def keep_running(words: Sequence[str], log: Callable[[Event], None], kind: Kind) -> int:
    """Run `acsard` with the arguments `words`, and restart it whenever it ends.

    If the process ends with an exit code that `kind` declares final, do not restart it, but return
    this code. Otherwise run until this task is cancelled. `log` is called with an event whenever
    the process ends. The event says whether the process is restarted, and if not, the remedy.
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

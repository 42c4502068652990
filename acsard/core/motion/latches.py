"""Adds causes to the latches, releases them, and describes them."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from msgspec.structs import replace

from acsard.core.codes import Reason, reason
from acsard.core.formatting import utc
from acsard.core.tables.stop_codes import StopCode
from acsard.core.values import Cause, CauseKind, Latches, WallNs

# A flood of stops by many clients must not fill the memory, and no stop may be forgotten. The last
# place is one cause, with a new number for each further stop: a `clear` that was shown an older
# number does not release it.
MAX_CAUSES = 32

OTHERS: StopCode = "stopped_by_others"

NAMELESS = "request"  # in a text, a client that has no name


def latched(
    latches: Latches, kind: CauseKind, why: Reason, wall_ns: WallNs, by: str = ""
) -> Latches:
    """Return the latches with a new cause, which replaces an equal one: a caller has one stop."""
    new = Cause(latches.last + 1, kind, why.code, why.text, why.part, by, wall_ns)
    causes = [*[cause for cause in latches.causes if not _equal(cause, new)], new]
    named = [cause for cause in causes if cause.code != OTHERS]
    by_clients = [cause for cause in named if cause.code == "stopped"]
    if len(named) < MAX_CAUSES or not by_clients:
        return Latches(tuple(causes), new.number)
    named.remove(by_clients[-1])
    why, number = reason(OTHERS, by=by_clients[-1].by or NAMELESS), new.number + 1
    return Latches((*named, Cause(number, "stop", why.code, why.text, at_ns=wall_ns)), number)


def stopped(latches: Latches, by: str, wall_ns: WallNs) -> Latches:
    """Return the latches with a stop by a client."""
    return latched(latches, "stop", reason("stopped", by=by or NAMELESS), wall_ns, by)


def released(latches: Latches, numbers: Collection[int]) -> Latches:
    """Return the latches without the causes that have these numbers."""
    remaining = tuple([cause for cause in latches.causes if cause.number not in numbers])
    return replace(latches, causes=remaining)


def after_restart(latches: Latches) -> Latches:
    """Return the latches for the next run of the daemon, each cause with `kept`."""
    kept = tuple([replace(cause, kept=True) for cause in latches.causes])
    return replace(latches, causes=kept)


def is_latched(why: Reason, causes: Sequence[Cause]) -> bool:
    """Return whether one of these causes has this reason."""
    return any(cause.code == why.code and cause.part == why.part for cause in causes)


def describe(cause: Cause) -> str:
    """Return why and when a cause was latched."""
    when = f"at {utc(cause.at_ns)}{', before the restart' if cause.kept else ''}"
    if _asked_for(cause):
        return f"{'was ' if cause.kept else ''}{cause.text} {when}"
    return f"{cause.text} (latched {when})"


def in_force(causes: Sequence[Cause]) -> str:
    """Return what holds the robot, for "the robot is still ..."."""
    faults = [cause.text for cause in causes if cause.kind == "fault"]
    texts = [f"in fault ({'; also '.join(faults)})"] if faults else []
    texts += [
        cause.text if _asked_for(cause) else f"stopped ({cause.text})"
        for cause in causes
        if cause.kind != "fault"
    ]
    return " and ".join(texts)


def _equal(one: Cause, other: Cause) -> bool:
    if one.kind == other.kind == "inactive":
        return True
    return (one.kind, one.code, one.part, one.by) == (other.kind, other.code, other.part, other.by)


def _asked_for(cause: Cause) -> bool:
    return cause.code in ("stopped", OTHERS, "switched_off")  # by a client

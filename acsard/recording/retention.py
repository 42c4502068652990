"""Decides which recordings are deleted and which are retained.

It also decides whether the wall clock can tell their age.

The recordings of incidents, and those within a minute of one, are deleted last. Other programs use
the disk too, so a part of it is left to them. If they have used up that part, unprotected
recordings other than the newest are deleted. The rest is deleted only when there would soon be no
room to record at all.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Generic, Literal, NamedTuple, TypeVar

from msgspec import Struct

from acsard.core.values import NS_PER_S, Instant

File = TypeVar("File")

Kind = Literal["plain", "near", "kept"]
"""Retention class: `kept` had an incident in it, `near` was written within a minute of one."""

AROUND_NS = 60 * NS_PER_S
"""Time before and after an incident within which recordings are retained."""

KEPT_FILES = 50
"""Number of the newest recordings with an incident that are retained, with those near them."""

FILES = 100
"""A file may have the 100th part of all bytes, so the retained ones are about half of the total."""

LEAST_BYTES = 100_000
"""Size that a file may have even on a small disk, in bytes."""

SPARE = 0.05
SPARE_BYTES = 1_000_000_000
"""Share of the disk that is left to other programs, and its upper bound in bytes."""

NEEDED = 0.2
"""Share of the spare room, below which there would soon be no room to record at all."""

JUMP_NS = 60 * NS_PER_S
"""A change of the wall clock against the monotonic clock above which it counts as set."""

STEADY_NS = 600 * NS_PER_S
"""Time without a step of the wall clock after which it may tell the age of a recording."""


class Disk(NamedTuple):
    """Size and free space of a disk, in bytes."""

    total: int
    free: int

    @property
    def spare(self) -> int:
        """Bytes that are left to other programs."""
        return min(int(self.total * SPARE), SPARE_BYTES)

    @property
    def low(self) -> bool:
        """True if other programs have less than the room left to them."""
        return self.free < self.spare


class Ended(NamedTuple):
    """A finished recording."""

    name: str
    number: int
    kind: Kind
    size: int
    """Size in bytes."""
    at_s: float
    """Time at which it ended, s since 1970, by the wall clock of that time."""
    here: bool = False
    """True if it ended in this run of the daemon. Such a file never counts as too old."""


class Bounds(NamedTuple):
    """Bounds for all recordings together."""

    size: int
    """Largest total size in bytes."""
    oldest_s: float
    """Recordings that ended before this time are too old, s since 1970; -inf without a clock."""


def share(bound: int, own: int, disk: Disk) -> int:
    """Return the largest size of one file in bytes.

    `bound` is the largest total size of all recordings, and `own` their present size.
    """
    return max(LEAST_BYTES, min(bound, own + disk.free - disk.spare) // FILES)


def too_much(
    ended: Sequence[Ended], bounds: Bounds, disk: Disk, given: int | None = None
) -> set[str]:
    """Return the names of the recordings to delete.

    `ended` is in the order of their numbers. One more file must fit afterwards. `given` is None
    unless the disk refuses to write, whatever free space it reports. Then it is the number of bytes
    that were deleted for that disk without success:
    - With 0, at least one recording is deleted.
    - Above 0 but below `LEAST_BYTES`, one more is deleted, but no protected one.
    - From `LEAST_BYTES` on, none is deleted for this reason.
    """
    stays = _protected(ended)
    plain = [one for one in ended if one.name not in stays]
    old = [one for one in plain if one.at_s < bounds.oldest_s and not one.here]
    gone = {one.name for one in old}
    own = sum(one.size for one in ended if one.name not in gone)
    free = disk.free + sum(one.size for one in old)
    most = bounds.size - share(bounds.size, own, disk)
    needed = int(disk.spare * NEEDED)
    for one in plain + [one for one in ended if one.name in stays]:
        if one.name in gone:
            continue
        gives_way = one.name not in stays and one is not ended[-1]
        refused = given is not None and not gone
        helps = not given or (one.name not in stays and given < LEAST_BYTES)
        if own > most or free < (disk.spare if gives_way else needed) or (refused and helps):
            gone.add(one.name)
            own, free = own - one.size, free + one.size
    return gone


def _protected(ended: Sequence[Ended]) -> set[str]:
    """Return the names of the newest recordings with an incident, and of those near them."""
    last = {one.name for one in [one for one in ended if one.kind == "kept"][-KEPT_FILES:]}
    return {
        one.name
        for run in _runs(ended)
        if any(one.name in last for one in run)
        for one in run
        if one.kind == "near" or one.name in last
    }


def _runs(ended: Sequence[Ended]) -> Iterator[list[Ended]]:
    """Yield the groups of recordings that are not plain and have consecutive numbers."""
    run: list[Ended] = []
    for one in ended:
        if one.kind == "plain":
            continue
        if run and one.number - run[-1].number > 1:
            yield run
            run = []
        run.append(one)
    yield run


class Steady(Struct):
    """Watch over the wall clock, which can be believed if it was not set for a while."""

    _since_ns: int | None = None
    """Monotonic time since which the wall clock was not set, ns; None before the first look."""
    _ahead_ns: int = 0
    """Offset of the wall clock from the monotonic clock at the last look, ns."""

    def look(self, now: Instant) -> int:
        """Return how far the wall clock was set since the last look, ns; 0 if it was not set."""
        ahead_ns = now.wall_ns - now.mono_ns
        jumped_ns = 0 if self._since_ns is None else ahead_ns - self._ahead_ns
        self._ahead_ns = ahead_ns
        if self._since_ns is None or abs(jumped_ns) > JUMP_NS:
            self._since_ns = now.mono_ns
            return jumped_ns
        return 0

    def believed(self, now: Instant) -> bool:
        """Return whether the wall clock was watched, and not set, for `STEADY_NS`."""
        return self._since_ns is not None and now.mono_ns - self._since_ns >= STEADY_NS


class Around(Generic[File]):
    """Retention of recording files around incidents, decided in the order in which the files end.

    All times are ns of the monotonic clock.
    """

    def __init__(self) -> None:
        self.kind: Kind = "plain"
        """Retention class of the file that is being written."""
        self._recent: list[tuple[File, int]] = []
        """Plain files that ended less than a minute ago, each with its end time."""
        self._happened_ns = -AROUND_NS

    def begin(self, now_ns: int) -> None:
        """Register the beginning of a new file at `now_ns`."""
        self.kind = "near" if now_ns - self._happened_ns < AROUND_NS else "plain"

    def happened(self, now_ns: int) -> list[File]:
        """Retain the current file because of an incident at `now_ns`.

        Returns the earlier files to retain as well, which ended less than a minute before the
        incident.
        """
        self.kind, self._happened_ns = "kept", now_ns
        close = [file for file, ended_ns in self._recent if now_ns - ended_ns < AROUND_NS]
        self._recent.clear()
        return close

    def end(self, file: File, last_ns: int) -> None:
        """Register the end of the current file as `file`, with its last step at `last_ns`."""
        self._recent = [(one, ns) for one, ns in self._recent if last_ns - ns < AROUND_NS]
        if self.kind == "plain":
            self._recent.append((file, last_ns))

    def earlier(self, file: File, kind: Kind, ended_ns: int) -> None:
        """Take over a file that the previous run of the daemon has finished."""
        if kind == "plain":
            self._recent.append((file, ended_ns))
        elif kind == "kept":
            self.earlier_happened(ended_ns)

    def earlier_happened(self, at_ns: int) -> None:
        """Take over the time of an earlier incident, such as the crash of the previous run."""
        self._happened_ns = max(self._happened_ns, at_ns)

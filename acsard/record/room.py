"""Which recordings go, so that there is room for the next ones, and when a clock tells their age.

What is kept for what happened in it goes last. A disk also has others on it: a part of it is left
to them, and where they have taken that too, only what would be overwritten soon gives way.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Literal, NamedTuple

from msgspec import Struct

from acsard.values import NS_PER_S, Instant

Kind = Literal["plain", "near", "kept"]
"""`kept`: something happened in it; `near`: close to that."""

AROUND_NS = 60 * NS_PER_S
"""Before and after something that happened, what is near to it."""

KEPT_FILES = 50
"""So many of those in which something happened stay, the newest, with what is near to them."""

FILES = 100
"""A file may have this part of all bytes: what is kept is about half."""

LEAST_BYTES = 100_000
"""A file may have as many, however small the disk is."""

SPARE = 0.05
SPARE_BYTES = 1_000_000_000
"""The part of a disk that is left to others, and how much of a large one."""

NEEDED = 0.2
"""Of what is left to others: with less than that there soon is no room to record at all."""

JUMP_NS = 60 * NS_PER_S
"""A wall clock that went so far from the other one has been set."""

STEADY_NS = 600 * NS_PER_S
"""So long it must not have been set before it tells the age of anything."""


class Disk(NamedTuple):
    """bytes."""

    total: int
    free: int

    @property
    def spare(self) -> int:
        """What is left to others."""
        return min(int(self.total * SPARE), SPARE_BYTES)

    @property
    def low(self) -> bool:
        """Others have less than what is left to them."""
        return self.free < self.spare


class Ended(NamedTuple):
    """A recording that is finished."""

    name: str
    number: int
    kind: Kind
    size: int
    """bytes."""
    at_s: float
    """When it ended, s since 1970, by the clock of then."""
    here: bool = False
    """In this run of the daemon: however old it looks, it is not."""


class Bounds(NamedTuple):
    """What all of them may have."""

    size: int
    """bytes."""
    oldest_s: float
    """What ended before is too old, s since 1970; -inf where no clock tells."""


def share(bound: int, own: int, disk: Disk) -> int:
    """bytes of one file, where all may have `bound`, and have `own` now."""
    return max(LEAST_BYTES, min(bound, own + disk.free - disk.spare) // FILES)


def too_much(
    ended: Sequence[Ended], bounds: Bounds, disk: Disk, given: int | None = None
) -> set[str]:
    """The names of those that go, of all that ended, by their numbers.

    There is to be room for one file more. `given` is of a disk that took nothing any more, whatever
    it says of its room: at least one goes. It is how many bytes went for that before, in vain: then
    none goes that is kept, and none at all beyond what any file may have.
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
    """The last in which something happened, and what is near to them."""
    last = {one.name for one in [one for one in ended if one.kind == "kept"][-KEPT_FILES:]}
    return {
        one.name
        for run in _runs(ended)
        if any(one.name in last for one in run)
        for one in run
        if one.kind == "near" or one.name in last
    }


def _runs(ended: Sequence[Ended]) -> Iterator[list[Ended]]:
    """Those that are not plain, as far as they follow on one another."""
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
    """Whether the wall clock is to be believed: it was not set for a while."""

    _since_ns: int | None = None
    """Monotonic."""
    _ahead_ns: int = 0
    """Of the monotonic clock."""

    def look(self, now: Instant) -> int:
        """How far it was set since the last look, ns; 0 where it was not."""
        ahead_ns = now.wall_ns - now.mono_ns
        jumped_ns = 0 if self._since_ns is None else ahead_ns - self._ahead_ns
        self._ahead_ns = ahead_ns
        if self._since_ns is None or abs(jumped_ns) > JUMP_NS:
            self._since_ns = now.mono_ns
            return jumped_ns
        return 0

    def believed(self, now: Instant) -> bool:
        """It was looked at, and not set, for long enough."""
        return self._since_ns is not None and now.mono_ns - self._since_ns >= STEADY_NS

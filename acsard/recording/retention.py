"""Decides which recordings are deleted, and which are retained because of an incident.

A recording is protected if an incident, such as a fault, happened in it or within a minute of it.
`Disk.spare` is the free space that recordings leave to other programs. If less than that is free,
old unprotected recordings are deleted, but not the newest recording. Protected recordings and the
newest recording are deleted only if less than a fifth of `Disk.spare` is free, or if the limit on
the total size is exceeded.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Generic, Literal, NamedTuple, TypeVar

from msgspec import Struct

from acsard.core.values import NS_PER_S, Instant

File = TypeVar("File")

Kind = Literal["plain", "near", "kept"]
"""Retention class of a recording: an incident happened in it (`kept`), within a minute of it
(`near`), or neither (`plain`)."""

AROUND_NS = 60 * NS_PER_S
"""A recording is retained if it ended or began within this time of an incident, ns."""

KEPT_FILES = 50
"""Largest number of `kept` recordings that are protected."""

FILES = 100
"""The size limit of one file is the limit on the total size divided by this number. So 50 protected
files take about half of the total size."""

LEAST_BYTES = 100_000
"""Size to which a recording file may always grow, even if the disk is nearly full, bytes."""

SPARE = 0.05
"""Fraction of the disk's size that the recordings leave to other programs. On a large disk they
leave only `SPARE_BYTES`."""

SPARE_BYTES = 1_000_000_000
"""Largest space that the recordings leave to other programs, bytes. They leave less space only on a
disk of less than 20 GB."""

NEEDED = 0.2
"""If less than this fraction of `Disk.spare` is free, protected recordings are deleted too."""

JUMP_NS = 60 * NS_PER_S
"""Largest change of the wall clock that counts as a correction and not as a jump, ns. The change is
measured against the monotonic clock, between two calls of `ClockWatch.jump_ns()`."""

STEADY_NS = 600 * NS_PER_S
"""Time without a jump of the wall clock, ns, after which this clock may decide that a recording is
too old."""


class Disk(NamedTuple):
    """Size and free space of a disk, in bytes."""

    total: int
    free: int

    @property
    def spare(self) -> int:
        """Number of bytes that the recordings leave to other programs."""
        return min(int(self.total * SPARE), SPARE_BYTES)

    @property
    def low(self) -> bool:
        return self.free < self.spare


class Ended(NamedTuple):
    name: str
    number: int
    kind: Kind
    size: int
    """Size in bytes."""
    at_s: float
    """Wall-clock time at which the recording ended, s since 1970."""
    this_run: bool = False
    """True if the recording ended in this run of the daemon. It then never counts as too old."""


class Bounds(NamedTuple):
    """Limits of all recordings together."""

    size: int
    """Largest total size in bytes."""
    oldest_s: float
    """Recordings that ended before this time are too old, s since 1970. It is -inf if the wall
    clock is not trusted."""


def share(bound: int, own: int, disk: Disk) -> int:
    """Return how large one recording file may become, bytes.

    `bound` is the limit on the total size of all recordings. `own` is their present total size.
    """
    return max(LEAST_BYTES, min(bound, own + disk.free - disk.spare) // FILES)


def to_delete(
    ended: Sequence[Ended], bounds: Bounds, disk: Disk, freed: int | None = None
) -> set[str]:
    """Return the names of the recordings that must be deleted so that one more file fits.

    `ended` must be sorted by `Ended.number`. If the disk accepts data, `freed` is None. If it
    refuses to write, even though it may report free space, `freed` is the number of bytes that were
    deleted since its first refusal. The refusal has these consequences:

    - `freed` is 0: at least one recording is deleted, even if all of them are protected.
    - `freed` is less than `LEAST_BYTES`: at least one more unprotected recording is deleted.
    - `freed` is `LEAST_BYTES` or more: no recording is deleted because of the refusal.
    """
    protected = _protected(ended)
    plain = [file for file in ended if file.name not in protected]
    old = [file for file in plain if file.at_s < bounds.oldest_s and not file.this_run]
    names = {file.name for file in old}
    own = sum(file.size for file in ended if file.name not in names)
    free = disk.free + sum(file.size for file in old)
    most = bounds.size - share(bounds.size, own, disk)
    needed = int(disk.spare * NEEDED)
    for file in plain + [file for file in ended if file.name in protected]:
        if file.name in names:
            continue
        is_plain = file.name not in protected
        required = disk.spare if is_plain and file is not ended[-1] else needed
        must_free = freed is not None and not names
        may_help = not freed or (is_plain and freed < LEAST_BYTES)
        if own > most or free < required or (must_free and may_help):
            names.add(file.name)
            own, free = own - file.size, free + file.size
    return names


def _protected(ended: Sequence[Ended]) -> set[str]:
    """Return the names of the protected recordings.

    These are the `KEPT_FILES` newest `kept` recordings, and the `near` recordings in their groups
    (see `_groups`).
    """
    kept = {file.name for file in [file for file in ended if file.kind == "kept"][-KEPT_FILES:]}
    return {
        file.name
        for group in _groups(ended)
        if any(file.name in kept for file in group)
        for file in group
        if file.kind == "near" or file.name in kept
    }


def _groups(ended: Sequence[Ended]) -> Iterator[list[Ended]]:
    """Yield groups of recordings that are not `plain`. The numbers in a group are consecutive."""
    group: list[Ended] = []
    for file in ended:
        if file.kind == "plain":
            continue
        if group and file.number - group[-1].number > 1:
            yield group
            group = []
        group.append(file)
    yield group


class ClockWatch(Struct):
    """Detects jumps of the wall clock, and trusts the clock again `STEADY_NS` after a jump."""

    _since_ns: int | None = None
    """Monotonic time of the last jump, or of the first call of `jump_ns()` if there was no jump,
    ns. None before the first call."""
    _ahead_ns: int = 0
    """Offset of the wall clock from the monotonic clock at the last call of `jump_ns`, ns."""

    def jump_ns(self, now: Instant) -> int:
        """Return by how much the wall clock jumped since the last call, ns; 0 without a jump."""
        ahead_ns = now.wall_ns - now.mono_ns
        jumped_ns = 0 if self._since_ns is None else ahead_ns - self._ahead_ns
        self._ahead_ns = ahead_ns
        if self._since_ns is None or abs(jumped_ns) > JUMP_NS:
            self._since_ns = now.mono_ns
            return jumped_ns
        return 0

    def trusted(self, now: Instant) -> bool:
        """Return whether the wall clock was watched for `STEADY_NS` without a jump."""
        return self._since_ns is not None and now.mono_ns - self._since_ns >= STEADY_NS


class IncidentWindow(Generic[File]):
    """Finds the files that an incident protects. All times are monotonic, in ns.

    An incident protects the file in which it happens, and all files within a minute of it.
    """

    def __init__(self) -> None:
        self.kind: Kind = "plain"
        """Retention class of the file that is being written."""
        self._recent: list[tuple[File, int]] = []
        """Plain files that ended less than a minute ago, each with the time of its end, ns."""
        self._happened_ns = -AROUND_NS

    def begin(self, now_ns: int) -> None:
        """Register the beginning of a new file."""
        self.kind = "near" if now_ns - self._happened_ns < AROUND_NS else "plain"

    def happened(self, now_ns: int) -> list[File]:
        """Register an incident in the current file, which becomes `kept`.

        Returns the earlier plain files that the caller must retain too.
        """
        self.kind, self._happened_ns = "kept", now_ns
        close = [file for file, ended_ns in self._recent if now_ns - ended_ns < AROUND_NS]
        self._recent.clear()
        return close

    def end(self, file: File, last_ns: int) -> None:
        """Register the end of the current file; `last_ns` is the time of its last step."""
        self._recent = [(older, ns) for older, ns in self._recent if last_ns - ns < AROUND_NS]
        if self.kind == "plain":
            self._recent.append((file, last_ns))

    def earlier(self, file: File, kind: Kind, ended_ns: int) -> None:
        """Register a file of the previous run of the daemon, with the time of its end."""
        if kind == "plain":
            self._recent.append((file, ended_ns))
        elif kind == "kept":
            self.earlier_happened(ended_ns)

    def earlier_happened(self, at_ns: int) -> None:
        """Register the time of an incident or a crash in the previous run of the daemon."""
        self._happened_ns = max(self._happened_ns, at_ns)

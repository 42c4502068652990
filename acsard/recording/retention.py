"""Decides which recordings are deleted, and which are retained because of an incident.

An incident protects its recording, and those within a minute of it; only the newest
`MAX_KEPT_FILES` stay so. Unprotected ones go when they are too old and, the oldest first, while
less than `Disk.spare` is free. Protected ones and the newest go, too, below a fifth of it or above
the limit on the total size. If other programs alone fill the disk so far, deleting does not help,
and neither protected recordings nor this run's are deleted for it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Generic, Literal, NamedTuple, TypeVar

from msgspec import Struct

from acsard.core.values import NS_PER_S, Instant, Ns

File = TypeVar("File")

Kind = Literal["plain", "near", "kept"]  # kept: with an incident; near: within a minute of one

INCIDENT_MARGIN_NS = 60 * NS_PER_S

MAX_KEPT_FILES = 50  # the newest ones

# All recordings' space over this is the limit of a file: 50 protected ones take half of it.
FILES_PER_LIMIT = 100

MIN_FILE_BYTES = 100_000  # to which a file may always grow

SPARE_FRACTION = 0.05  # of the disk, free for other programs, but at most `MAX_SPARE_BYTES`

MAX_SPARE_BYTES = 1_000_000_000  # less on a disk of less than 20 GB

NEEDED_FRACTION = 0.2  # of `Disk.spare`, below which protected recordings go, too

# Largest change of the wall clock between two calls of `jump_ns()` that is no jump.
MAX_CORRECTION_NS = 60 * NS_PER_S

STEADY_CLOCK_NS = 600 * NS_PER_S  # without a jump, before recordings may be too old


class Disk(NamedTuple):
    """Size and free space of a disk, bytes."""

    total: int
    free: int

    @property
    def spare(self) -> int:
        """Bytes that recordings leave free for other programs."""
        return min(int(self.total * SPARE_FRACTION), MAX_SPARE_BYTES)

    @property
    def low(self) -> bool:
        return self.free < self.spare


class FinishedFile(NamedTuple):
    name: str
    number: int  # newer files have larger ones
    kind: Kind
    size: int  # bytes
    at_s: float  # end, s since 1970
    this_run: bool = False  # never too old


class Bounds(NamedTuple):
    size: int  # of all recordings, bytes
    oldest_s: float  # s since 1970; -inf if the wall clock is not trusted


def file_size_limit(bound: int, own: int, disk: Disk) -> int:
    """Return the size limit of one recording file, a fraction of what all may use, bytes.

    `bound` and `own` are the largest and the present total size, bytes.
    """
    return max(MIN_FILE_BYTES, min(bound, own + disk.free - disk.spare) // FILES_PER_LIMIT)


def to_delete(
    ended: Sequence[FinishedFile], bounds: Bounds, disk: Disk, freed: int | None = None
) -> set[str]:
    """Return the names of the recordings to delete so that one more file fits.

    `ended` is sorted by number. `freed` are the bytes deleted since the disk first refused a write,
    although it may report free space: 0 deletes at least one recording, less than `MIN_FILE_BYTES`
    an unprotected one if there is any, more has no effect.
    """
    protected = _protected(ended)
    plain = [file for file in ended if file.name not in protected]
    old = [file for file in plain if file.at_s < bounds.oldest_s and not file.this_run]
    names = {file.name for file in old}
    own = sum(file.size for file in ended if file.name not in names)
    free = disk.free + sum(file.size for file in old)
    most = bounds.size - file_size_limit(bounds.size, own, disk)
    needed = int(disk.spare * NEEDED_FRACTION)
    others_fill_disk = own + free < needed
    for file in plain + [file for file in ended if file.name in protected]:
        if file.name in names:
            continue
        is_plain = file.name not in protected
        required = disk.spare if is_plain and file is not ended[-1] else needed
        must_free = freed is not None and not names
        may_help = not freed or (is_plain and freed < MIN_FILE_BYTES)
        lacks_space = free < required or (must_free and may_help)
        stays = others_fill_disk and (file.this_run or not is_plain)
        if own > most or (lacks_space and not stays):
            names.add(file.name)
            own, free = own - file.size, free + file.size
    return names


def _protected(ended: Sequence[FinishedFile]) -> set[str]:
    # The newest `MAX_KEPT_FILES` kept ones, and the near ones in a run of numbers with one of them.
    kept = {file.name for file in [file for file in ended if file.kind == "kept"][-MAX_KEPT_FILES:]}
    return {
        file.name
        for group in _groups(ended)
        if any(file.name in kept for file in group)
        for file in group
        if file.kind == "near" or file.name in kept
    }


def _groups(ended: Sequence[FinishedFile]) -> Iterator[list[FinishedFile]]:
    group: list[FinishedFile] = []
    for file in ended:
        if file.kind == "plain":
            continue
        if group and file.number - group[-1].number > 1:
            yield group
            group = []
        group.append(file)
    yield group


class ClockWatch(Struct):
    """Detects jumps of the wall clock, which is trusted after `STEADY_CLOCK_NS` without one."""

    _since_ns: Ns | None = None  # last jump, or first `jump_ns()`
    _ahead_ns: Ns = 0  # wall clock minus monotonic clock at the last `jump_ns()`

    def jump_ns(self, now: Instant) -> Ns:
        """Return how far the wall clock was set forward since the last call; 0 for a correction."""
        ahead_ns = now.wall_ns - now.mono_ns
        jumped_ns = 0 if self._since_ns is None else ahead_ns - self._ahead_ns
        self._ahead_ns = ahead_ns
        if self._since_ns is None or abs(jumped_ns) > MAX_CORRECTION_NS:
            self._since_ns = now.mono_ns
            return jumped_ns
        return 0

    def trusted(self, now: Instant) -> bool:
        """Return whether the wall clock has not jumped for `STEADY_CLOCK_NS`."""
        return self._since_ns is not None and now.mono_ns - self._since_ns >= STEADY_CLOCK_NS


class IncidentWindow(Generic[File]):
    """Decides the retention class of each file while the daemon records."""

    def __init__(self) -> None:
        self.kind: Kind = "plain"  # of the file that is being written
        self._recent: list[tuple[File, int]] = []  # recent `plain` files, with their end
        self._happened_ns = -INCIDENT_MARGIN_NS  # last incident

    def begin(self, now_ns: Ns) -> None:
        self.kind = "near" if now_ns - self._happened_ns < INCIDENT_MARGIN_NS else "plain"

    def happened(self, now_ns: Ns) -> list[File]:
        """Register an incident, and return the `plain` files that must become `near`."""
        self.kind, self._happened_ns = "kept", now_ns
        close = [file for file, ended_ns in self._recent if now_ns - ended_ns < INCIDENT_MARGIN_NS]
        self._recent.clear()
        return close

    def end(self, file: File, last_ns: Ns) -> None:
        """Register the end of the current file, at its last step."""
        self._recent = [
            (older, ns) for older, ns in self._recent if last_ns - ns < INCIDENT_MARGIN_NS
        ]
        if self.kind == "plain":
            self._recent.append((file, last_ns))

    def earlier(self, file: File, kind: Kind, ended_ns: Ns) -> None:
        """Register a file of the previous run; a kept one has its incident at its end.

        After a restart of the computer, `ended_ns` may be negative.
        """
        if kind == "plain":
            self._recent.append((file, ended_ns))
        elif kind == "kept":
            self.earlier_happened(ended_ns)

    def earlier_happened(self, at_ns: Ns) -> None:
        """Register an incident or a crash in the previous run, by the present monotonic clock."""
        self._happened_ns = max(self._happened_ns, at_ns)

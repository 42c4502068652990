"""Decides which recordings are deleted, and which are retained because of an incident.

An incident, such as a fault, protects the recording in which it happened. It also protects
recordings that ended less than a minute before it, or began less than a minute after it. If more
than `MAX_KEPT_FILES` recordings contain an incident, only the newest of them stay protected.

- An unprotected recording is deleted when it is too old.
- Recordings leave some free space to other programs (`Disk.spare`). If less space is free,
  unprotected recordings are deleted, the oldest first, but not the newest recording.
- Protected recordings and the newest recording are deleted too if less than a fifth of `Disk.spare`
  is free, or if the recordings exceed the limit on their total size.
- If other programs fill the disk, less than a fifth of `Disk.spare` would be free even without any
  recordings. Deleting recordings does not help then, so protected recordings and recordings of this
  run of the daemon are not deleted to free disk space.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Generic, Literal, NamedTuple, TypeVar

from msgspec import Struct

from acsard.core.values import NS_PER_S, Instant

File = TypeVar("File")

Kind = Literal["plain", "near", "kept"]
"""Retention class of a recording.

- kept: An incident happened in the recording.
- near: An incident happened less than a minute before or after the recording.
- plain: No incident happened in the recording or near it.
"""

INCIDENT_MARGIN_NS = 60 * NS_PER_S
"""A recording is protected if it ended less than this time before an incident, or began less than
this time after the incident, ns."""

MAX_KEPT_FILES = 50
"""Largest number of `kept` recordings that are protected. If there are more, only the newest
recordings are protected."""

FILES_PER_LIMIT = 100
"""The size limit of one file is the space for all recordings, divided by this number. 50 protected
files then take about half of that space."""

MIN_FILE_BYTES = 100_000
"""Size to which a recording file may always grow, even if the disk is nearly full, bytes."""

SPARE_FRACTION = 0.05
"""Fraction of the disk's size that recordings leave free for other programs, but at most
`MAX_SPARE_BYTES`."""

MAX_SPARE_BYTES = 1_000_000_000
"""Largest space that recordings leave free for other programs, bytes. On a disk of less than 20 GB,
they leave the fraction `SPARE_FRACTION`, which is less."""

NEEDED_FRACTION = 0.2
"""Fraction of `Disk.spare`, the space that recordings leave free. If less than this fraction of
that space is free, protected recordings are deleted too."""

MAX_CORRECTION_NS = 60 * NS_PER_S
"""Largest change of the wall clock that counts as a correction and not as a jump, ns. The change is
measured against the monotonic clock, between two calls of `ClockWatch.jump_ns()`."""

STEADY_CLOCK_NS = 600 * NS_PER_S
"""Time without a jump of the wall clock, ns, after which the wall clock is trusted. Recordings are
deleted because of their age only while the clock is trusted."""


class Disk(NamedTuple):
    """Size and free space of a disk, in bytes."""

    total: int
    free: int

    @property
    def spare(self) -> int:
        """Number of bytes that recordings leave free for other programs."""
        return min(int(self.total * SPARE_FRACTION), MAX_SPARE_BYTES)

    @property
    def low(self) -> bool:
        """True if less than `spare` bytes are free."""
        return self.free < self.spare


class FinishedFile(NamedTuple):
    """A recording file that is finished."""

    name: str
    number: int
    """Number at the beginning of the file's name. Newer files have larger numbers."""
    kind: Kind
    size: int
    """Size in bytes."""
    at_s: float
    """Wall-clock time at which the recording ended, s since 1970."""
    this_run: bool = False
    """True if the recording ended in this run of the daemon. Such a recording never counts as too
    old."""


class Bounds(NamedTuple):
    """Limits on the total size and on the age of the recordings."""

    size: int
    """Largest total size of all recordings, bytes."""
    oldest_s: float
    """Wall-clock time, s since 1970. Recordings that ended earlier are too old. The time is -inf if
    the wall clock is not trusted."""


def file_size_limit(bound: int, own: int, disk: Disk) -> int:
    """Return the size limit of one recording file, bytes.

    The limit is a small fraction of the space that all recordings may use.

    Args:
        bound: the limit on the total size of all recordings, bytes.
        own: the present total size of all recordings, bytes.
        disk: the size and the free space of the disk.
    """
    return max(MIN_FILE_BYTES, min(bound, own + disk.free - disk.spare) // FILES_PER_LIMIT)


def to_delete(
    ended: Sequence[FinishedFile], bounds: Bounds, disk: Disk, freed: int | None = None
) -> set[str]:
    """Return the names of the recordings that must be deleted so that one more file fits.

    Args:
        ended: all finished recordings, sorted by `FinishedFile.number`.
        bounds: the limits on the total size and on the age.
        disk: the size and the free space of the disk.
        freed: None if the disk accepts data. If the disk refused the last write, the number of
            bytes that were deleted since the first refusal.

    A disk may refuse to write although it reports free space. So a refusal alone has these effects:

    - If `freed` is 0, at least one recording is deleted, even if all recordings are protected.
    - If `freed` is less than `MIN_FILE_BYTES`, at least one unprotected recording is deleted, if
      any exists.
    - If `freed` is `MIN_FILE_BYTES` or more, the refusal has no effect.

    If other programs fill the disk, neither the refusal nor the lack of free space is a reason to
    delete protected recordings and recordings of this run of the daemon.
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
    """Return the names of the protected recordings.

    These are the newest `MAX_KEPT_FILES` recordings of the class `kept`, and the `near` recordings
    in the same group as one of them. A group is a sequence of `kept` and `near` recordings with
    consecutive numbers.
    """
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
    """Detects jumps of the wall clock.

    The clock is trusted if it has not jumped for `STEADY_CLOCK_NS`.
    """

    _since_ns: int | None = None
    """Monotonic time of the last jump, ns. If there was no jump, the time of the first call of
    `jump_ns()`. None before this call."""
    _ahead_ns: int = 0
    """Wall-clock time minus monotonic time at the last call of `jump_ns()`, ns."""

    def jump_ns(self, now: Instant) -> int:
        """Return the size of a jump of the wall clock since the last call, ns.

        The result is positive if the clock was set forward, and negative if it was set back. It is
        0 at the first call, and if the clock changed by at most `MAX_CORRECTION_NS`.
        """
        ahead_ns = now.wall_ns - now.mono_ns
        jumped_ns = 0 if self._since_ns is None else ahead_ns - self._ahead_ns
        self._ahead_ns = ahead_ns
        if self._since_ns is None or abs(jumped_ns) > MAX_CORRECTION_NS:
            self._since_ns = now.mono_ns
            return jumped_ns
        return 0

    def trusted(self, now: Instant) -> bool:
        """Return whether `jump_ns()` has found no jump of the wall clock for `STEADY_CLOCK_NS`."""
        return self._since_ns is not None and now.mono_ns - self._since_ns >= STEADY_CLOCK_NS


class IncidentWindow(Generic[File]):
    """Decides the retention class of each file while the daemon records.

    An incident protects the file in which it happens. It also protects the files that ended less
    than a minute before the incident, or began less than a minute after it.
    """

    def __init__(self) -> None:
        self.kind: Kind = "plain"
        """Retention class of the file that is being written."""
        self._recent: list[tuple[File, int]] = []
        """Recent `plain` files, each with the monotonic time of its end, ns."""
        self._happened_ns = -INCIDENT_MARGIN_NS
        """Monotonic time of the last incident, ns."""

    def begin(self, now_ns: int) -> None:
        """Register the beginning of a new file, and set `kind` to its first retention class.

        `now_ns` is the present monotonic time, ns.
        """
        self.kind = "near" if now_ns - self._happened_ns < INCIDENT_MARGIN_NS else "plain"

    def happened(self, now_ns: int) -> list[File]:
        """Register an incident in the current file, at the monotonic time `now_ns`, ns.

        The current file becomes `kept`. Returns the `plain` files that ended less than a minute
        ago. The caller must give them the class `near`.
        """
        self.kind, self._happened_ns = "kept", now_ns
        close = [file for file, ended_ns in self._recent if now_ns - ended_ns < INCIDENT_MARGIN_NS]
        self._recent.clear()
        return close

    def end(self, file: File, last_ns: int) -> None:
        """Register the end of the current file.

        `last_ns` is the monotonic time of the last step in the file, ns.
        """
        self._recent = [
            (older, ns) for older, ns in self._recent if last_ns - ns < INCIDENT_MARGIN_NS
        ]
        if self.kind == "plain":
            self._recent.append((file, last_ns))

    def earlier(self, file: File, kind: Kind, ended_ns: int) -> None:
        """Register a file of the previous run of the daemon.

        The incident of a `kept` file counts as if it happened at the end of the file. `ended_ns` is
        the time of this end on the present monotonic clock, ns. After a restart of the computer the
        time may be negative.
        """
        if kind == "plain":
            self._recent.append((file, ended_ns))
        elif kind == "kept":
            self.earlier_happened(ended_ns)

    def earlier_happened(self, at_ns: int) -> None:
        """Register an incident or a crash in the previous run of the daemon.

        `at_ns` is the time of the incident on the present monotonic clock, ns.
        """
        self._happened_ns = max(self._happened_ns, at_ns)

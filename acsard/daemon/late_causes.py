"""Finds the causes of a late control period in the kernel's counters. This module is pure.

The lateness is the time from the due time of the first missed period to the late step. Each cause
in the table `CAUSES` has a rule, which compares the counters from before and after the lateness. A
rule returns its cause in words, or "" if the counters do not show this cause. Several causes may
apply to one lateness, or none.

A delay counts as a cause only if it lasted for at least a certain share of the lateness, usually
`CAUSE_FRACTION`. Otherwise the small delays of normal load would count as causes.

The kernel also reports how the control loop's thread spent the lateness: it ran, it was ready and
waited for a processor, or it slept. A slow processor delays only a thread that runs or waits for a
processor. A disk delays only a thread that sleeps.
"""

from __future__ import annotations

from collections.abc import Callable

from msgspec import Struct

from acsard.core.formatting import many
from acsard.core.values import NS_PER_S, Event
from acsard.host.clock import MIN_SUSPEND_NS
from acsard.host.kernel_counters import Conditions, Program, Reading, Scheduled

CAUSE_FRACTION = 0.5
"""Usual limit for a cause: a delay counts as a cause only if it lasted for at least this share of
the lateness. Some causes have another limit, such as `DISK_FRACTION`."""

SLEPT_FRACTION = 0.3
"""Limit for the disk as a cause: the disk counts only if the control loop's thread slept for at
least this share of the lateness. The limit is low, because in a test with a fast virtual disk, a
thread that read pages from the disk slept for only half of the time."""

DISK_FRACTION = 0.25
"""Limit for the time in which any program waited for a disk: this time counts as a cause only if it
is at least this share of the lateness. The limit is low, because the kernel counts too little. In a
test, a thread wrote to a disk all the time, but the kernel counted only 0.28 to 0.45 of the time as
waiting."""

MIN_STOLEN_NS = 3 * NS_PER_S // 100
"""Shortest steal time that counts as a cause, ns: three of the kernel's ticks. Steal time is time
in which the host of a virtual machine took the processor away. In a test, 607 late periods had
another cause. In 24 of these periods, the kernel still counted one tick of steal time, and in one
period two ticks."""


class LatenessEvidence(Struct, frozen=True, omit_defaults=True):
    """The lateness of a control period, and the kernel's counters from before and after it."""

    late_ns: int
    """Time from the due time of the first missed period to the late step, ns."""
    loop: Scheduled
    """Two durations of the control loop's thread, ns: how long it ran, and how long it was ready
    but waited for a processor. Both are measured from the last period before the lateness to the
    late step."""
    before: Reading
    after: Reading
    busiest: Program | None = None
    """The process that used the most processor time. None if no process used much processor time,
    or if no search was made."""

    def explains(self, duration_ns: int, share: float = CAUSE_FRACTION) -> bool:
        """Return whether a delay is long enough to count as a cause of the lateness.

        Its duration must be at least `share` times the lateness.
        """
        return duration_ns >= share * self.late_ns

    @property
    def computed(self) -> bool:
        """Whether a slow processor can explain the lateness.

        It can if the control loop's thread ran or waited for a processor for at least half of the
        lateness.
        """
        return self.explains(self.loop.ran_ns + self.loop.waited_ns)

    @property
    def slept(self) -> bool:
        """Whether a wait for a disk can explain the lateness.

        It can if the control loop's thread slept for at least `SLEPT_FRACTION` of the lateness.
        """
        return self.explains(self.late_ns - self.loop.ran_ns - self.loop.waited_ns, SLEPT_FRACTION)


class Cause(Struct, frozen=True):
    """A possible cause of a lateness, with its rule and with advice how to remove the cause."""

    name: str
    rule: Callable[[LatenessEvidence], str]
    """Function that returns the cause in words, or "" if the counters do not show this cause."""
    advice: str


def suspended(late: LatenessEvidence) -> str:
    """Return the cause in words if this computer was suspended, else ""."""
    asleep_ns = late.after.asleep_ns - late.before.asleep_ns
    return (
        f"this computer was suspended for {_seconds(asleep_ns)}"
        if asleep_ns >= MIN_SUSPEND_NS
        else ""
    )


def slowdowns(before: Conditions, now: Conditions) -> dict[str, str]:
    """Return the conditions that slow the processor down now, by the name of their cause.

    The values of the result describe the conditions in words. Heat also counts if the kernel has
    counted a further slow-down by heat since the earlier reading `before`.
    """
    clauses = {}
    if now.undervoltage:
        clauses["undervoltage"] = "the supply voltage is too low, which slows the processor"
    if now.slowed_by_heat or now.throttled > before.throttled:
        clauses["heat"] = "the processor is too hot and runs slower"
    if (clock := now.slow_clock) is not None:
        clauses["governor"] = (
            f"the CPU governor {clock.governor} keeps the processor at {clock.limit_mhz} of "
            f"{clock.full_mhz} MHz"
        )
    return clauses


def slowed(late: LatenessEvidence, name: str) -> str:
    """Return the cause in words if the condition `name` slowed the control loop down, else ""."""
    if not late.computed:
        return ""
    clauses = slowdowns(late.before.conditions, late.after.conditions)
    # Heat also limits the clock frequency.
    return "" if name == "governor" and "heat" in clauses else clauses.get(name, "")


def cgroup_quota(late: LatenessEvidence) -> str:
    """Return the cause in words if the CPU quota of the daemon's cgroup was used up, else ""."""
    without_ns = late.after.quota_ns - late.before.quota_ns
    if not late.explains(without_ns):
        return ""
    return f"the daemon's processor quota was used up for {_seconds(without_ns)}"


def stolen(late: LatenessEvidence) -> str:
    """Return the cause in words if the host took the processor away (steal time), else ""."""
    stolen_ns = most_stolen(late.before, late.after)
    if stolen_ns < MIN_STOLEN_NS or not late.explains(stolen_ns):
        return ""
    return _stolen_text(stolen_ns)


def most_stolen(before: Reading, after: Reading) -> int:
    """Return the steal time between two readings, ns, of the processor with the most steal time.

    Steal time is time in which the host of a virtual machine took the processor away. Return 0 if
    the readings contain no steal times.
    """
    pairs = zip(before.steal_ns, after.steal_ns, strict=False)
    return max((new - old for old, new in pairs), default=0)


def memory(late: LatenessEvidence) -> str:
    """Return the cause in words if memory of the daemon had to be read from a disk, else ""."""
    pages = late.after.major_faults - late.before.major_faults
    if not pages or not late.slept:
        return ""
    return f"{many(pages, 'page')} of the daemon's memory had to be read from the disk"


def disk(late: LatenessEvidence) -> str:
    """Return the cause in words if the control loop's thread waited for a disk, else "".

    If the function `memory` returns a cause, return "", because waiting for memory also counts as
    waiting for a disk. One of two durations must be long enough:

    - the time for which the thread itself waited for a disk. Not every kernel measures this time.
    - the time in which any program waited for a disk. It counts only if the thread itself used a
      disk, because other programs may wait for a disk at any time.
    """
    before, after = late.before, late.after
    own_ns, all_ns = after.own_disk_ns - before.own_disk_ns, after.disk_ns - before.disk_ns
    ours = after.own_bytes > before.own_bytes and late.explains(all_ns, DISK_FRACTION)
    if memory(late) or not (late.slept and (ours or late.explains(own_ns))):
        return ""
    return "the daemon waited for the disk"


def other_program(late: LatenessEvidence) -> str:
    """Return the cause in words if other programs used the daemon's processor time, else "".

    If the function `cgroup_quota` or `stolen` returns a cause, return "".
    """
    if cgroup_quota(late) or stolen(late) or not late.explains(late.loop.waited_ns):
        return ""
    for_s = _seconds(late.loop.waited_ns)
    busiest = late.busiest
    if busiest is None:
        return f"other programs used the processor for {for_s}"
    kind = "real-time program" if busiest.real_time else "program"
    return (
        f"other programs used the processor for {for_s}, most of all the {kind} "
        f"{busiest.name} (pid {busiest.pid})"
    )


CAUSES = (
    Cause("suspended", suspended, "disable suspend: systemctl mask sleep.target"),
    Cause(
        "undervoltage",
        lambda late: slowed(late, "undervoltage"),
        "use a stronger power supply and a shorter cable",
    ),
    Cause("heat", lambda late: slowed(late, "heat"), "cool the processor"),
    Cause(
        "governor",
        lambda late: slowed(late, "governor"),
        "choose the CPU governor schedutil or performance",
    ),
    Cause("quota", cgroup_quota, "raise CPUQuota= of the service, or --cpus of the container"),
    Cause("steal", stolen, "give the virtual machine a processor of its own"),
    Cause(
        "memory",
        memory,
        "free memory, or run acsard as its systemd service, which locks the daemon's memory",
    ),
    Cause("disk", disk, "find the program that uses the disk (`iotop`), or use a faster disk"),
    Cause(
        "processor",
        other_program,
        "run acsard as its systemd service, and give other real-time programs a priority below 10",
    ),
)
"""All causes, in the order in which an event names them. Rare causes come first."""


def causes(late: LatenessEvidence) -> tuple[tuple[str, ...], str]:
    """Return the names of the causes of a lateness, and a text with these causes and advice.

    Both results are empty if the counters show no cause.
    """
    pairs = [(cause, clause) for cause in CAUSES if (clause := cause.rule(late))]
    clauses = [f"{clause} ({cause.advice})" for cause, clause in pairs]
    return tuple([cause.name for cause, _ in pairs]), ", and ".join(clauses)


BECAUSE = ", because "
"""Separator between the lateness and its causes in the text of an event."""


def event_of(late: LatenessEvidence, clause: str, *, immediate: bool) -> Event:
    """Return the log event that reports a lateness and its causes.

    `clause` is the text from `causes`. If `immediate` is False, the log may delay this event,
    because a recent event had the same causes.
    """
    text = f"by {late.late_ns / NS_PER_S:.2f} s{BECAUSE}{clause}"
    return Event("missed_periods", text, "warning", kind="late", news=immediate)


def cause_in(text: str) -> str:
    """Return the part of an event's text that states a lateness and its causes.

    Return "" if the text names no causes.
    """
    begin, because, clause = text.partition(BECAUSE)
    return begin.rpartition(": ")[2] + because + clause if because else ""


STOLEN_FRACTION = 0.02
"""Limit for the steal time in `present`. The function reports steal time only if it exceeds this
share of the time between the two readings. Steal time is time in which the host of a virtual
machine took the processor away."""


def present(before: Reading, after: Reading, within_ns: int) -> list[tuple[str, str]]:
    """Return the causes that slow down every program on this computer now, each with advice.

    The result is a list of pairs: the cause in words, and the advice. `before` and `after` are two
    readings of the kernel's counters, which were made `within_ns` ns apart.
    """
    clauses = slowdowns(before.conditions, after.conditions)
    stolen_ns = most_stolen(before, after)
    if stolen_ns > STOLEN_FRACTION * within_ns:
        clauses["steal"] = _stolen_text(stolen_ns)
    return [(clauses[cause.name], cause.advice) for cause in CAUSES if cause.name in clauses]


def _stolen_text(stolen_ns: int) -> str:
    return f"the host gave this virtual machine no processor for {_seconds(stolen_ns)}"


def _seconds(duration_ns: int) -> str:
    return f"{duration_ns / NS_PER_S:.2f} s"

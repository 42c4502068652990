"""Judges the age of a command: by the beat that it echoes, else by its stamp, else not at all.

Echo: the daemon measures the age by its own clock, and the echo may be as old as the timeout of the
source plus `MARGIN_NS`. Stamp: the clock of the sender is not synchronized, so only the rise of the
delay (arrival minus stamp) above its least value is known. The least delay rises slowly, because
two clocks drift, and nothing proves it upwards: a clock that was slewed or set back gives the very
stamps and arrivals of a queue. Both are refused until the least delay has risen, `activate` or a
new sender id. A refused command changes no timeout.
"""

from __future__ import annotations

from typing import Literal

from msgspec import Struct

from acsard.core.tables.sender_codes import AgeCode
from acsard.core.values import NS_PER_S, Command, Ns

AgeVerdict = Literal[AgeCode, ""]

MARGIN_NS = NS_PER_S // 20  # distance of two beats, and jitter of the delays on a sound LAN

# The kernel slews a clock by at most 0.5 ms per second for systemd-timesyncd.
RISE_DIVISOR = 2000

# The least delay rises by at most one timeout in any hour: its lowest values in slots limit it.
MEMORY_NS, SLOT_NS = 3600 * NS_PER_S, 600 * NS_PER_S

# Of a source: a new publisher in each minute of `MEMORY_NS` makes no known clock new, nor is it
# refused. A full table never forgets a refusal: it drops a clock that is not proven, else the one
# that was silent longest and was not refused since its last accepted command, else none.
MAX_CLOCKS = 64

LASTING_NS = 2 * NS_PER_S  # refusals for this time are no passing state, and their cause is named

SLOWEST, FASTEST = 0.8, 1.25  # stamps that advance by less or more in a second are no clock's

# Without an accepted command for this time, a sender is disarmed, and may count from 0 again.
SILENT_NS = 10 * NS_PER_S


class Order(Struct, gc=False):
    """The last accepted command of a sender, and the refusals for age since then."""

    beat_ns: Ns = -1  # -1: the sender has not echoed
    sequence: int = -1
    at_ns: Ns = 0
    old_ns: Ns | None = None  # first command since then that was too old
    round_trip_ns: Ns = 0  # least age of these commands
    fell: tuple[Ns, int] = (-SILENT_NS, 0)  # when the number last did not rise, and from which one

    def judge_echo(self, command: Command, timeout_ns: Ns) -> AgeVerdict:
        age_ns, at_ns = command.age_ns, command.arrived_ns
        if command.echo is None:
            return "no_echo"
        if age_ns is None:
            return "other_run"
        if age_ns < 0:
            return "from_future"
        if age_ns > timeout_ns + MARGIN_NS:
            if self.old_ns is None:
                self.old_ns, self.round_trip_ns = at_ns, age_ns
            self.round_trip_ns = min(self.round_trip_ns, age_ns)
            return "too_old" if at_ns - self.old_ns < LASTING_NS else "round_trip"
        if (command.echo.beat_ns, number(command)) <= (self.beat_ns, self.sequence):
            return "not_newer"
        if number(command) <= self.sequence:
            # The program counts anew, unless the higher numbers came back: then there are two.
            fell_ns, before = self.fell
            if at_ns - fell_ns < SILENT_NS and self.sequence > before:
                return "copied"
            self.fell = at_ns, self.sequence
        return ""

    def overtook(self, command: Command, timeout_ns: Ns) -> bool:
        """Return whether a command with a higher number came first, stamped by another clock."""
        numbered = not command.shared and 0 <= number(command) < self.sequence
        return numbered and command.arrived_ns - self.at_ns <= timeout_ns

    def accept(self, command: Command) -> None:
        self.sequence, self.at_ns, self.old_ns = number(command), command.arrived_ns, None
        if command.echo is not None:
            self.beat_ns = command.echo.beat_ns


class Clock(Struct):
    """The clock of a sender without an echo."""

    at_ns: Ns  # last command
    least: int | None = None  # least delay; None until it is proven
    lows: list[int] = []  # lowest `least` of the last slots
    slot_ns: Ns = 0  # begin of the last slot
    accepted_ns: Ns = 0  # stamp of the last accepted command
    low: int = 0  # lowest delay of a proof
    since_ns: Ns | None = None  # a proof runs, in which the delay has not fallen since then
    # First and last arrival below the least delay since the last accepted command.
    lower_ns: tuple[Ns, Ns] | None = None
    late: bool = False  # a command since the last accepted one was refused for its age
    first_refused: tuple[Ns, Ns] | None = None  # arrival and stamp of the first refused command
    cause: AgeVerdict = ""  # of refusals that last
    advance: float = 0.0  # of the stamps, s per second, while refusals last
    behind: int = 0  # delay above the least one of the last hour

    def judge_stamp(self, at_ns: Ns, stamp_ns: Ns, timeout_ns: Ns) -> AgeVerdict:
        delay, least = at_ns - stamp_ns, self._risen(at_ns, timeout_ns)
        self.at_ns, self.least = at_ns, least
        verdict: AgeVerdict
        if least is None or delay < least - MARGIN_NS:
            self.lower_ns = (self.lower_ns or (at_ns, at_ns))[0], at_ns
            verdict = self._prove(at_ns, delay, timeout_ns)
        else:
            self.behind = delay - min(self.lows, default=least)
            first_ns, last_ns = self.lower_ns or (0, 0)
            # Delays that fell too fast for a proof move nothing, but they were lower all the same.
            if last_ns - first_ns >= timeout_ns:
                least = min(least, self.low + (at_ns - last_ns) // RISE_DIVISOR)
            verdict = "stale" if delay - least > timeout_ns else ""
            if not verdict:  # a late command of another program is no evidence against a proof
                self.since_ns = None
        self.late = self.late or verdict == "stale"
        if not verdict and stamp_ns <= self.accepted_ns:
            verdict = "not_newer"
        if verdict:
            return self._lasting(verdict, at_ns, stamp_ns)
        self.accepted_ns, self.late, self.first_refused, self.cause = stamp_ns, False, None, ""
        self.lower_ns = None
        self.least = delay if self.least is None else min(self.least, delay)
        if not self.lows or at_ns - self.slot_ns >= SLOT_NS:
            self.lows, self.slot_ns = [*self.lows[-(MEMORY_NS // SLOT_NS) :], self.least], at_ns
        self.lows[-1] = min(self.lows[-1], self.least)
        return ""

    def may_go(self, now_ns: Ns) -> bool:
        """Return whether the clock shows nothing that must be remembered."""
        return not self.late or now_ns - self.at_ns > MEMORY_NS

    def _risen(self, at_ns: Ns, timeout_ns: Ns) -> int | None:
        if self.least is None or not self.lows:
            return self.least
        risen = self.least + (at_ns - self.at_ns) // RISE_DIVISOR
        return max(self.least, min(risen, min(self.lows) + timeout_ns))

    def _prove(self, at_ns: Ns, delay: int, timeout_ns: Ns) -> AgeVerdict:
        # A new clock, or a lower delay of a known one: the delays of one timeout must not fall.
        fallen = self.low - delay
        if self.since_ns is None or fallen > (at_ns - self.since_ns) // 100 + NS_PER_S // 1000:
            self.low, self.since_ns = delay, at_ns
        elif -fallen >= timeout_ns:  # among others if the stamps stand still
            return "stale"
        elif at_ns - self.since_ns >= timeout_ns:
            self.least, self.since_ns = min(self.low, delay), None
            return ""
        return "unproven" if self.least is None else "early"

    def _lasting(self, verdict: AgeVerdict, at_ns: Ns, stamp_ns: Ns) -> AgeVerdict:
        # Name the cause of refusals that go on: it is looked for again every `LASTING_NS`.
        if self.first_refused is None:
            self.first_refused = at_ns, stamp_ns
        elif (lasted_ns := at_ns - self.first_refused[0]) >= LASTING_NS:
            self.advance = (stamp_ns - self.first_refused[1]) / lasted_ns
            self.first_refused = at_ns, stamp_ns
            if not SLOWEST <= self.advance <= FASTEST:
                self.cause = "stamps"
            else:
                self.cause = "set_back" if verdict == "stale" else ""
        return self.cause or verdict


class Ages(Struct):
    """The clocks of the senders of one source."""

    clocks: dict[str, Clock] = {}

    def judge_age(self, command: Command, last: Order, timeout_ns: Ns, stalled: bool) -> AgeVerdict:
        """Return "" if the command is young enough and newer than the last accepted one.

        `stalled`: the daemon stood still just now, so a command without a stamp may be old.
        """
        if command.echo is not None or last.beat_ns >= 0:
            verdict = last.judge_echo(command, timeout_ns)
        elif command.stamp_ns is not None:
            clock = self._clock(command.clock, command.arrived_ns)
            if clock is None:
                return "too_many_clocks"
            verdict = clock.judge_stamp(command.arrived_ns, command.stamp_ns, timeout_ns)
            if not verdict and last.overtook(command, timeout_ns):
                verdict = "not_newer"
        elif stalled:
            verdict = "stalled"
        else:
            repeats = 0 <= number(command) <= last.sequence
            verdict = "not_newer" if repeats and command.arrived_ns - last.at_ns < SILENT_NS else ""
        if not verdict:
            last.accept(command)
        return verdict

    def _clock(self, name: str, at_ns: Ns) -> Clock | None:
        clock = self.clocks.get(name)
        if clock is None or at_ns - clock.at_ns > MEMORY_NS:
            if clock is None and len(self.clocks) >= MAX_CLOCKS:
                sound = {n: other for n, other in self.clocks.items() if other.may_go(at_ns)}
                if not sound:
                    return None
                del self.clocks[
                    min(sound, key=lambda n: (sound[n].least is not None, sound[n].at_ns))
                ]
            clock = self.clocks[name] = Clock(at_ns)
        return clock


def number(command: Command) -> int:
    return -1 if command.sequence is None else command.sequence

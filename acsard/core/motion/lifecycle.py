"""Keeps the latches and the other facts that determine the mode, and derives the mode from them.

A latch is set by a stop, a fault or `deactivate`. Only `clear` releases a stop or a fault, one at a
time, and only `activate` releases the latch of a `deactivate`. Neither request may release a latch
that its sender has not seen, even if the network delivers the request late:

- A request that names a number releases the latch with exactly this number.
- A `clear` without a number is refused if less than `LATCH_REQUIRED_S` has passed since the last
  stop, the last fault, the last `clear` of a fault, the start of the daemon or its last stall. An
  `activate` without a number is refused if less than this time has passed since the last
  `deactivate`, the start of the daemon or its last stall.
- A request that arrived before the latch was set never releases it.

A pressed emergency stop at the robot, a pressed bumper (with `safety.bumper = "stop"`) and an empty
battery also latch a stop. A fault of a motor driver latches a fault. `clear` releases nothing while
one of these causes lasts.

There is one latch for all causes of a stop, and one for all causes of a fault. Each new cause gives
its latch a new number. The latch keeps the earlier causes, so that the operator reads all of them
before `clear` releases it.
"""

from __future__ import annotations

import math
import re

from msgspec.structs import replace

from acsard.core.formatting import utc
from acsard.core.motion.modes import SHUTDOWN_REASON, Mode, RefusedError, mode_of, require_allowed
from acsard.core.values import NS_PER_S, Instant, Latch, Latches

LATCH_REQUIRED_S = 2.0
"""Time after an event in which a `clear` or `activate` must name the number of the latch, s. The
events are a stop, a fault, the `clear` of a fault, a `deactivate`, the start of the daemon and the
end of a stall of the daemon. In this time, a call that was sent before the event may still arrive,
because the network delays some packets. It seldom delays a packet for longer."""

MAX_CLIENTS = 4
"""Largest number of clients among the earlier causes of a stop. If more clients stop the robot, the
first ones are kept, so that a flood of stops neither fills the reason in `state` nor hides the
first client. The causes from the board need no limit, because there are only a few."""

MAX_FAULTS = 32
"""Largest number of causes of a fault that are kept. The daemon knows fewer different causes, so no
cause is lost. Further causes would be ignored until `clear`."""

LONG_AGO_NS = -(2**62)
"""Monotonic time that stands for "never", ns. It is earlier than every real time."""

_VALUES = re.compile(r"[(\d]")
"""Pattern for the digit or bracket with which the measured values in the text of a fault begin."""


class Lifecycle:
    """The latches and the mode of one robot. Requests that are not allowed raise `RefusedError`."""

    def __init__(self, active: bool, latches: Latches = Latches()) -> None:  # noqa: B008
        """Start with `latches`. If `active` is false, the robot is off until `activate`."""
        self.latches = latches
        self.mode = Mode.WAITING
        self._shutting_down = self._linked = self._commanded = False
        self._dormant = not active
        """Whether the robot waits for its first call `activate` (see `control.auto_activate`)."""
        old_latches = (latches.stop, latches.fault, latches.inactive)
        self._number = max([latch.number for latch in old_latches if latch is not None], default=0)
        self._numbered = False
        """Whether this run of the daemon has numbered a latch. `number_after_restart` returns the
        first number of a run."""
        self._stopped_ns = self._faulted_ns = LONG_AGO_NS
        """Monotonic times at which the last stop and the last fault were latched, ns."""
        self._cleared_ns = LONG_AGO_NS
        """Monotonic time at which a fault was last cleared, ns."""
        self._stop_asked_ns = LONG_AGO_NS
        """Latest monotonic time at which a client's request for a stop arrived, ns."""
        self._off_ns = LONG_AGO_NS
        """Monotonic time at which the robot was last switched off, ns."""
        self._held = self._mend = ""
        """`_held` is the reason why `clear` is refused now, and `_mend` is the advice to the
        operator about it. Both are "" while `clear` is permitted."""
        self._freed_ns = LONG_AGO_NS
        """Monotonic time of the last step in which the cause of a latch ended or came again, ns. A
        call `clear` that arrived before that step is refused."""
        self._began_ns: int | None = None
        """Monotonic time of the first step, or of the first step after the last stall of the
        daemon, ns; None before the first step."""
        self._derive()

    # facts

    def begin(self, now: Instant, *, stalled: bool = False) -> None:
        """Begin a step at the time `now`. `stalled` is true if the daemon stood still before it.

        For `LATCH_REQUIRED_S` after the first step and after each stall, `clear` and `activate`
        must name the number of the latch. A client may have sent its call before or during the
        stall, when it could not see the present latch.
        """
        if stalled or self._began_ns is None:
            self._began_ns = now.mono_ns

    def link(self, up: bool) -> None:
        """Record whether the board is ready to drive the robot, and derive the mode.

        The board is ready if its link is up and it reports all required inputs.
        """
        if up is not self._linked:
            self._linked = up
            self._derive()

    def command(self, fresh: bool) -> None:
        """Record whether the robot has a fresh command to follow, and derive the mode."""
        if fresh is not self._commanded:
            self._commanded = fresh
            self._derive()

    def press(self, why: str, now: Instant) -> None:
        """Latch a stop with a new number. `why` is the cause that the board reports, as text."""
        self._stopped_ns = now.mono_ns
        self._latch(stop=self._stop(now, "", why))

    def refuse_clear(self, why: str, mend: str, now_ns: int) -> None:
        """Record whether the board's reports forbid the call `clear` now.

        `why` is the reason as text, and `mend` is the advice to the operator about it. Both are ""
        if the call is allowed. `now_ns` is the monotonic time, ns.
        """
        if self._held and not why:
            self._freed_ns = now_ns
        self._held, self._mend = why, mend

    def caused_again(self, now_ns: int) -> None:
        """Record that the cause of the fault came again at the monotonic time `now_ns`, ns.

        Calls `clear` that arrived at this time or before are refused.
        """
        self._freed_ns = now_ns

    def leave(self) -> None:
        """Record that the daemon is shutting down."""
        self._shutting_down = True
        self._derive()

    def fault(self, why: str, now: Instant) -> bool:
        """Latch a fault and return True. If this cause is already latched, only return False.

        `why` is the cause of the fault, as text. Two texts name the same cause if they are equal up
        to the first digit or bracket, where the measured values begin. If `MAX_FAULTS` causes are
        latched, further causes are ignored, and the method returns False.
        """
        latch = self.latches.fault
        if latch is not None:
            known = [_without_values(cause.why) for cause in latch.causes]
            if _without_values(why) in known or len(known) >= MAX_FAULTS:
                return False
        self._faulted_ns = now.mono_ns
        self._latch(fault=with_causes(self._new_latch(now, "", why), latch))
        return True

    # requests

    def stop(self, by: str, asked_ns: int, now: Instant) -> str:
        """Latch a stop with a new number, and return a text for the client.

        A repeated request does not change the latch. A request counts as repeated if the latch
        already names this client, and if an accepted request for a stop arrived at `asked_ns` or
        later.

        Args:
            by: the name of the client; "" if it is unknown.
            asked_ns: the monotonic time at which the request arrived, ns.
            now: the time of this control step.
        """
        latch, why = self.latches.stop, f"stopped by {by or 'request'}"
        named = latch is not None and any(cause.why == why for cause in latch.causes)
        if not (named and asked_ns <= self._stop_asked_ns):
            self._stopped_ns = now.mono_ns
            self._stop_asked_ns = max(self._stop_asked_ns, asked_ns)
            self._latch(stop=self._stop(now, by, why))
        if self._shutting_down:
            return f"stopped and latched; {SHUTDOWN_REASON}"
        if self.latches.fault is not None:
            return (
                "stopped and latched; call srv/clear twice, "
                f"{LATCH_REQUIRED_S:g} s apart: the first call releases the fault, the second call "
                "releases the stop"
            )
        return "stopped and latched; srv/clear releases it"

    def clear(self, number: int | None, asked_ns: int, now: Instant) -> str:
        """Release the fault if one is latched, otherwise the stop; return a text for the client.

        The text is "" if neither a fault nor a stop is latched.

        Args:
            number: the number of the latch that the client has seen; None if the request names no
                number.
            asked_ns: the monotonic time at which the request arrived, ns.
            now: the time of this control step.

        Raises:
            RefusedError: the mode or a lasting cause forbids the call, the call arrived too early,
                or the client may not know the latch.
        """
        require_allowed(self.mode, "clear")
        if self._held:
            raise RefusedError(f"{self._held}: {self._mend}, then call srv/clear again")
        latches, latch = self.latches, self.latches.next
        if latch is None:
            return ""
        if asked_ns <= self._freed_ns:
            # This call may have arrived before the button was released, because a press may be
            # shorter than a step.
            raise RefusedError(
                "this call came before the cause of the stop or fault had ended: call srv/clear "
                "again"
            )
        if number is None:
            set_ns = max(self._stopped_ns, self._faulted_ns)
            last_ns = self._cleared_ns
            if set_ns <= last_ns and asked_ns - last_ns < LATCH_REQUIRED_S * NS_PER_S:
                # The network may have delivered one call twice.
                raise RefusedError(
                    f"a latch was cleared less than {LATCH_REQUIRED_S:g} s ago; the robot is still "
                    f"{_in_force(latches)}: look at the robot, then call srv/clear again"
                )
            stop = latches.stop
            if latches.fault is None or (stop and self._stopped_ns > self._faulted_ns):
                was = f"the robot was {_stopped(stop or latch)}"
            else:
                was = f"the robot went into fault ({latches.fault.why})"
            self._require_latch_was_seen(was, _in_force(latches), set_ns, asked_ns, "srv/clear")
        else:
            if number != latch.number:
                raise RefusedError(_not_in_force(number, _in_force(latches), "srv/clear"))
            set_ns = self._stopped_ns if latches.fault is None else self._faulted_ns
        if asked_ns <= set_ns or now.mono_ns == set_ns:
            raise RefusedError(
                "a stop or a fault came at the same time as this call or after it: call srv/clear "
                "again"
            )
        if latches.fault is None:
            self._latch(stop=None)
            return self._cleared_text()
        self._cleared_ns = now.mono_ns
        self._latch(fault=None)
        if latches.stop is None:
            return self._cleared_text()
        return (
            f"fault cleared, but the robot is still {_still(latches.stop)}: call srv/clear again "
            f"in {LATCH_REQUIRED_S:g} s"
        )

    def activate(self, number: int | None, asked_ns: int, now: Instant) -> bool:
        """Switch the robot on. Return True if it was off, and False if it was already on.

        Args:
            number: the number of the latch that the client has seen; None if the request names no
                number. 0 means that the client has seen no latch: the robot is off only because
                `auto_activate` is False.
            asked_ns: the monotonic time at which the request arrived, ns.
            now: the time of this control step.

        Raises:
            RefusedError: the mode forbids the request, the request arrived too early, or the client
                may not know the latch.
        """
        require_allowed(self.mode, "activate")
        if not self._off:
            return False
        latch = self.latches.inactive
        if number is not None and number != (0 if latch is None else latch.number):
            still = "switched off" if latch is None else latch.why
            raise RefusedError(_not_in_force(number, still, "srv/activate"))
        if latch is not None:
            if number is None:
                self._require_latch_was_seen(
                    f"the robot was {_stopped(latch)}",
                    _still(latch),
                    self._off_ns,
                    asked_ns,
                    "srv/activate",
                )
            if asked_ns <= self._off_ns or now.mono_ns == self._off_ns:
                raise RefusedError(
                    f"{latch.why} at the same time as this call or after it: call srv/activate "
                    "again"
                )
        self._dormant = False
        self._latch(inactive=None)
        return True

    def deactivate(self, by: str, now: Instant) -> str:
        """Switch the robot off, and return a text for the client.

        If the robot is already off, a latch with a new number replaces the old latch.
        """
        require_allowed(self.mode, "deactivate")
        self._off_ns = now.mono_ns
        self._latch(inactive=self._new_latch(now, by, f"switched off by {by or 'request'}"))
        return "inactive: the robot brakes to rest; call srv/activate to switch it on again"

    @property
    def why(self) -> str:
        """The reason of the mode `fault`, `stopped` or `inactive`, and the call that ends it."""
        latches, reason = self.latches, self._held
        if latches.next is not None:
            fault, stop = latches.fault, latches.stop
            faults = () if fault is None else fault.causes
            parts = [f"{cause.why}, latched {_when(cause)}" for cause in faults]
            causes = () if stop is None else stop.causes
            if reason and reason not in [latch.why for latch in (*faults, *causes)]:
                # The cause that lasts differs from all latched causes. For example, one of two
                # pressed bumpers has been released.
                parts.append(reason)
            parts += [_latch_text(cause) for cause in causes]
            before = f"{self._mend}, then " if reason else ""
            twice = f" twice, {LATCH_REQUIRED_S:g} s apart" if fault and stop else ""
            return f"{'; also '.join(parts)}; {before}call srv/clear{twice}"
        if latches.inactive is not None:
            return f"{_latch_text(latches.inactive)}; call srv/activate"
        return "switched off; call srv/activate"

    # latches and mode

    @property
    def _off(self) -> bool:
        return self._dormant or self.latches.inactive is not None

    def _new_latch(self, now: Instant, by: str, why: str) -> Latch:
        if self._numbered:
            self._number = max(self._number + 1, now.wall_ns // 1_000_000)
        else:
            self._numbered, self._number = True, number_after_restart(self._number, now)
        return Latch(self._number, now.wall_ns, by, why)

    def _stop(self, now: Instant, by: str, why: str) -> Latch:
        return with_causes(self._new_latch(now, by, why), self.latches.stop)

    def _latch(self, **changes: Latch | None) -> None:
        before = self.latches
        if any(getattr(before, name) is not latch for name, latch in changes.items()):
            self.latches = replace(before, **changes)
        self._derive()

    def _derive(self) -> None:
        self.mode = mode_of(
            shutting_down=self._shutting_down,
            fault=self.latches.fault is not None,
            stopped=self.latches.stop is not None,
            inactive=self._off,
            linked=self._linked,
            commanded=self._commanded,
        )

    def _cleared_text(self) -> str:
        zero = "each sender must send a zero before it drives"
        if self._off:
            return (
                "cleared, but the robot is still switched off: call srv/activate to switch it on, "
                f"then {zero}"
            )
        return f"cleared; {zero}"

    def _require_latch_was_seen(
        self, was: str, still: str, set_ns: int, asked_ns: int, call: str
    ) -> None:
        """Raise `RefusedError` if the sender of the request may not know the latch yet.

        Args:
            was: the newest cause, as text.
            still: all causes, as text.
            set_ns: the monotonic time of the newest cause, ns; `LONG_AGO_NS` if an earlier run of
                the daemon set the latch.
            asked_ns: the monotonic time at which the request arrived, ns.
            call: the name of the service that was called.
        """
        began_ns = LONG_AGO_NS if self._began_ns is None else self._began_ns
        since = asked_ns - max(set_ns, began_ns)
        if since >= LATCH_REQUIRED_S * NS_PER_S:
            return
        age_s = max(0.1, math.floor(since / NS_PER_S * 10) / 10)
        age_text = f"{was} {age_s:.1f} s ago"
        if set_ns < began_ns:
            # An earlier run set the latch, or the daemon stood still after it. The age in an
            # earlier run is unknown, because the monotonic clock may have restarted and the wall
            # clock may have been set since.
            age_text = (
                f"the daemon started or resumed {age_s:.1f} s ago and the robot is still {still}"
            )
        raise RefusedError(
            f"{age_text}: look at the robot, then call {call} again when {LATCH_REQUIRED_S:g} s "
            "have passed since then, or name the number of the latch that you have seen"
        )


def with_causes(latch: Latch, before: Latch | None) -> Latch:
    """Return `latch`, the new latch of a stop or a fault, with the earlier causes added to it.

    `before` is the latch that `latch` replaces, or None. Its causes become the earlier causes,
    except a cause that equals the new one. Of the earlier causes that came from clients, the oldest
    `MAX_CLIENTS` are kept.
    """
    causes = () if before is None else before.causes
    earlier = [replace(cause, earlier=()) for cause in causes if cause.why != latch.why]
    surplus = [cause for cause in earlier if cause.by][:-MAX_CLIENTS]
    return replace(latch, earlier=tuple([cause for cause in earlier if cause not in surplus]))


def _without_values(why: str) -> str:
    return _VALUES.split(why, maxsplit=1)[0]


def number_after_restart(last_number: int, now: Instant) -> int:
    """Return a latch number that no earlier run of the daemon has used.

    `last_number` is the largest number in the latch file. The result is the wall-clock time in ms
    if that is above `last_number`. Otherwise the wall clock was set back, and the result is
    `last_number` + 1 plus the time since the computer started, ms.
    """
    # `last_number` + 1 alone is not safe: an earlier latch, which is not in the file any more, may
    # have had that number, and a late `clear` may still name it.
    number = now.wall_ns // 1_000_000
    return number if number > last_number else last_number + 1 + now.mono_ns // 1_000_000


def _not_in_force(number: int, still: str, call: str) -> str:
    return (
        f"latch {number} is not the latch that {call} would release now; the robot is still "
        f"{still}: look at the robot, then call {call} again with the present `latch` in `state`"
    )


def _in_force(latches: Latches) -> str:
    if latches.fault is not None:
        return f"in fault ({'; also '.join([cause.why for cause in latches.fault.causes])})"
    return _still(latches.stop) if latches.stop else ""


def _still(latch: Latch) -> str:
    return " and ".join([_stopped(cause) for cause in latch.causes])


def _stopped(latch: Latch) -> str:
    return latch.why if _asked_for(latch) else f"stopped ({latch.why})"


def _when(latch: Latch) -> str:
    return f"at {utc(latch.at_ns)}{', before the restart' if latch.kept else ''}"


def _asked_for(latch: Latch) -> bool:
    """Return whether a client requested the latch. Otherwise, a cause such as a fault set it."""
    return latch.why.endswith(f" by {latch.by or 'request'}")


def _latch_text(latch: Latch) -> str:
    if not _asked_for(latch):
        return f"{latch.why} (latched {_when(latch)})"
    return f"{'was ' if latch.kept else ''}{latch.why} {_when(latch)}"

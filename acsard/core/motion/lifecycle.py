"""Keeps the latches and the other facts that determine the mode, and derives the mode from them.

Only `clear` releases a stop or a fault, one at a time, and only `activate` releases a `deactivate`.
Neither releases a latch that its sender has not seen: the request names the number of the latch, or
nothing happened in the last `LATCH_REQUIRED_S`; and it arrived after the latch was set. `clear`
releases nothing while its cause lasts: a pressed input of the board, an empty battery, or a fault
of a motor driver. A new cause gives its latch a new number and keeps the earlier causes, so that
the operator reads all of them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from msgspec.structs import replace

from acsard.core.codes import Reason, reason
from acsard.core.formatting import utc
from acsard.core.motion.modes import SHUTDOWN_REASON, Mode, RefusedError, mode_of, require_allowed
from acsard.core.values import NS_PER_S, Instant, Latch, Latches, Ns

# For this time after a stop, a fault, its `clear`, a `deactivate`, the start or a stall of the
# daemon, a call must name its latch: an earlier call may still arrive, as the network seldom delays
# a packet for longer.
LATCH_REQUIRED_S = 2.0

# The first clients among the causes of a stop: a flood of stops must not hide the first client.
MAX_CLIENTS = 4

MAX_FAULTS = 32  # the daemon knows fewer different ones

LONG_AGO_NS = -(2**62)  # "never"

NAMELESS = "request"  # in a text, a client that has no name


class Lifecycle:
    """The latches and the mode of one robot. Requests that are not allowed raise `RefusedError`."""

    def __init__(self, latches: Latches = Latches()) -> None:  # noqa: B008
        self.latches = latches
        self.mode = Mode.WAITING
        self._shutting_down = self._linked = self._commanded = False
        old_latches = (latches.stop, latches.fault, latches.inactive)
        self._number = max([latch.number for latch in old_latches if latch is not None], default=0)
        self._numbered = False  # this run has numbered a latch (`number_after_restart`)
        self._stopped_ns = self._faulted_ns = LONG_AGO_NS  # last latched
        self._cleared_ns = LONG_AGO_NS  # a fault was last cleared
        self._stop_asked_ns = LONG_AGO_NS  # latest arrival of a client's stop
        self._off_ns = LONG_AGO_NS  # last switched off
        self._held: Reason | None = None  # why `clear` is refused now
        self._freed_ns = LONG_AGO_NS  # a cause last ended or came again; no earlier `clear` counts
        self._began_ns: Ns | None = None  # first step, or first after the last stall
        self._derive()

    # facts

    def begin(self, now: Instant, *, stalled: bool = False) -> None:
        """Begin a step; `stalled` says that the daemon stood still before it.

        A client may have sent its call when it could not see the present latch, so for
        `LATCH_REQUIRED_S` calls must name its number.
        """
        if stalled or self._began_ns is None:
            self._began_ns = now.mono_ns

    def link(self, up: bool) -> None:
        """Record whether the board is linked and reports all required inputs; derive the mode."""
        if up is not self._linked:
            self._linked = up
            self._derive()

    def command(self, fresh: bool) -> None:
        """Record whether there is a fresh command to follow, and derive the mode."""
        if fresh is not self._commanded:
            self._commanded = fresh
            self._derive()

    def press(self, why: Reason, now: Instant) -> None:
        """Latch a stop with a new number, for the cause that the board reports."""
        self._stopped_ns = now.mono_ns
        self._latch(stop=self._stop(now, "", why))

    def refuse_clear(self, why: Reason | None, now_ns: Ns) -> None:
        """Record why the board's reports forbid `clear` now, or None."""
        if self._held is not None and why is None:
            self._freed_ns = now_ns
        self._held = why

    def caused_again(self, now_ns: Ns) -> None:
        self._freed_ns = now_ns

    def leave(self) -> None:
        self._shutting_down = True
        self._derive()

    def fault(self, why: Reason, now: Instant) -> bool:
        """Latch a fault and return True, or False if its cause is latched or there is no room."""
        latch = self.latches.fault
        if latch is not None:
            causes = latch.causes
            if len(causes) >= MAX_FAULTS or _is_latched(why, causes):
                return False
        self._faulted_ns = now.mono_ns
        self._latch(fault=with_causes(self._new_latch(now, "", why), latch))
        return True

    # requests

    def stop(self, by: str, asked_ns: Ns, now: Instant) -> str:
        """Latch a stop with a new number, and return a text for the client.

        A repetition changes nothing: the latch names this client, and an accepted stop arrived at
        `asked_ns` or later.
        """
        latch, why = self.latches.stop, reason("stopped", by=by or NAMELESS)
        named = latch is not None and (why.code, "", by) in [cause.cause for cause in latch.causes]
        if not (named and asked_ns <= self._stop_asked_ns):
            self._stopped_ns = now.mono_ns
            self._stop_asked_ns = max(self._stop_asked_ns, asked_ns)
            self._latch(stop=self._stop(now, by, why))
        if self._shutting_down:
            return f"stopped and latched; {SHUTDOWN_REASON.text}"
        if self.latches.fault is not None:
            return (
                "stopped and latched; call srv/clear twice, "
                f"{LATCH_REQUIRED_S:g} s apart: the first call releases the fault, the second call "
                "releases the stop"
            )
        return "stopped and latched; srv/clear releases it"

    def clear(self, number: int | None, asked_ns: Ns, now: Instant) -> str:
        """Release the fault if there is one, otherwise the stop; return a text, or "" for neither.

        `number` is of the latch that the client has seen, if it names one. Raises `RefusedError` if
        the mode or a lasting cause forbids it, or if the client may not know the latch.
        """
        require_allowed(self.mode, "clear")
        if self._held:
            held = self._held
            raise RefusedError(f"{held.text}: {held.advice}, then call srv/clear again")
        latches, latch = self.latches, self.latches.next
        if latch is None:
            return ""
        if asked_ns <= self._freed_ns:
            # A press may be shorter than a step, so this call may have come before the release.
            raise RefusedError(
                "this call came before the cause of the stop or fault had ended: call srv/clear "
                "again"
            )
        if number is None:
            set_ns = max(self._stopped_ns, self._faulted_ns)
            last_ns = self._cleared_ns
            if set_ns <= last_ns and asked_ns - last_ns < LATCH_REQUIRED_S * NS_PER_S:
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

    def activate(self, number: int | None, asked_ns: Ns, now: Instant) -> bool:
        """Switch the robot on; return False if it was on.

        `number` is the latch that the client has seen, or None. Raises `RefusedError` like `clear`.
        """
        require_allowed(self.mode, "activate")
        latch = self.latches.inactive
        if latch is None:
            return False
        if number is not None and number != latch.number:
            raise RefusedError(_not_in_force(number, latch.why, "srv/activate"))
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
                f"{latch.why} at the same time as this call or after it: call srv/activate again"
            )
        self._latch(inactive=None)
        return True

    def deactivate(self, by: str, now: Instant) -> str:
        require_allowed(self.mode, "deactivate")
        self._off_ns = now.mono_ns
        why = reason("switched_off", by=by or NAMELESS)
        self._latch(inactive=self._new_latch(now, by, why))
        return "inactive: the robot brakes to rest; call srv/activate to switch it on again"

    @property
    def why(self) -> Reason:
        """The reason of the mode `fault`, `stopped` or `inactive`, and the call that ends it."""
        latches, held = self.latches, self._held
        if latches.next is not None:
            fault, stop = latches.fault, latches.stop
            faults = () if fault is None else fault.causes
            parts = [f"{cause.why}, latched {_when(cause)}" for cause in faults]
            causes = () if stop is None else stop.causes
            if held is not None and not _is_latched(held, (*faults, *causes)):
                # For example, one of two pressed bumpers has been released.
                parts.append(held.text)
            parts += [_latch_text(cause) for cause in causes]
            before = "" if held is None else f"{held.advice}, then "
            twice = f" twice, {LATCH_REQUIRED_S:g} s apart" if fault and stop else ""
            text = f"{'; also '.join(parts)}; {before}call srv/clear{twice}"
            return Reason(latches.next.code, text)
        latch = latches.inactive
        assert latch is not None
        return Reason(latch.code, f"{_latch_text(latch)}; call srv/activate")

    # latches and mode

    def _new_latch(self, now: Instant, by: str, why: Reason) -> Latch:
        if self._numbered:
            self._number = max(self._number + 1, now.wall_ns // 1_000_000)
        else:
            self._numbered, self._number = True, number_after_restart(self._number, now)
        return latch_of(self._number, now.wall_ns, by, why)

    def _stop(self, now: Instant, by: str, why: Reason) -> Latch:
        return with_causes(self._new_latch(now, by, why), self.latches.stop)

    def _latch(self, **changes: Latch | None) -> None:
        self.latches = replace(self.latches, **changes)
        self._derive()

    def _derive(self) -> None:
        self.mode = mode_of(
            shutting_down=self._shutting_down,
            fault=self.latches.fault is not None,
            stopped=self.latches.stop is not None,
            inactive=self.latches.inactive is not None,
            linked=self._linked,
            commanded=self._commanded,
        )

    def _cleared_text(self) -> str:
        zero = "each sender must send a zero before it drives"
        if self.latches.inactive is not None:
            return (
                "cleared, but the robot is still switched off: call srv/activate to switch it on, "
                f"then {zero}"
            )
        return f"cleared; {zero}"

    def _require_latch_was_seen(
        self, was: str, still: str, set_ns: Ns, asked_ns: Ns, call: str
    ) -> None:
        # `was` is the newest cause, `still` all, `set_ns` its time.
        began_ns = LONG_AGO_NS if self._began_ns is None else self._began_ns
        since = asked_ns - max(set_ns, began_ns)
        if since >= LATCH_REQUIRED_S * NS_PER_S:
            return
        age_s = max(0.1, math.floor(since / NS_PER_S * 10) / 10)
        age_text = f"{was} {age_s:.1f} s ago"
        if set_ns < began_ns:
            # The age in an earlier run is unknown: the monotonic clock may have restarted, and the
            # wall clock may have been set.
            age_text = (
                f"the daemon started or resumed {age_s:.1f} s ago and the robot is still {still}"
            )
        raise RefusedError(
            f"{age_text}: look at the robot, then call {call} again when {LATCH_REQUIRED_S:g} s "
            "have passed since then, or name the number of the latch that you have seen"
        )


def with_causes(latch: Latch, before: Latch | None) -> Latch:
    """Return a new latch with the earlier causes of the one that it replaces.

    Of those from clients, the oldest `MAX_CLIENTS` are kept.
    """
    causes = () if before is None else before.causes
    earlier = [replace(cause, earlier=()) for cause in causes if cause.cause != latch.cause]
    surplus = [cause for cause in earlier if cause.by][:-MAX_CLIENTS]
    return replace(latch, earlier=tuple([cause for cause in earlier if cause not in surplus]))


def latch_of(number: int, at_ns: int, by: str, why: Reason) -> Latch:
    return Latch(number, at_ns, by, why.text, why.code, why.part)


def _is_latched(why: Reason, causes: Sequence[Latch]) -> bool:
    return any(cause.code == why.code and cause.part == why.part for cause in causes)


def number_after_restart(last_number: int, now: Instant) -> int:
    """Return a latch number that no earlier run has used: the wall clock in ms if it is larger.

    If the wall clock was set back, it is `last_number` + 1 + ms since the computer started.
    """
    # An earlier latch that is not in the file may have had `last_number` + 1, and a late `clear`
    # may still name it.
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
    return latch.code in ("stopped", "switched_off")  # by a client


def _latch_text(latch: Latch) -> str:
    if not _asked_for(latch):
        return f"{latch.why} (latched {_when(latch)})"
    return f"{'was ' if latch.kept else ''}{latch.why} {_when(latch)}"

"""Keeps the latches and the other facts that determine the mode, and derives the mode from them.

A latch is a set of numbered causes. `clear` releases exactly the faults and stops that it names:
those that its caller was shown. A plain `clear` names none, so it releases the faults if there are
any, else the stops, once each fault and stop has been published for `SHOWN_S`. `activate` releases
what `deactivate` latched, by the same rule. `clear` releases nothing while a cause lasts: a pressed
input of the board, an empty battery, or a fault of a motor driver.

A loan of the serial port has a number, too. It ends with an `activate` that names it or is allowed.
"""

from __future__ import annotations

import math
from collections.abc import Collection

from msgspec import Struct
from msgspec.structs import replace

from acsard.core.codes import Reason, reason
from acsard.core.motion.latches import (
    NAMELESS,
    OTHERS,
    describe,
    in_force,
    is_latched,
    latched,
    released,
    stopped,
)
from acsard.core.motion.modes import SHUTDOWN_REASON, Mode, RefusedError, mode_of, require_allowed
from acsard.core.values import NS_PER_S, Cause, CauseKind, Instant, Latches, Ns

# A caller that names no causes must have had this time to read them.
SHOWN_S = 2.0

NEVER_NS = -(2**62)

ZERO_FIRST = "each sender must send a zero before it drives"


class Lifecycle(Struct):
    """The latches and the mode of one robot. Requests that are not allowed raise `RefusedError`."""

    latches: Latches = Latches()
    mode: Mode = Mode.WAITING
    shutting_down: bool = False
    linked: bool = False
    commanded: bool = False
    held: Reason | None = None  # why the board's reports forbid `clear` now
    freed_ns: Ns = NEVER_NS  # when a cause last ended or came again; no earlier `clear` counts
    shown: dict[int, Ns] = {}  # since when each cause has been published, by its number
    unshown: bool = True  # call `begin`
    begun: bool = False  # a step of this run has published its state
    stop_asked_ns: Ns = NEVER_NS  # latest arrival of a client's stop
    loan: int = 0  # the number of the serial port's loan to another program; 0: it is ours

    def __post_init__(self) -> None:
        self._derive()

    # facts

    def begin(self, now_ns: Ns) -> None:
        """Begin a step: the step before has published all causes."""
        if self.begun:
            numbers = [cause.number for cause in self.latches.causes]
            self.shown = {number: self.shown.get(number, now_ns) for number in numbers}
            self.unshown = False
        self.begun = True

    def link(self, up: bool) -> None:
        """Record whether the board is linked and reports all required inputs; derive the mode."""
        if up is not self.linked:
            self.linked = up
            self._derive()

    def command(self, fresh: bool) -> None:
        """Record whether there is a fresh command to follow, and derive the mode."""
        if fresh is not self.commanded:
            self.commanded = fresh
            self._derive()

    def press(self, why: Reason, now: Instant) -> None:
        """Latch a stop with a new number, for the cause that the board reports."""
        self._use(latched(self.latches, "stop", why, now.wall_ns))

    def hold(self, why: Reason | None, now_ns: Ns) -> None:
        """Record why the board's reports forbid `clear` now, or None."""
        if self.held is not None and why is None:
            self.freed_ns = now_ns
        self.held = why

    def leave(self) -> None:
        self.shutting_down = True
        self._derive()

    def fault(self, why: Reason, now: Instant) -> bool:
        """Latch a fault and return True, or False if it is latched already."""
        if is_latched(why, self.latches.of("fault")):
            return False
        self._use(latched(self.latches, "fault", why, now.wall_ns))
        return True

    # requests

    def stop(self, by: str, asked_ns: Ns, now: Instant) -> str:
        """Latch a stop with a new number, and return a text for the client.

        A repetition changes nothing: this client's stop is latched, and an accepted stop arrived at
        `asked_ns` or later.
        """
        # A query of `srv/stop` arrives as two, so the stop of further clients may be its own.
        newest = asked_ns == self.stop_asked_ns
        if asked_ns > self.stop_asked_ns or not self.stop_of(by, or_others=newest):
            self.stop_asked_ns = max(self.stop_asked_ns, asked_ns)
            self._use(stopped(self.latches, by, now.wall_ns))
        if self.shutting_down:
            return f"stopped and latched; {SHUTDOWN_REASON.text}"
        return "stopped and latched; `acsard call clear` releases it"

    def stop_of(self, by: str, *, or_others: bool = True) -> tuple[int, ...]:
        """Return the number of a client's stop, else of that of further clients, or ()."""
        stops = self.latches.of("stop")
        own = tuple([c.number for c in stops if (c.code, c.by) == ("stopped", by)])
        if own or not or_others:
            return own
        return tuple([c.number for c in stops if c.code == OTHERS])

    def clear(self, numbers: Collection[int] | None, asked_ns: Ns) -> tuple[str, tuple[int, ...]]:
        """Release the named causes; return a text and the numbers released.

        Without `numbers`, release the faults if there are any, else the stops. Raises
        `RefusedError` if the mode or a lasting cause forbids it, if the caller may not know a
        cause, or if no named one is in force.
        """
        require_allowed(self.mode, "clear")
        if self.held:
            raise RefusedError(
                f"{self.held.text}: {self.held.advice}, then type `acsard call clear` again"
            )
        causes = self.latches.of("fault", "stop")
        if not causes:
            return "nothing to clear: the robot is neither stopped nor in fault", ()
        if asked_ns <= self.freed_ns:
            raise RefusedError(
                "this call came before the cause of the stop or fault had ended: type "
                "`acsard call clear` again"
            )
        if numbers is None:
            self._require_shown(causes, asked_ns, "clear")
            numbers = [c.number for c in self.latches.of("fault") or causes]
        done = self._release(numbers, causes, "clear")
        if others := self.latches.of("fault", "stop"):
            still = in_force(others)
            return f"cleared, but the robot is still {still}: type `acsard call clear` again", done
        if self.latches.causes:
            return (
                "cleared, but the robot is still switched off: type `acsard call activate` to "
                f"switch it on, then {ZERO_FIRST}"
            ), done
        return f"cleared; {ZERO_FIRST}", done

    def activate(self, numbers: Collection[int] | None, asked_ns: Ns) -> tuple[int, ...]:
        """Switch the robot on, and return the number released; () if it was on.

        Raises `RefusedError` like `clear`.
        """
        require_allowed(self.mode, "activate")
        causes = self.latches.of("inactive")
        if not causes:
            return ()
        if numbers is None:
            self._require_shown(causes, asked_ns, "activate")
            numbers = [causes[0].number]
        return self._release(numbers, causes, "activate")

    def deactivate(self, by: str, now: Instant) -> str:
        require_allowed(self.mode, "deactivate")
        why = reason("switched_off", by=by or NAMELESS)
        self._use(latched(self.latches, "inactive", why, now.wall_ns, by))
        return "inactive: the robot brakes to rest; `acsard call activate` switches it on again"

    def lend(self) -> None:
        """Lend the serial port; the loan gets a number."""
        self._use(replace(self.latches, last=self.latches.last + 1))
        self.loan = self.latches.last

    @property
    def port_released(self) -> bool:
        return self.loan > 0

    @property
    def why(self) -> Reason:
        """The reason of the mode `fault`, `stopped` or `inactive`, and the call that ends it."""
        held = self.held
        causes = (*self.latches.of("fault"), *self.latches.of("stop"))
        if not causes:
            (off,) = self.latches.of("inactive")
            return Reason(off.code, f"{describe(off)}; type `acsard call activate`")
        parts = [describe(cause) for cause in causes]
        if held is not None and not is_latched(held, causes):
            # For example, one of two pressed bumpers has been released.
            parts.append(held.text)
        before = "" if held is None else f"{held.advice}, then "
        return Reason(causes[0].code, f"{'; also '.join(parts)}; {before}type `acsard call clear`")

    def _release(
        self, numbers: Collection[int], causes: tuple[Cause, ...], verb: str
    ) -> tuple[int, ...]:
        done = tuple([cause.number for cause in causes if cause.number in numbers])
        if not done:
            present = ", ".join([str(cause.number) for cause in causes])
            raise RefusedError(
                f"this call names no cause that {verb} would release now; the robot is still "
                f"{in_force(causes)}: look at the robot, then type `acsard call {verb}` again with "
                f"the numbers of the present `causes` in `state` ({present})"
            )
        self._use(released(self.latches, done))
        return done

    def _require_shown(self, causes: tuple[Cause, ...], asked_ns: Ns, verb: str) -> None:
        # The newest cause was published last.
        newest = max(causes, key=lambda cause: cause.number)
        since_s = (asked_ns - self.shown.get(newest.number, asked_ns)) / NS_PER_S
        if since_s < SHOWN_S:
            age_s = max(0.0, math.floor(since_s * 10) / 10)
            raise RefusedError(
                f"the robot has shown for only {age_s:.1f} s that it is {in_force([newest])}: look "
                f"at the robot, then type `acsard call {verb}` again {SHOWN_S:g} s after that, or "
                "name the numbers of the `causes` in `state`"
            )

    def _use(self, latches: Latches) -> None:
        self.latches, self.unshown = latches, True
        numbers = [cause.number for cause in latches.causes]
        self.shown = {number: at for number, at in self.shown.items() if number in numbers}
        self._derive()

    def _derive(self) -> None:
        kinds: list[CauseKind] = [cause.kind for cause in self.latches.causes]
        self.mode = mode_of(
            shutting_down=self.shutting_down,
            fault="fault" in kinds,
            stopped="stop" in kinds,
            inactive="inactive" in kinds,
            linked=self.linked,
            commanded=self.commanded,
        )

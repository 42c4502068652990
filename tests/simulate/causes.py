"""The promise of the latches: a call releases exactly the causes that it names.

`state` numbers the causes that hold the robot. The judge compares their numbers from step to step.
A cause may go only by a call that names it, by a call without numbers that came late enough for its
sender to know all of them, or because an equal cause with a new number takes its place.

Times are of the robot's clock, which stands still while the robot sleeps: nothing is shown then.
"""

from __future__ import annotations

from typing import NamedTuple

from tests.simulate.ages import MARGIN_NS
from tests.simulate.promises import BrokenError
from tests.simulate.roads import NS

SHOWN_NS = 2 * NS
"""A call without numbers releases nothing that has been published for less than this."""

OTHERS = "stopped_by_others"
"""Code of the cause that takes in a client's stop for which there is no place."""

RELEASES = {"clear": ("fault", "stop"), "activate": ("inactive",)}


class Cause(NamedTuple):
    """A cause in `state`, without its number."""

    kind: str
    key: tuple[str, str, str]
    """Code, part and client: equal causes replace each other."""


class Call(NamedTuple):
    """A call that may release causes."""

    verb: str
    numbers: tuple[int, ...] | None
    asked_ns: int


class Causes:
    """The causes that hold the robot, and the calls that may release them."""

    def __init__(self) -> None:
        self._present: dict[int, Cause] = {}
        self._ever: set[int] = set()
        self._shown_ns: dict[int, int] = {}
        """Since when each cause is published: from the step behind the first one that has it."""
        self._new: list[int] = []
        """Numbers of the step before, which this step publishes."""
        self._waiting: dict[int, Call] = {}
        """Calls without an answer, by their ticket."""
        self._done: list[Call] = []
        """Calls that this step has answered, and that were not refused."""
        self._begun = True

    @property
    def numbers(self) -> dict[int, str]:
        """The kind of each cause of the last step, by its number."""
        return {number: cause.kind for number, cause in self._present.items()}

    def restart(self, lost: bool) -> None:
        """Note that a daemon starts; `lost` says that the file lacks the newest causes."""
        self._waiting.clear()
        self._done.clear()
        self._shown_ns.clear()
        self._new, self._begun = list(self._present), False
        if lost:
            self._present.clear()

    def call(self, ticket: int, call: Call) -> None:
        """Note a call that has arrived."""
        if call.verb in RELEASES:
            self._waiting[ticket] = call

    def answered(self, ticket: int, success: bool) -> None:
        """Note the answer to a call."""
        call = self._waiting.pop(ticket, None)
        if call is not None and success:
            self._done.append(call)

    def is_shown(self, asked_ns: int) -> bool:
        """Return whether a call without numbers, answered in the last step, had to work."""
        causes = [n for n, cause in self._present.items() if cause.kind != "inactive"]
        latest_ns = max((self._shown_ns.get(number, asked_ns) for number in causes), default=0)
        return bool(causes) and asked_ns - latest_ns > SHOWN_NS + MARGIN_NS

    def step(self, true_ns: int, at_ns: int, present: dict[int, Cause]) -> None:
        """Judge the causes of a step that began at `at_ns`."""
        self._shown_ns |= dict.fromkeys(self._new, at_ns)
        self._new = []
        before, self._present = self._present, present
        calls, done = [*self._done, *self._waiting.values()], self._done
        self._done = []
        begun, self._begun = self._begun, True
        if before == present and not done:
            return
        fresh = present.keys() - before.keys()
        if begun and not fresh.isdisjoint(self._ever):
            raise BrokenError("no number is used twice", true_ns, str(fresh & self._ever))
        self._ever |= present.keys()
        self._new = list(fresh)
        keys = {present[number] for number in fresh}
        for number in before.keys() - present.keys():
            cause = before[number]
            renewed = cause in keys or (cause.kind == "inactive" and keys)
            joined = cause.key[0] == "stopped" and OTHERS in [present[n].key[0] for n in fresh]
            if not (renewed or joined or any(self._may(c, number, before) for c in calls)):
                text = f"{cause} with number {number} is gone, and the calls were {calls}"
                raise BrokenError("a call releases what it names, and no more", true_ns, text)
        for call in done:
            kinds = RELEASES[call.verb]
            for number in call.numbers or ():
                if number in before and number in present and before[number].kind in kinds:
                    text = f"{call} was answered, and {before[number]} is still in force"
                    raise BrokenError("a call releases what it names", true_ns, text)

    def _may(self, call: Call, number: int, before: dict[int, Cause]) -> bool:
        """Return whether this call may release this one of the causes before it."""
        kinds, kind = RELEASES[call.verb], before[number].kind
        if kind not in kinds:
            return False
        if call.numbers is not None:
            return number in call.numbers
        those = [other for other, cause in before.items() if cause.kind in kinds]
        if kind == "stop" and any(before[other].kind == "fault" for other in those):
            return False
        latest_ns = max(self._shown_ns.get(other, call.asked_ns) for other in those)
        return call.asked_ns - latest_ns > SHOWN_NS - MARGIN_NS

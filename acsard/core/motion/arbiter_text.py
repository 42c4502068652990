"""Creates the sentences and events about modes, commands and the senders that drive the robot."""

from __future__ import annotations

from functools import lru_cache

from msgspec import Struct

from acsard.core.codes import Reason, reason, sentence
from acsard.core.formatting import many
from acsard.core.motion.arbiter import Choice
from acsard.core.motion.modes import Mode
from acsard.core.values import NS_PER_S, Event, Ns, Refusal, Wait

# A public name has at most 57 characters, a certificate adds 67. A name of a Zenoh key is cut.
MAX_SENDER_LENGTH = 124

ROS_NEVER = (
    " (`ros2 topic pub` with a speed never sends a zero; page howto/ros-drive of the manual lists "
    "tools that send one)"
)


def chosen(choice: Choice) -> Reason:
    """Return the source that drives the robot, or why no source does."""
    match choice.wait.what:
        case "nothing":
            return _commanded(choice.source)
        case "command":
            return NO_COMMAND
        case _:
            return waiting(choice.wait)


NO_COMMAND = reason("no_command")  # without its advice: a robot that waits is in no trouble
NOTHING, COMMAND = sentence("nothing"), sentence("command")


# A format string takes longer than the cache, and a driving robot needs this text in every step.
@lru_cache(64)
def _commanded(source: str) -> Reason:
    return sentence("commanded", source=source)


def waiting(wait: Wait) -> Reason:
    """Return the condition that a source waits for. Its text is "" if the source need not wait."""
    match wait.what:
        case "nothing":
            return NOTHING
        case "command":
            return COMMAND
        case "neutral":
            return sentence(
                "neutral",
                source=wait.source,
                alone=f", and then no speed for {wait.seconds:g} s,"
                if wait.shared or (wait.pause and wait.ros)
                else "",
                lasts="; it has sent speeds for over 3 s" if wait.lasts else "",
                ros=ROS_NEVER if wait.ros else "",
            )
        case "zeros":
            note = f"; the speeds of {wait.kept} have no effect" if wait.kept else ""
            return sentence("zeros", source=wait.source, note=note)
        case "senders":
            return sentence("senders", others=many(wait.senders, "other sender"))
        case _:
            return _sentence(wait)


@lru_cache(64)
def _sentence(wait: Wait) -> Reason:
    return sentence(wait.what, source=wait.source, seconds=wait.seconds, note=wait.kept)


def missed(periods: int, period_ns: Ns) -> Event:
    """Return the event for successive control periods without a step."""
    when = "one control period" if periods == 1 else f"{periods} successive control periods"
    text = f"late by {periods * period_ns / NS_PER_S:.2f} s: no control step ran in {when}"
    return Event("missed_periods", text, "warning", kind="missed", count=periods, news=False)


def refused(refusal: Refusal) -> Event:
    """Return the event `command_refused`, or `new_sender` if its clock is not proven yet."""
    by, kind = refusal.sender[:MAX_SENDER_LENGTH], refusal.reason
    if kind == "unproven":
        return Event("new_sender", refusal.text, "debug", by, news=False, code=kind)
    return Event("command_refused", refusal.text, "warning", by, kind, news=False, code=kind)


class CommandEvents(Struct):
    """Events for a new mode, and for a new source or sender that drives the robot."""

    mode: Mode
    commander: tuple[str, str] = ("", "")  # source and sender
    kept: str = ""  # source whose speeds have no effect, by the last event

    def changes(self, mode: Mode, choice: Choice, why: Reason) -> list[Event]:
        """Return the events for a new mode, a new commander, and speeds without effect.

        A commander that drives again after a pause is not new. `why` is the reason of the mode.
        """
        drives, before, last = mode is Mode.DRIVING, self.mode, self.commander
        if drives:
            self.commander = (choice.source, choice.sender)
        self.mode, events = mode, []
        if mode is not before:
            # The text has the source.
            why, by = (chosen(choice), choice.sender[:MAX_SENDER_LENGTH]) if drives else (why, "")
            kind = f"{before} -> {mode}"
            events.append(Event("mode", why.text, by=by, kind=kind, code=why.code))
        if self.commander != last:
            kind = f"{_name(last)} -> {_name(self.commander)}"
            events.append(Event("commander", "", kind=kind))
        return events + self._kept_waiting(mode, choice)

    def _kept_waiting(self, mode: Mode, choice: Choice) -> list[Event]:
        # A warning, once, if the speeds of a source have had no effect for a while.
        wait, source = choice.wait, ""
        if mode not in (Mode.READY, Mode.DRIVING) or wait.what not in ("neutral", "zeros"):
            self.kept = ""
        elif wait.what == "zeros":
            source = wait.kept
        elif wait.lasts:
            source = wait.source
        if not source or source == self.kept:
            return []
        self.kept = source
        by = _name((choice.source, choice.sender))
        why = waiting(wait)
        return [Event("commands_without_effect", why.text, "warning", by, source, code=why.code)]


def _name(commander: tuple[str, str]) -> str:
    source, sender = commander
    return f"{source} ({sender[:MAX_SENDER_LENGTH]})" if source else "no sender"

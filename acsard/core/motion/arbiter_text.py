"""Creates the sentences and events about modes, commands and the senders that drive the robot."""

from __future__ import annotations

from acsard.core.formatting import lasting, many
from acsard.core.motion.arbiter import MAX_SENDERS, Choice
from acsard.core.motion.modes import Mode
from acsard.core.values import NS_PER_S, Event, Ns, Refusal, Wait

REFUSED = {
    "unknown_source": "this source is not in commands.sources",
    "not_finite": "the command contains NaN or infinity",
    "too_many_senders": f"{MAX_SENDERS} other senders of this source are active; end one first",
    "unproven": "this sender is new: the robot follows a sender only after the sender's commands "
    "have arrived with steady delays; this is not an error",
    "stale": "the command is older than the source's timeout allows, or older than one that the "
    "robot has already accepted: the network delayed it, or the sender's clock was set",
}

# A public name has at most 57 characters, a certificate adds 67. A name of a Zenoh key is cut.
MAX_SENDER_LENGTH = 124

ROS_NEVER = (
    ' (`ros2 topic pub` with a speed never sends a zero; the section "After a clear" of '
    "deploy/ros2/README.md lists tools that send one)"
)


def chosen(choice: Choice) -> str:
    """Return the source that drives the robot, or why no source does, as text."""
    if choice.wait.what == "command":
        return "waiting for a command: no source has sent one within its timeout"
    return waiting(choice.wait) or f"commanded by {choice.source}"


def waiting(wait: Wait) -> str:
    """Return the condition that a source waits for, as text."""
    match wait.what:
        case "nothing":
            return ""
        case "command":
            return "a command"
        case "proof":
            return (
                f"{wait.source} is new: the robot follows it when its commands have arrived with "
                f"steady delays for {wait.seconds:g} s"
            )
        case "late":
            return (
                f"commands of {wait.source} arrive more than {wait.seconds:g} s too late: the "
                "network delays them, or the sender's clock was set; if this goes on, check the "
                "network, then restart the sender"
            )
        case "stalled":
            return f"the daemon stalled: waiting for the next command of {wait.source}"
        case "neutral":
            lasts = f"; it has sent speeds for over {lasting(wait.lasts)}" if wait.lasts else ""
            alone = f", and then no speed for {wait.seconds:g} s," if wait.shared else ""
            return (
                f"send a zero first: {wait.source} must send a zero{alone} before it can drive"
                f"{lasts}{ROS_NEVER if wait.ros else ''}"
            )
        case "zeros":
            note = f"; the speeds of {wait.kept} have no effect" if wait.kept else ""
            zeros = f"only zeros for over {lasting(wait.lasts)}"
            return f"{wait.source} commands zero speed: it has sent {zeros}{note}"
        case "higher":
            return f"{wait.source} has priority: wait until it is silent"
        case "equal":
            return f"{wait.source} has the same priority and came first: wait until it is silent"
        case "senders":
            return (
                f"{many(wait.senders, 'other sender')} of this source must wait until the sender "
                "that drives falls silent"
            )


def missed(periods: int, period_ns: Ns) -> Event:
    """Return the event for successive control periods without a step."""
    when = "one control period" if periods == 1 else f"{periods} successive control periods"
    text = f"late by {periods * period_ns / NS_PER_S:.2f} s: no control step ran in {when}"
    return Event("missed_periods", text, "warning", kind="missed", count=periods, news=False)


def refused(refusal: Refusal) -> Event:
    """Return the event `command_refused`, or `new_sender` if its clock is not proven yet."""
    by, kind = refusal.sender[:MAX_SENDER_LENGTH], refusal.reason
    if kind == "unproven":
        return Event("new_sender", refusal.text, by=by, news=False)
    return Event("command_refused", refusal.text, "warning", by, kind, news=False)


class CommandEvents:
    """Events for a new mode, and for a new source or sender that drives the robot."""

    def __init__(self, mode: Mode) -> None:
        self._mode, self._commander = mode, ("", "")
        self._kept = ""  # source whose speeds have no effect, by the last event

    def changes(self, mode: Mode, choice: Choice, why: str) -> list[Event]:
        """Return the events for a new mode, a new commander, and speeds without effect.

        A commander that drives again after a pause is not new. `why` is the reason of the mode.
        """
        drives, before, last = mode is Mode.DRIVING, self._mode, self._commander
        if drives:
            self._commander = (choice.source, choice.sender)
        self._mode, events = mode, []
        if mode is not before:
            text, by = (chosen(choice), _name(self._commander)) if drives else (why, "")
            events.append(Event("mode", text, by=by, kind=f"{before} -> {mode}"))
        if self._commander != last:
            by = _name(self._commander)
            events.append(Event("commander", "", by=by, kind=f"{_name(last)} -> {by}"))
        return events + self._kept_waiting(mode, choice)

    def _kept_waiting(self, mode: Mode, choice: Choice) -> list[Event]:
        # A warning, once, if the speeds of a source have had no effect for a while.
        wait, source = choice.wait, ""
        if mode not in (Mode.READY, Mode.DRIVING) or wait.what not in ("neutral", "zeros"):
            self._kept = ""
        elif wait.lasts:
            source = wait.source if wait.what == "neutral" else wait.kept
        if not source or source == self._kept:
            return []
        self._kept = source
        by = _name((choice.source, choice.sender))
        return [Event("commands_without_effect", waiting(wait), "warning", by, source)]


def _name(commander: tuple[str, str]) -> str:
    source, sender = commander
    return f"{source} ({sender[:MAX_SENDER_LENGTH]})" if source else "no sender"

"""Creates the events about modes, commanders and commands.

`core/motion/event_throttle.py` decides how often to log.
"""

from __future__ import annotations

from acsard.core.motion.arbiter import Choice
from acsard.core.motion.arbiter_text import chosen, waiting
from acsard.core.motion.modes import Mode
from acsard.core.values import Event, Refusal

MAX_SENDER = 124
"""Characters of a sender's name. A public name has up to 57, and 67 with a certificate. A sender
without an attachment is named after its key, which it may choose."""


def missed(periods: int) -> Event:
    """Return the event for periods that ended without a step."""
    text = f"{periods} in a row"
    return Event("missed_periods", text, "warning", kind="missed", count=periods, news=False)


def refused(refusal: Refusal) -> Event:
    """Return the event for a command that does not count, or not yet."""
    by, kind = refusal.sender[:MAX_SENDER], refusal.reason
    if kind == "unproven":
        return Event("new_sender", refusal.text, by=by, news=False)
    return Event("command_refused", refusal.text, "warning", by, kind, news=False)


class CommandEvents:
    """The mode and the last commander that the log knows."""

    def __init__(self, mode: Mode) -> None:
        self._mode, self._commander = mode, ("", "")
        self._kept = ""
        """The source whose speeds do not move the robot, as last logged."""

    def changes(self, mode: Mode, choice: Choice, why: str) -> list[Event]:
        """Return the events for a change of the mode (with `why`) and of the commander.

        The last commander counts however long ago it commanded.
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
        """Return an event, once, if a source keeps sending speeds that do not move the robot."""
        wait, kept = choice.wait, ""
        if mode not in (Mode.READY, Mode.DRIVING) or wait.what not in ("neutral", "zeros"):
            self._kept = ""
        elif wait.lasts:
            kept = wait.source if wait.what == "neutral" else wait.kept
        if not kept or kept == self._kept:
            return []
        self._kept = kept
        by = _name((choice.source, choice.sender))
        return [Event("commands_without_effect", waiting(wait), "warning", by, kept)]


def _name(commander: tuple[str, str]) -> str:
    source, sender = commander
    return f"{source} ({sender[:MAX_SENDER]})" if source else "nobody"

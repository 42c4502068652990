"""What the log is told of modes, commanders and commands; how often, `drive/tally.py` decides."""

from __future__ import annotations

from acsard.drive.arbiter import Choice
from acsard.drive.modes import Mode
from acsard.drive.words import chosen
from acsard.values import Event, Refusal

MAX_SENDER = 40
"""Characters of a sender's id: he may choose it himself."""


def missed(periods: int) -> Event:
    """So many periods ended without a step."""
    text = f"{periods} in a row"
    return Event("missed_periods", text, "warning", kind="missed", count=periods, news=False)


def refused(refusal: Refusal) -> Event:
    """A command does not count."""
    by, kind = refusal.sender[:MAX_SENDER], refusal.reason
    return Event("command_refused", refusal.text, "warning", by, kind, news=False)


class Told:
    """The mode and the last commander, as far as the log has them."""

    def __init__(self, mode: Mode) -> None:
        self._mode, self._commander = mode, ("", "")

    def changes(self, mode: Mode, choice: Choice, why: str) -> list[Event]:
        """Another mode, and `why`; another commander than the last, however long ago that was."""
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
        return events


def _name(commander: tuple[str, str]) -> str:
    source, sender = commander
    return f"{source} ({sender[:MAX_SENDER]})" if source else "nobody"

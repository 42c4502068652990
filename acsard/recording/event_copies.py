"""Compares the copies of the events in a recording with the events of its steps.

A file has each event twice: in its step, where the replay checks it, and as a message of the
channel `events`, from which the list of recordings makes its summary. A copy that nobody changed
equals the event of the step.
"""

from __future__ import annotations

from itertools import zip_longest

from acsard.core.formatting import printable
from acsard.host.errors import RecordingError
from acsard.recording.end_record import read_end
from acsard.recording.file import Recording, event_of
from acsard.recording.recorded_steps import Step
from acsard.recording.timeline import TimelineEntry, entry_of


class EventCopies:
    """Finds the first copy that differs from the event of its step.

    Call `batch` for each batch of steps, `copy` for each message of the channel `events`, both in
    the order of the file, and `end` after the last message.
    """

    def __init__(self, recording: Recording) -> None:
        self.difference = ""
        """Sentence about the first copy that differs, or "" if all copies are equal."""
        self._recording = recording
        self._events: list[TimelineEntry] = []
        """The events of the last batch of steps."""
        self._copies: list[TimelineEntry] = []
        """The copies that followed that batch."""
        self._number: int | None = None
        """Number of the step after that batch."""
        self._damaged = 0
        """Number of damaged places before that batch."""

    def batch(self, steps: list[Step]) -> None:
        """Take a batch of steps; its copies follow."""
        self._compare(last=False, follows=self._number in (None, steps[0].number))
        self._number, self._damaged = steps[-1].number + 1, self._recording.damaged
        self._events = [
            entry_of(event, step.inputs.now.wall_ns)
            for step in steps
            for event in step.recorded.events
        ]
        self._copies = []

    def copy(self, data: bytes) -> None:
        """Take a message of the channel `events`."""
        try:
            self._copies.append(event_of(self._recording, data))
        except RecordingError as error:
            self._differs(str(error))

    def end(self) -> None:
        """Compare the copies of the last batch, and the summary in the end record."""
        recording = self._recording
        self._compare(last=True)
        if self.difference or not recording.whole:
            return
        end = read_end(recording.path)
        said = recording.compute_end_record().said
        if end is not None and end.said != said:
            self._differs(f'the end of the file says "{end.said}", and its events say "{said}"')

    def _compare(self, last: bool, follows: bool = True) -> None:
        """Compare the copies with the events of the batch before them.

        Copies may be missing at the end of a file that was cut off. If there is damage between this
        batch and the next one, the copies may belong to a batch that cannot be read.

        Args:
            last: true for the copies of the last batch.
            follows: true if no step is missing between this batch and the next one.
        """
        recording = self._recording
        if recording.damaged > self._damaged or not follows:
            return
        missing = last and bool(recording.cut or not recording.ended)
        for event, copy in zip_longest(self._events, self._copies):
            if event != copy:
                if copy is not None or not missing:
                    self._differs(
                        f"the events of the file differ: {_words(event)} in a step, but "
                        f"{_words(copy)} in the channel `events`"
                    )
                return

    def _differs(self, sentence: str) -> None:
        self.difference = self.difference or printable(sentence)


def _words(entry: TimelineEntry | None) -> str:
    if entry is None:
        return "nothing"
    by = f" (by {entry.by})" if entry.by else ""
    return f'"{entry.name}: {entry.text}{by}"'

"""One recording as an MCAP file: written chunk by chunk, read whatever became of it.

Four channels: `steps` (`batch.py`'s), `events` (JSON, one each), `state` (a robot as
`state.py` writes it, first of all where the file does not begin with the daemon), `unfinished`
(what came into the step that a fault of the daemon's own ended). A metadata record says whose it
is, an attachment is its `acsard.toml`. A file that was cut has no end: what is whole of it is read
all the same, and `rewrite` makes a finished file of it.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Literal

import msgspec
from mcap.records import Attachment, Footer, Message, Metadata
from mcap.writer import IndexType, Writer
from msgspec import Struct

from acsard.host.errors import RecordingError
from acsard.record import earlier
from acsard.record.batch import first_of
from acsard.record.closing import END, Closing, Ns, fields
from acsard.record.layout import FORMAT
from acsard.record.steps import UnfinishedError, unfinished
from acsard.record.story import NEWS, Told, summary
from acsard.record.walk import walk
from acsard.values import NS_PER_S

CHUNK_BYTES = 32 * 1024
"""Uncompressed; what is not flushed before is written then."""

MODE = 0o640
"""The service's group may read it."""

FORMATS = (earlier.FORMAT, FORMAT)
"""Of the messages in it: those that are read here."""

Topic = Literal["steps", "events", "state", "unfinished"]

CHANNELS: tuple[Topic, ...] = ("steps", "state", "events", "unfinished")
"""In the order of their numbers, from 1. The first chunk tells them, which may be a damaged one."""


class About(Struct, frozen=True):
    """Whose recording it is."""

    robot: str
    version: str
    """Of acsard."""
    python: str
    mono_ns: Ns
    wall_ns: Ns
    """Both clocks when it began."""
    config: str = ""
    """The `acsard.toml` in force, all keys in it."""
    format: str = FORMAT
    started_ns: Ns = 0
    """Wall-clock time of the daemon's start, which may be hours before; 0 where it is not known."""


class Gist:
    """What a list says of a recording, taken from its messages one by one."""

    def __init__(self, about: About) -> None:
        self._wall_ns = self._last_ns = about.wall_ns
        self._news: list[Told] = []
        self._starts = False

    def message(self, topic: Topic, wall_ns: int, data: bytes) -> None:
        """Any; what an event tells comes by `event`."""
        self._last_ns = max(self._last_ns, wall_ns)
        if topic == "steps":
            self._starts = self._starts or first_of(data) == 0
        elif topic == "unfinished":
            with suppress(UnfinishedError):
                self._starts = self._starts or unfinished(data).number == 0

    def event(self, told: Told) -> None:
        """What happened."""
        if told.name in NEWS:
            self._news.append(told)

    def closing(self, cut: str = "", why: str = "") -> Closing:
        """All of it; `cut`, a word of `CUTS`, and `why` say how the daemon ended, where not as it
        was told to."""
        said = summary(self._news, self._starts)
        return Closing(self._wall_ns, self._last_ns, said, cut, why)


class Writing:
    """A recording that grows. Everything may raise `OSError`; then nothing more is written."""

    def __init__(self, path: Path, about: About, mode: int = MODE) -> None:
        self.path, self._mode = path, mode
        self._gist = Gist(about)
        self._file = os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb")
        try:
            self._open(about)
        except OSError:
            self.close()
            raise

    def _open(self, about: About) -> None:
        os.fchmod(self._file.fileno(), self._mode)  # whatever the umask takes away
        self._writer = Writer(
            self._file, CHUNK_BYTES, index_types=IndexType.ATTACHMENT | IndexType.METADATA
        )
        self._writer.start("acsard", f"acsard {about.version}")
        meta = msgspec.to_builtins(about)
        del meta["config"]
        self._writer.add_metadata("acsard", {key: str(value) for key, value in meta.items()})
        self._writer.add_attachment(
            about.wall_ns, about.wall_ns, "acsard.toml", "text/plain", about.config.encode()
        )
        schema = msgspec.json.encode(msgspec.json.schema(Told))
        of_events = self._writer.register_schema("acsard.Told", "jsonschema", schema)
        self._channels = {
            topic: self._writer.register_channel(
                topic, *(("json", of_events) if topic == "events" else (f"acsard-{topic}", 0))
            )
            for topic in CHANNELS
        }
        self.flush()

    @property
    def size(self) -> int:
        """Bytes written so far."""
        return self._file.tell()

    def add(self, topic: Topic, wall_ns: int, data: bytes) -> None:
        """Write a message; it is in the file when its chunk is full, or by `flush`."""
        self._gist.message(topic, wall_ns, data)
        self._writer.add_message(self._channels[topic], max(0, wall_ns), data, max(0, wall_ns))

    def event(self, told: Told) -> None:
        """Write an event, and remember what a list says of it."""
        wall_ns = int(told.seconds * NS_PER_S)
        self.add("events", wall_ns, msgspec.json.encode(told))
        self._gist.event(told)

    def flush(self) -> None:
        """What was added is a whole chunk, and on the disk."""
        self._writer.flush()
        os.fsync(self._file.fileno())
        if not os.fstat(self._file.fileno()).st_nlink:  # the disk takes it, and nobody will find it
            raise FileNotFoundError(errno.ENOENT, f"{self.path.name} has been removed")

    def finish(self, cut: str = "", why: str = "") -> None:
        """Write the end of the file and close it; `cut` and `why` as for `Gist.closing`."""
        self._writer.add_metadata(END, fields(self._gist.closing(cut, why)))
        self._writer.finish()
        self._file.flush()
        os.fsync(self._file.fileno())
        self._file.close()

    def close(self) -> None:
        """Close it as it is: without an end, if it has none yet."""
        try:
            self._file.close()
        except OSError:
            pass  # a disk that takes nothing takes no rest of a buffer either


class Recording:
    """A file read from its beginning to where it is whole."""

    def __init__(self, path: Path) -> None:
        """Raises `RecordingError` if it cannot be read, or is no recording of acsard's."""
        self.path = path
        try:
            self._data = path.read_bytes()
        except OSError as error:
            raise RecordingError(f"cannot read {path}: {error.strerror}") from None
        self.ended = False
        """It was read to its end, and has one."""
        self.damaged = 0
        """Places in the midst of others, a chunk mostly, that could not be read."""
        self.cut = ""
        """A word of `CUTS` where the daemon has not ended as it was told to."""
        self.why = ""
        """By which fault of its own."""
        self.unfinished: bytes | None = None
        """The step that was ended by it."""
        self.about = self._about()

    @property
    def whole(self) -> bool:
        """It has an end, and nothing before it is damaged."""
        return self.ended and not self.damaged

    def messages(self) -> Iterator[tuple[Topic, int, bytes]]:
        """Topic, wall-clock time in ns and bytes of each; sets what there is to say of all."""
        self.ended, self.damaged, self.cut, self.why = False, 0, "", ""
        self.unfinished = None
        topics: dict[int, Topic] = dict(enumerate(CHANNELS, 1))
        for found in walk(self._data):
            record = found.record
            if isinstance(record, Footer):
                self.ended = True
            elif isinstance(record, Metadata) and record.name == END:
                self.cut, self.why = (record.metadata.get(key, "") for key in ("cut", "why"))
            self.damaged += found.damaged
            for one in found.inside:
                if isinstance(one, Message) and one.channel_id in topics:
                    topic = topics[one.channel_id]
                    if topic == "unfinished":
                        self.unfinished = one.data
                    yield topic, one.log_time, one.data

    def _about(self) -> About:
        found: dict[str, str] = {}
        config = None
        for record, inside, _ in walk(self._data):
            if isinstance(record, Metadata) and record.name == "acsard":
                found = record.metadata
            elif isinstance(record, Attachment) and record.name == "acsard.toml":
                config = record.data.decode(errors="replace")
            elif inside:
                break
        try:
            if config is None:
                raise ValueError("its beginning is missing, or it is another program's MCAP")
            about = msgspec.convert({**found, "config": config}, About, strict=False)
        except (ValueError, msgspec.ValidationError) as error:
            raise RecordingError(f"{self.path} is no recording of acsard: {error}") from None
        if about.format not in FORMATS:
            raise RecordingError(
                f"{self.path} has the format {about.format}, this acsard reads {FORMAT} "
                f"and before: it was written by acsard {about.version}"
            )
        return about


def rewrite(recording: Recording, path: Path, cut: str = "open") -> int:
    """All that is whole of it as a new, finished file; the number of messages.

    `cut` says why, where it has no end. Raises `OSError`, and leaves nothing behind where it
    cannot be written.
    """
    writing = Writing(path, recording.about)
    try:
        count = 0
        for topic, wall_ns, data in recording.messages():
            if topic == "events":
                writing.event(event_of(recording, data))
            else:
                writing.add(topic, wall_ns, data)
            count += 1
        writing.finish(recording.cut or ("" if recording.ended else cut), recording.why)
    except (OSError, RecordingError):
        writing.close()
        path.unlink()
        raise
    return count


def event_of(recording: Recording, data: bytes) -> Told:
    """Raises `RecordingError` where it is none."""
    try:
        return msgspec.json.decode(data, type=Told)
    except msgspec.MsgspecError as error:
        raise RecordingError(f"{recording.path} has an event that is none: {error}") from None

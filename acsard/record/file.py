"""One recording as an MCAP file: written chunk by chunk, and readable even if cut off or damaged.

A file has four channels:
- `steps`: batches of steps, as `batch.py` encodes them.
- `events`: one event per message, in JSON.
- `state`: a robot, as `state.py` writes it. It comes first if the file begins after the daemon.
- `unfinished`: the inputs of the step in which the daemon failed.

A metadata record says which robot and which version recorded it, and an attachment holds its
`acsard.toml`. A file that was cut off has no end. Its whole chunks can still be read, and `rewrite`
makes a finished file of them.
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
from acsard.record.batch import first_of
from acsard.record.closing import END, Closing, Ns, fields
from acsard.record.layout import FORMAT
from acsard.record.steps import UnfinishedError, unfinished
from acsard.record.story import NEWS, Told, summary
from acsard.record.walk import walk
from acsard.values import NS_PER_S

CHUNK_BYTES = 32 * 1024
"""Uncompressed size at which a chunk is written if no flush comes before."""

MODE = 0o640
"""Mode of a recording: the service's group may read it."""

Topic = Literal["steps", "events", "state", "unfinished"]

CHANNELS: tuple[Topic, ...] = ("steps", "state", "events", "unfinished")
"""Channels in the order of their numbers, from 1. The first chunk defines the channels, but it
may be damaged, so the reader relies on this order.
"""


class About(Struct, frozen=True):
    """Metadata of a recording: which robot, program and configuration made it."""

    robot: str
    version: str
    """Version of acsard."""
    python: str
    mono_ns: Ns
    wall_ns: Ns
    """Wall-clock time at which the recording began, ns since 1970; `mono_ns` is the same instant
    by the monotonic clock.
    """
    config: str = ""
    """The `acsard.toml` in force, with every key."""
    format: str = FORMAT
    started_ns: Ns = 0
    """Wall-clock time of the daemon's start, ns since 1970, perhaps hours before; 0 if unknown."""


class Gist:
    """Summary of a recording, collected from its messages."""

    def __init__(self, about: About) -> None:
        self._wall_ns = self._last_ns = about.wall_ns
        self._news: list[Told] = []
        self._starts = False

    def message(self, topic: Topic, wall_ns: int, data: bytes) -> None:
        """Take a message of any channel. The content of an event comes through `event`."""
        self._last_ns = max(self._last_ns, wall_ns)
        if topic == "steps":
            self._starts = self._starts or first_of(data) == 0
        elif topic == "unfinished":
            with suppress(UnfinishedError):
                self._starts = self._starts or unfinished(data).number == 0

    def event(self, told: Told) -> None:
        """Take an event for the summary."""
        if told.name in NEWS:
            self._news.append(told)

    def closing(self, cut: str = "", why: str = "") -> Closing:
        """Return the closing of the file.

        `cut` is a key of `CUTS` and `why` its explanation if the daemon did not end in the ordinary
        way.
        """
        said = summary(self._news, self._starts)
        return Closing(self._wall_ns, self._last_ns, said, cut, why)


class Writing:
    """A recording that is being written.

    Every method may raise `OSError`, and after that the object must not be written to.
    """

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
        # The umask may have removed bits of the mode.
        os.fchmod(self._file.fileno(), self._mode)
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
        """Number of bytes written so far."""
        return self._file.tell()

    def add(self, topic: Topic, wall_ns: int, data: bytes) -> None:
        """Add a message. It reaches the file when its chunk is full, or by `flush`."""
        self._gist.message(topic, wall_ns, data)
        self._writer.add_message(self._channels[topic], max(0, wall_ns), data, max(0, wall_ns))

    def event(self, told: Told) -> None:
        """Add an event, and take it for the summary."""
        wall_ns = int(told.seconds * NS_PER_S)
        self.add("events", wall_ns, msgspec.json.encode(told))
        self._gist.event(told)

    def flush(self) -> None:
        """Write the messages added so far as a whole chunk, and sync it to the disk."""
        self._writer.flush()
        os.fsync(self._file.fileno())
        # The disk accepts the data, but nobody can find a file without a name.
        if not os.fstat(self._file.fileno()).st_nlink:
            raise FileNotFoundError(errno.ENOENT, f"{self.path.name} has been removed")

    def finish(self, cut: str = "", why: str = "") -> None:
        """Write the end of the file and close it; `cut` and `why` are as for `Gist.closing`."""
        self._writer.add_metadata(END, fields(self._gist.closing(cut, why)))
        self._writer.finish()
        self._file.flush()
        os.fsync(self._file.fileno())
        self._file.close()

    def close(self) -> None:
        """Close the file without writing an end."""
        try:
            self._file.close()
        except OSError:
            # A disk that refuses to write does not take the rest of a buffer either.
            pass


class Recording:
    """A recording read from a file, as far as the file is whole."""

    def __init__(self, path: Path) -> None:
        """Read the file.

        Raises `RecordingError` if it cannot be read or is not a recording of acsard.
        """
        self.path = path
        try:
            self._data = path.read_bytes()
        except OSError as error:
            raise RecordingError(f"cannot read {path}: {error.strerror}") from None
        self.ended = False
        """True once the file was read to its end, and it has an end record."""
        self.damaged = 0
        """Number of damaged places, mostly chunks, between readable ones."""
        self.cut = ""
        """Key of `CUTS` if the daemon did not end in the ordinary way, else ""."""
        self.why = ""
        """For the cause `bug`: the step in which the daemon failed, and the exception."""
        self.unfinished: bytes | None = None
        """Encoded inputs of the step in which the daemon failed."""
        self.about = self._about()

    @property
    def whole(self) -> bool:
        """True if the file has an end and nothing before it is damaged."""
        return self.ended and not self.damaged

    def messages(self) -> Iterator[tuple[Topic, int, bytes]]:
        """Yield the topic, the wall-clock time in ns and the bytes of each message.

        Reading also sets `ended`, `damaged`, `cut`, `why` and `unfinished`.
        """
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
        if about.format != FORMAT:
            raise RecordingError(
                f"{self.path} has the format {about.format}, this acsard reads "
                f"{FORMAT}: it was written by acsard {about.version}"
            )
        return about


def rewrite(recording: Recording, path: Path, cut: str = "open") -> int:
    """Write all readable messages to a new, finished file at `path`, and return their number.

    `cut` is the cause to store if the recording lacks its end. Raises `OSError`, or
    `RecordingError` for an event that cannot be decoded; then no file is left at `path`.
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
    """Decode an event; raise `RecordingError` if the bytes are not an event."""
    try:
        return msgspec.json.decode(data, type=Told)
    except msgspec.MsgspecError as error:
        raise RecordingError(f"{recording.path} has an event that is none: {error}") from None

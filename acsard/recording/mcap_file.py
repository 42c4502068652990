"""Writes and reads one recording as an MCAP file, to which the writer adds every second.

It has the channels `steps` (batches of `rows.py`), `events` (JSON), `state` (a `Robot` of
`state.py` in its own chunk, first if the file begins after the daemon's first step), and
`unfinished` (inputs of a step in which the daemon failed). A metadata record names robot and
version, and an attachment is the `acsard.toml`: both stand at the beginning and, in a finished
file, again before the end. A file that was cut off has all that was synced, and `rewrite` finishes
a copy.
"""

from __future__ import annotations

import errno
import os
import stat
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Literal

import msgspec
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)
from msgspec import Struct

from acsard.core.formatting import many
from acsard.core.values import NS_PER_S, WallNs
from acsard.host.errors import MSGSPEC_ERRORS, RecordingError
from acsard.recording.end_record import (
    END_RECORD_NAME,
    EndRecord,
    Ns,
    as_metadata,
    end_in,
    ending_text,
)
from acsard.recording.mcap_records import GROWING_HEAD, MAGIC, GrowingChunk, Message, encoded, walk
from acsard.recording.mcap_timeline import INCIDENT_WORDS, TimelineEntry, is_serious, summary
from acsard.recording.recorded_steps import Unfinished, UnfinishedError, unfinished
from acsard.recording.rows import FORMAT, Batch, Row, first_of
from acsard.recording.state import Checkpoint

# Longest time in an MCAP chunk: longer ones save little, and damage to one would destroy more.
CHUNK_NS = 10 * NS_PER_S

CHUNK_BYTES = 1 << 20  # uncompressed; ten seconds of driving take 160 000

FILE_MODE = 0o640  # the group of the daemon's service may read

Topic = Literal["steps", "events", "state", "unfinished"]

# In the order of their MCAP numbers from 1, because the records that say so may be damaged.
CHANNELS: tuple[Topic, ...] = ("steps", "state", "events", "unfinished")

CHANNEL_NUMBERS = {topic: number for number, topic in enumerate(CHANNELS, 1)}

# Metadata for people with another MCAP program.
HOW_TO_READ = Metadata(
    "how to read this file",
    {
        "export": "`acsard recording export FILE` writes this recording as ROS 2 messages in MCAP, "
        "for Foxglove and PlotJuggler; with --rosbag2 as a bag, with --csv as a table",
        "show": "`acsard recording show FILE` prints the events as text",
        "replay": "`acsard recording replay FILE` runs the steps again and compares the results",
        "channels": "the metadata of each channel says what its messages are",
        "acsard.toml": "the configuration of the robot, as an attachment",
    },
)

CHANNEL_DESCRIPTIONS: dict[Topic, str] = {
    "steps": "the inputs and outputs of the control steps of about a second, in MessagePack: an "
    f"array of {', '.join(Batch.__struct_fields__)}; each of the rows is a step, an array of "
    f"{', '.join(Row.__struct_fields__)}; the module acsard.recording.rows documents each field",
    "state": "the robot between two steps, in MessagePack: an array of "
    f"{', '.join(Checkpoint.__struct_fields__)}; its element data is a Python pickle, which "
    "only acsard reads safely",
    "events": "an event, in JSON; the schema describes it",
    "unfinished": "the inputs of the step in which the daemon failed, in MessagePack: a map of "
    f"{', '.join(Unfinished.__struct_fields__)}",
}

UNFINISHED = "the file has no end: it was cut off, or is still being recorded"

EVENTS_SCHEMA = 1  # MCAP schema of `events`


class About(Struct, frozen=True):
    """Which robot, program and configuration made a recording."""

    robot: str
    version: str  # of acsard
    python: str
    mono_ns: Ns
    wall_ns: Ns
    config: str = ""  # every key, as an `acsard.toml`
    format: str = FORMAT  # `rows.FORMAT`
    started_ns: Ns = 0  # start of the daemon, maybe hours before; 0 if unknown


class EndRecordBuilder:
    """Builds the end record of a recording from its messages."""

    def __init__(self, about: About) -> None:
        self._wall_ns = self._last_ns = self._earliest_ns = about.wall_ns
        self._incidents: list[TimelineEntry] = []
        self._starts = False  # with the daemon's first step

    def message(self, topic: Topic, wall_ns: WallNs, data: bytes) -> None:
        """Add a message of any channel; an event must also go to `event`."""
        self._last_ns = max(self._last_ns, wall_ns)
        self._earliest_ns = min(self._earliest_ns, wall_ns)
        if topic == "steps":
            self._starts = self._starts or first_of(data) == 0
        elif topic == "unfinished":
            with suppress(UnfinishedError):
                self._starts = self._starts or unfinished(data).number == 0

    def event(self, event: TimelineEntry) -> None:
        """Add an event to the summary, if its name is in `INCIDENT_WORDS`."""
        if event.name in INCIDENT_WORDS:
            self._incidents.append(event)

    def end_record(self, cut: str = "", why: str = "") -> EndRecord:
        """Return the end record so far; `cut` is a key of `CUT_TEXTS` or ""."""
        text, serious = summary(self._incidents, self._starts), is_serious(self._incidents)
        return EndRecord(self._wall_ns, self._last_ns, text, cut, why, self._earliest_ns, serious)


class Index:
    """The statistics and the index at the end of an MCAP file."""

    def __init__(self) -> None:
        self._places: list[McapRecord] = []
        self._totals = Statistics(
            attachment_count=0,
            channel_count=len(CHANNELS),
            channel_message_counts=dict.fromkeys(CHANNEL_NUMBERS.values(), 0),
            chunk_count=0,
            message_count=0,
            message_start_time=0,
            message_end_time=0,
            metadata_count=0,
            schema_count=1,
        )

    def message(self, channel: int, wall_ns: WallNs) -> None:
        """Count a message of the MCAP channel, at a time of at least 0."""
        totals = self._totals
        first_ns = totals.message_start_time if totals.message_count else wall_ns
        totals.message_start_time = min(first_ns, wall_ns)
        totals.message_end_time = max(totals.message_end_time, wall_ns)
        totals.message_count += 1
        counts = totals.channel_message_counts
        counts[channel] = counts.get(channel, 0) + 1

    def chunk(self) -> None:
        self._totals.chunk_count += 1

    def record(self, record: McapRecord, at: int, length: int) -> None:
        """Add a metadata record or an attachment at this offset; ignore other records."""
        if isinstance(record, Metadata):
            self._totals.metadata_count += 1
            self._places.append(MetadataIndex(at, length, record.name))
        elif isinstance(record, Attachment):
            self._totals.attachment_count += 1
            times, size = (record.log_time, record.create_time), len(record.data)
            kind = record.media_type
            self._places.append(AttachmentIndex(at, length, *times, size, record.name, kind))

    def records(self) -> list[McapRecord]:
        return [self._totals, *self._places]


class RecordingWriter:
    """A recording file that is being written. After an `OSError`, call only `close`."""

    def __init__(self, path: Path, about: About, mode: int = FILE_MODE) -> None:
        # Raises `OSError`: a file at `path` stays, and a new one that the disk refuses is deleted.
        self.path, self._mode = path, mode
        self._end_builder = EndRecordBuilder(about)
        self._about = _about_records(about)
        self._index = Index()
        self._chunk: GrowingChunk | None = None
        self._chunk_at: int | None = None  # offset of the header of the growing chunk
        self._file = os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb")
        try:
            self._open(about)
        except OSError:
            self.close()
            # On a full disk, the caller may need the room that this file takes.
            path.unlink(missing_ok=True)
            raise

    def _open(self, about: About) -> None:
        # The umask may have removed bits of the mode.
        os.fchmod(self._file.fileno(), self._mode)
        self._file.write(MAGIC)
        self._write(Header("acsard", f"acsard {about.version}"))
        for record in (HOW_TO_READ, *self._about, *_definitions()):
            self._write(record)
        self.flush()

    def _write(self, record: McapRecord) -> None:
        at = self._file.tell()
        self._index.record(record, at, self._file.write(encoded(record)))

    @property
    def size(self) -> int:
        """Number of bytes in the file, before the next `flush`."""
        return self._file.tell()

    def add(self, topic: Topic, wall_ns: WallNs, data: bytes) -> None:
        """Add a message, which is written at the next `flush`; use `event` for events."""
        self._end_builder.message(topic, wall_ns, data)
        wall_ns = max(0, wall_ns)
        chunk = self._chunk
        if chunk is not None and (
            topic == "state"
            or chunk.size >= CHUNK_BYTES
            or abs(wall_ns - chunk.first_ns) >= CHUNK_NS
        ):
            self.end_chunk()
        self._chunk = self._chunk or GrowingChunk()
        self._chunk.add(Message(CHANNEL_NUMBERS[topic], wall_ns, data))
        self._index.message(CHANNEL_NUMBERS[topic], wall_ns)
        if topic == "state":
            self.end_chunk()

    def event(self, event: TimelineEntry) -> None:
        """Add an event to its channel and to the summary of the end record."""
        wall_ns = int(event.seconds * NS_PER_S)
        self.add("events", wall_ns, msgspec.json.encode(event))
        self._end_builder.event(event)

    def flush(self) -> None:
        """Write all messages and sync the file. Raises `FileNotFoundError` if it was deleted."""
        if self._chunk is not None and self._chunk.has_unwritten:
            self._append(self._chunk.take())
        self._sync()
        # The disk also accepts data for a deleted file, but this data is lost.
        if not os.fstat(self._file.fileno()).st_nlink:
            raise FileNotFoundError(errno.ENOENT, f"{self.path.name} has been removed")

    def _append(self, data: bytes) -> None:
        if self._chunk_at is None:
            self._chunk_at = self._file.tell()
            self._file.write(GROWING_HEAD)
        self._file.write(data)

    def _sync(self) -> None:
        self._file.flush()
        os.fsync(self._file.fileno())

    def end_chunk(self) -> None:
        """End the chunk, so that the next message begins a new one."""
        if self._chunk is None:
            return
        last, head = self._chunk.end()
        self._append(last)
        end = self._file.tell()
        assert self._chunk_at is not None
        self._file.seek(self._chunk_at)
        self._file.write(head)
        self._file.seek(end)
        self._chunk = self._chunk_at = None
        self._index.chunk()

    def finish(self, cut: str = "", why: str = "") -> None:
        """Write the end and close the file; `cut` is a key of `CUT_TEXTS` or ""."""
        self.end_chunk()
        for record in self._about:
            self._write(record)
        last, at = self._end_builder.end_record(cut, why), self._file.tell()
        self._file.write(file_end(last, self._index, at, _definitions()))
        self._sync()
        self._file.close()

    def close(self) -> None:
        """Close the file without an end record; this raises no `OSError`."""
        try:
            self._file.close()
        except OSError:
            # A disk that refuses to write also refuses the rest of the buffer.
            pass


def file_end(
    last: EndRecord, index: Index, at: int, definitions: Iterable[McapRecord] = ()
) -> bytes:
    """Return the last bytes of an MCAP file, at this offset: end record, summary and footer.

    The end record is added to `index`. `definitions` are the schema and the channels.
    """
    record = Metadata(END_RECORD_NAME, as_metadata(last))
    data = encoded(record)
    index.record(record, at, len(data))
    data += encoded(DataEnd(0))
    # In MCAP a checksum of 0 means that the checksum is absent.
    footer = Footer(at + len(data), 0, 0)
    return data + encoded(*definitions, *index.records(), footer) + MAGIC


def _about_records(about: About) -> list[McapRecord]:
    meta = {key: str(value) for key, value in msgspec.to_builtins(about).items()}
    text, at_ns = meta.pop("config").encode(), about.wall_ns
    return [
        Metadata("acsard", {**meta, "checksum": str(_checksum(meta))}),
        Attachment(at_ns, at_ns, "acsard.toml", "text/plain", text),
    ]


def _checksum(metadata: Mapping[str, str]) -> int:
    # CRC-32, which MCAP does not define for metadata.
    return zlib.crc32(msgspec.json.encode(metadata, order="sorted"))


def _is_intact(metadata: Mapping[str, str]) -> bool:
    rest = {key: value for key, value in metadata.items() if key != "checksum"}
    return metadata.get("checksum", str(_checksum(rest))) == str(_checksum(rest))


def _definitions() -> Iterator[McapRecord]:
    schema = msgspec.json.encode(msgspec.json.schema(TimelineEntry))
    yield Schema(EVENTS_SCHEMA, schema, "jsonschema", "acsard.TimelineEntry")
    for topic, number in CHANNEL_NUMBERS.items():
        events = topic == "events"
        encoding, schema_id = ("json", EVENTS_SCHEMA) if events else (f"acsard-{topic}", 0)
        yield Channel(number, topic, encoding, {"content": CHANNEL_DESCRIPTIONS[topic]}, schema_id)


class Recording:
    """A recording read from a file, without its damaged parts.

    Only after the last message of `messages()` do `ended`, `damaged`, `cut`, `why`, `unfinished`
    and the properties below have their final values.
    """

    def __init__(self, path: Path) -> None:
        # Raises `RecordingError`.
        self.path = path
        self.paths = [path]  # several only in a `Series`
        try:
            if not stat.S_ISREG(path.stat().st_mode):
                raise OSError(errno.EINVAL, "it is not a file")
            self._data = path.read_bytes()
        except MemoryError:
            raise RecordingError(
                f"cannot read {path}: it is larger than the free memory; copy it to a computer "
                "with more memory"
            ) from None
        except OSError as error:
            raise RecordingError(
                f"cannot read {path}: {error.strerror}; `acsard recording` lists the recordings"
            ) from None
        self.ended = False  # it has an end record
        self.damaged = 0  # damaged places, without the incomplete end of a cut file
        self.cut = ""  # key of `CUT_TEXTS`; "" for an ordinary end, and without one
        self.why = ""  # of `bug`: the exception, and the number of a failed step
        self.unfinished: bytes | None = None  # inputs of the step in which the daemon failed
        self.about = self._about()

    @property
    def is_intact(self) -> bool:
        return self.ended and not self.damaged

    @property
    def ending(self) -> str:
        """How the recording was cut off; "" if the daemon ended normally."""
        if not self.ended:
            return UNFINISHED
        return ending_text(self.cut, self.why)

    @property
    def missing_text(self) -> str:
        """The number of damaged places and `ending`, for the user; "" if nothing is missing."""
        places = many(self.damaged, "damaged place is", "damaged places are")
        damaged = f"{places} left out" if self.damaged else ""
        return "; ".join(filter(None, [damaged, self.ending]))

    def compute_end_record(self) -> EndRecord:
        """Return an end record that is built from the messages, which do not show `cut`."""
        builder = EndRecordBuilder(self.about)
        for topic, wall_ns, data in self.messages():
            builder.message(topic, wall_ns, data)
            if topic == "events":
                with suppress(RecordingError):  # omit only the event that cannot be decoded
                    builder.event(event_of(self, data))
        return builder.end_record()

    def messages(self) -> Iterator[tuple[Topic, WallNs, bytes]]:
        """Yield topic, wall-clock time and data of each readable message."""
        self.ended, self.damaged, self.cut, self.why = False, 0, "", ""
        self.unfinished = None
        topics = {number: topic for topic, number in CHANNEL_NUMBERS.items()}
        for place in walk(self._data):
            record = place.record
            if isinstance(record, Footer):
                self.ended = True
            elif isinstance(record, Metadata) and record.name == END_RECORD_NAME:
                self.cut, self.why = (record.metadata.get(key, "") for key in ("cut", "why"))
            for channel, wall_ns, data in place.messages:
                if channel in topics:
                    topic = topics[channel]
                    if topic == "unfinished":
                        self.unfinished = data
                    yield topic, wall_ns, data
            # In a damaged chunk, all readable messages precede the damage.
            self.damaged += place.damaged
        if not self.ended and (end := end_in(self._data)) is not None:
            # No complete chunk follows the damage, so `walk` took it for the end of a cut file.
            self.ended, self.cut, self.why = True, end.cut, end.why
            self.damaged += 1

    def _about(self) -> About:
        metadata: dict[str, str] = {}
        config, intact = None, False
        # If the beginning is damaged, read the copies at the end of a finished file.
        is_finished = end_in(self._data) is not None
        for place in walk(self._data):
            record = place.record
            if isinstance(record, Metadata) and record.name == "acsard":
                if not metadata or _is_intact(record.metadata):
                    metadata = record.metadata
                    intact = _is_intact(metadata)
            elif isinstance(record, Attachment) and record.name == "acsard.toml":
                if config is None:
                    config = record.data.decode(errors="replace")
            elif place.messages and ((intact and config is not None) or not is_finished):
                break
        try:
            if config is None:
                raise ValueError(
                    "the beginning of the file is missing, or another program wrote this MCAP file"
                )
            about = msgspec.convert({**metadata, "config": config}, About, strict=False)
        except (ValueError, msgspec.ValidationError) as error:
            raise RecordingError(f"{self.path} is not a recording of acsard: {error}") from None
        if about.format != FORMAT:
            raise RecordingError(
                f"{self.path} has the format {about.format}, but this acsard reads the format "
                f"{FORMAT}: read the file with acsard {about.version}, which wrote it"
            )
        return about


def rewrite(recording: Recording, path: Path, cut: str = "open") -> int:
    """Copy the readable messages to a new, finished file, and return their number.

    Only an unfinished recording gets the cause `cut`. An error deletes the new file: `OSError`, or
    `RecordingError` for an event that cannot be decoded.
    """
    writing = RecordingWriter(path, recording.about)
    try:
        count = 0
        for topic, wall_ns, data in recording.messages():
            if topic == "events":
                writing.event(event_of(recording, data))
            else:
                writing.add(topic, wall_ns, data)
            count += 1
        writing.finish(recording.cut or ("" if recording.ended else cut), recording.why)
    except BaseException:
        writing.close()
        path.unlink()
        raise
    return count


def is_part(part: Recording, recording: Recording) -> bool:
    """Return whether `recording` has all of `part`, and can replace it."""
    if part.about != recording.about:
        return False
    return Counter(part.messages()) <= Counter(recording.messages())


def event_of(recording: Recording, data: bytes) -> TimelineEntry:
    """Decode a message of the channel `events`. Raises `RecordingError`."""
    try:
        return msgspec.json.decode(data, type=TimelineEntry)
    except MSGSPEC_ERRORS as error:
        raise RecordingError(
            f"{recording.path} has an event that cannot be read: {error}"
        ) from None

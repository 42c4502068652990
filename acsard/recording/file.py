"""Writes and reads one recording as an MCAP file.

The writer adds data every second. If a file is cut off or damaged, the undamaged data stays
readable.

A file has four channels:
- `steps`: batches of steps, as `rows.py` encodes them.
- `events`: one event per message, in JSON.
- `state`: the complete `Robot` object between two steps, as `state.py` encodes it. Each state has
  its own chunk, so that damage to a chunk of steps does not destroy a state. A file that begins
  after the daemon's first step has a `state` message first.
- `unfinished`: the inputs of the step in which the daemon failed.

A metadata record names the robot and the version of acsard, and an attachment contains the
`acsard.toml`. No step can be replayed without them, so a finished file has a copy of both at its
beginning and another copy before its end.

A file that was cut off has no end record, but all data that was synced to the disk can still be
read. `rewrite` copies the messages of such a file to a new, finished file.
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
from acsard.core.values import NS_PER_S
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
from acsard.recording.recorded_steps import Unfinished, UnfinishedError, unfinished
from acsard.recording.rows import FORMAT, Batch, Row, first_of
from acsard.recording.state import Checkpoint
from acsard.recording.timeline import INCIDENT_WORDS, TimelineEntry, summary

CHUNK_NS = 10 * NS_PER_S
"""Longest time between the first and the last message of an MCAP chunk, ns. Longer chunks would
save little space, and damage to a single chunk would destroy more data."""

CHUNK_BYTES = 1 << 20
"""Uncompressed size at which a chunk ends, bytes. Ten seconds of driving take 160 000 bytes."""

FILE_MODE = 0o640
"""File mode of a recording: 0o640. The group of the daemon's service may read the file."""

Topic = Literal["steps", "events", "state", "unfinished"]

CHANNELS: tuple[Topic, ...] = ("steps", "state", "events", "unfinished")
"""Channels in the order of their MCAP channel numbers, which begin with 1. The reader relies on
this order, because the records that define the channels may be damaged."""

CHANNEL_NUMBERS = {topic: number for number, topic in enumerate(CHANNELS, 1)}

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
"""Metadata record for people who open a recording with another MCAP program."""

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
"""Text in the file that describes the messages of a channel, by channel."""

UNFINISHED = "the file has no end: it was cut off, or is still being recorded"
"""Text of `Recording.ending` for a file without an end record."""

EVENTS_SCHEMA = 1
"""MCAP schema number of the channel `events`. The other channels have no schema."""


class About(Struct, frozen=True):
    """Metadata of a recording: which robot, program and configuration made it."""

    robot: str
    version: str
    """Version of acsard."""
    python: str
    mono_ns: Ns
    """Monotonic time at which the recording began, ns."""
    wall_ns: Ns
    """Wall-clock time at which the recording began, ns since 1970."""
    config: str = ""
    """Configuration at the beginning of the recording, as an `acsard.toml` with every key."""
    format: str = FORMAT
    """Version of the encoding of the messages, as in `rows.FORMAT`."""
    started_ns: Ns = 0
    """Wall-clock time at which the daemon started, ns since 1970; 0 if this time is not known. The
    daemon may have started hours before this recording began."""


class EndRecordBuilder:
    """Builds the end record of a recording from its messages."""

    def __init__(self, about: About) -> None:
        self._wall_ns = self._last_ns = self._earliest_ns = about.wall_ns
        self._incidents: list[TimelineEntry] = []
        self._starts = False
        """True if the messages so far include the daemon's first step."""

    def message(self, topic: Topic, wall_ns: int, data: bytes) -> None:
        """Add a message of any channel. `wall_ns` is the message's wall-clock time, ns since 1970.

        The caller must also decode each message of the channel `events`, and pass it to `event`.
        """
        self._last_ns = max(self._last_ns, wall_ns)
        self._earliest_ns = min(self._earliest_ns, wall_ns)
        if topic == "steps":
            self._starts = self._starts or first_of(data) == 0
        elif topic == "unfinished":
            with suppress(UnfinishedError):
                self._starts = self._starts or unfinished(data).number == 0

    def event(self, event: TimelineEntry) -> None:
        """Add an event to the summary. Events whose name is not in `INCIDENT_WORDS` are ignored."""
        if event.name in INCIDENT_WORDS:
            self._incidents.append(event)

    def end_record(self, cut: str = "", why: str = "") -> EndRecord:
        """Return the end record of a recording with the messages that were added so far.

        Args:
            cut: the cause that cut off the recording, a key of `CUT_TEXTS`; "" for an ordinary end.
            why: an explanation of this cause in words, or "".
        """
        text = summary(self._incidents, self._starts)
        return EndRecord(self._wall_ns, self._last_ns, text, cut, why, self._earliest_ns)


class Index:
    """Collects the statistics and the index for the summary section at the end of an MCAP file."""

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

    def message(self, channel: int, wall_ns: int) -> None:
        """Count a message of the MCAP channel with the number `channel`.

        `wall_ns` is the message's wall-clock time in ns since 1970, at least 0.
        """
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
        """Add a metadata record or an attachment to the index. Ignore a record of another kind.

        `at` is the offset in the file at which the record begins, bytes. `length` is the length of
        the record, bytes.
        """
        if isinstance(record, Metadata):
            self._totals.metadata_count += 1
            self._places.append(MetadataIndex(at, length, record.name))
        elif isinstance(record, Attachment):
            self._totals.attachment_count += 1
            times, size = (record.log_time, record.create_time), len(record.data)
            kind = record.media_type
            self._places.append(AttachmentIndex(at, length, *times, size, record.name, kind))

    def records(self) -> list[McapRecord]:
        """Return the MCAP records of the summary section: the statistics and the index."""
        return [self._totals, *self._places]


class RecordingWriter:
    """A recording file that is being written.

    If the disk refuses to write, a method raises `OSError`. After that, call only `close`.
    """

    def __init__(self, path: Path, about: About, mode: int = FILE_MODE) -> None:
        """Create a file at `path`, and write the metadata `about` to it.

        `mode` is the file mode. Raises `OSError` if a file already exists at `path`; that file
        stays unchanged. Also raises `OSError` if the disk refuses to write; the new file is then
        deleted.
        """
        self.path, self._mode = path, mode
        self._end_builder = EndRecordBuilder(about)
        self._about = _about_records(about)
        self._index = Index()
        self._chunk: GrowingChunk | None = None
        self._chunk_at: int | None = None
        """Offset in the file of the header of the chunk that is being written, bytes. None if this
        header is not written yet."""
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
        """Number of bytes that were written to the file so far.

        Messages that the next `flush` will write do not count.
        """
        return self._file.tell()

    def add(self, topic: Topic, wall_ns: int, data: bytes) -> None:
        """Add a message to the channel `topic`. `wall_ns` is its wall-clock time, ns since 1970.

        The message is written to the file at the next `flush`, or when its chunk ends. For the
        channel `events`, call the method `event` instead: it also counts the event for the end
        record.
        """
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
        """Add an event to the channel `events`, and to the summary in the end record."""
        wall_ns = int(event.seconds * NS_PER_S)
        self.add("events", wall_ns, msgspec.json.encode(event))
        self._end_builder.event(event)

    def flush(self) -> None:
        """Write all added messages to the file, and sync the file to the disk.

        Raises `FileNotFoundError` if the file was deleted.
        """
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
        """End the chunk that is being written. The next message begins a new chunk."""
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
        """Write the end record and the MCAP summary section, and close the file.

        Args:
            cut: the cause that cut off the recording, a key of `CUT_TEXTS`; "" for an ordinary end.
            why: an explanation of this cause in words, or "".
        """
        self.end_chunk()
        for record in self._about:
            self._write(record)
        last, at = self._end_builder.end_record(cut, why), self._file.tell()
        self._file.write(file_end(last, self._index, at, _definitions()))
        self._sync()
        self._file.close()

    def close(self) -> None:
        """Close the file without an end record. This method does not raise `OSError`."""
        try:
            self._file.close()
        except OSError:
            # A disk that refuses to write also refuses the rest of the buffer.
            pass


def file_end(
    last: EndRecord, index: Index, at: int, definitions: Iterable[McapRecord] = ()
) -> bytes:
    """Return the last bytes of an MCAP file: end record, summary section and footer.

    Args:
        last: the end record.
        index: the statistics and the index of the file. The end record is added to it.
        at: the offset in the file at which the caller writes the bytes.
        definitions: the schema and the channels, for the summary section.
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
    """Return the CRC-32 of a metadata record, for which MCAP defines no checksum."""
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
    """A recording read from a file. Damaged parts of the file are skipped."""

    def __init__(self, path: Path) -> None:
        """Read the file. Raises `RecordingError` if it is not a readable recording of acsard."""
        self.path = path
        self.paths = [path]
        """Paths of the files of the recording, in order. Only a `Series` has more than one file."""
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
        self.ended = False
        """True if the file is finished, so that it has an end record. A finished file may still be
        damaged. Use this attribute only after `messages()` has yielded the last message."""
        self.damaged = 0
        """Number of damaged places that were skipped, mostly MCAP chunks. The incomplete end of a
        file that was cut off does not count."""
        self.cut = ""
        """Cause that cut off the recording, a key of `CUT_TEXTS`; "" if the daemon ended normally
        or if the file is not finished."""
        self.why = ""
        """Text about the internal error that ended the daemon: the exception, and the number of the
        control step if a step failed. It is "" if `cut` is not "bug"."""
        self.unfinished: bytes | None = None
        """Encoded inputs of the step in which the daemon failed; None if no step failed."""
        self.about = self._about()

    @property
    def is_intact(self) -> bool:
        """True if the file is finished and undamaged.

        Use this property only after `messages()` has yielded the last message.
        """
        return self.ended and not self.damaged

    @property
    def ending(self) -> str:
        """Text that says how the recording was cut off; "" if the daemon ended normally.

        Use this property only after `messages()` has yielded the last message.
        """
        if not self.ended:
            return UNFINISHED
        return ending_text(self.cut, self.why)

    @property
    def missing_text(self) -> str:
        """Text that tells the user about missing data: the number of damaged places, and `ending`.

        The text is "" if the file is undamaged and the daemon ended normally. Use this property
        only after `messages()` has yielded the last message.
        """
        places = many(self.damaged, "damaged place is", "damaged places are")
        damaged = f"{places} left out" if self.damaged else ""
        return "; ".join(filter(None, [damaged, self.ending]))

    def compute_end_record(self) -> EndRecord:
        """Read all messages of the recording, and return an end record that is built from them.

        The field `cut` of the end record is "", because the messages do not show the cause.
        """
        builder = EndRecordBuilder(self.about)
        for topic, wall_ns, data in self.messages():
            builder.message(topic, wall_ns, data)
            if topic == "events":
                with suppress(RecordingError):  # omit only the event that cannot be decoded
                    builder.event(event_of(self, data))
        return builder.end_record()

    def messages(self) -> Iterator[tuple[Topic, int, bytes]]:
        """Yield the triple (topic, wall-clock time in ns since 1970, data) of each message.

        Messages in damaged parts of the file are skipped. After the last message, the attributes
        `ended`, `damaged`, `cut`, `why` and `unfinished` have their final values.
        """
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
            # The file is finished, but damaged before its end. No complete chunk follows the
            # damage, so `walk` took the damage for the end of a file that was cut off.
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
    """Copy all readable messages to a new, finished file at `path`, and return their number.

    If the recording is not finished, the end record of the new file names the cause `cut`, a key of
    `CUT_TEXTS`. Otherwise the new end record has the cause of the recording's own end record. If an
    error occurs, the new file is deleted.

    Raises:
        OSError: a file already exists at `path`, or the disk refuses to write.
        RecordingError: an event cannot be decoded.
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
    """Return whether `recording` has the metadata and all the messages of `part`.

    If it has, the file of `recording` can replace the file of `part` without loss of data.
    """
    if part.about != recording.about:
        return False
    return Counter(part.messages()) <= Counter(recording.messages())


def event_of(recording: Recording, data: bytes) -> TimelineEntry:
    """Decode a message of the channel `events`. Raises `RecordingError` if it is damaged."""
    try:
        return msgspec.json.decode(data, type=TimelineEntry)
    except MSGSPEC_ERRORS as error:
        raise RecordingError(
            f"{recording.path} has an event that cannot be read: {error}"
        ) from None

"""Computes the calibration from the recorded drive that `acsard calibrate --log` names.

The drive is a CSV file, a black-box recording of acsard, or a ROS 2 bag in MCAP.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from mcap.exceptions import EndOfFile
from mcap.reader import NonSeekingReader
from msgspec.structs import replace

from acsard.calibration import ros_bag_log
from acsard.calibration.log_table import CSV_ADVICE, LogError, Table, attach_notes, read
from acsard.calibration.multipliers import Tape
from acsard.calibration.ros_bag_log import GUIDE_PAGE, Choice, RosMessage
from acsard.calibration.runs import runs
from acsard.calibration.solve import Calibration, calibrate
from acsard.core.config.settings import Config
from acsard.host.errors import MendableError, RecordingError
from acsard.recording.export import calibration_csv
from acsard.recording.file import Recording
from acsard.recording.mcap_records import DAMAGE_ERRORS, MAGIC

MAX_FILE_BYTES = 1 << 30
"""Maximum size of a CSV file or a black-box recording, bytes. The file is read into memory."""

MAX_RECORD_BYTES = 1 << 28
"""Maximum size of a record in a bag, bytes. A chunk of rosbag2 is below 1 MiB."""

MAX_LOG_TIME_NS = (1 << 63) - 1
"""Largest time of a message that the table can contain, ns."""

BAG_DAMAGE = (*DAMAGE_ERRORS, RuntimeError)
"""Exceptions of the MCAP reader, of LZ4 and of `_messages` that mean that a bag is damaged.

`_messages` raises a `ValueError` if a message has a time above `MAX_LOG_TIME_NS`.
"""

OTHER_BAGS = {
    ".db3": (b"SQLite format 3\0", "in SQLite: convert it to MCAP with `ros2 bag convert`"),
    ".bag": (b"#ROSBAG V", "of ROS 1: convert it to a ROS 2 bag in MCAP with `rosbags-convert`"),
    ".zstd": (b"\x28\xb5\x2f\xfd", "that is compressed as a whole file: unpack it with `zstd -d`"),
}
"""The kinds of bags that this module cannot read, by file suffix.

A value is a pair: the first bytes of the file, and words for the error message.
"""


def calibrated(log: Path, config: Config, tape: Tape | None, choice: Choice) -> Calibration:
    """Compute the calibration from a recording of the robot while it drove, and return it.

    Args:
        log: path of the recording: a CSV file, a black-box recording of acsard, an MCAP file of a
            ROS 2 bag, or the directory of a ROS 2 bag.
        config: the configuration of the robot.
        tape: a distance that a person measured by tape, or None.
        choice: the topics and the axis of the IMU to use. Only a ROS 2 bag permits such a choice.

    Raises:
        LogError: the content of the log is unreadable, incomplete or wrong, or `choice` is not the
            default although the log is not a ROS 2 bag.
        MendableError: the file cannot be opened, or is too large.
        NoCalibrationError: the log is valid, but it gives no useful calibration.
    """
    try:
        table = _table(log, config, choice)
    except OSError as error:
        raise MendableError(f"cannot read {log}: {error.strerror}; correct --log") from None
    try:
        driven = runs(table)
    except LogError as error:
        attach_notes(error, table.notes)
        raise
    return calibrate(driven, config.drive, tape, config.odometry, config.feedback)


def _table(log: Path, config: Config, choice: Choice) -> Table:
    if log.is_dir():
        return _bag(_files_of(log), config, choice)
    with log.open("rb") as stream:
        begin = stream.read(16)
    for magic, what in OTHER_BAGS.values():
        if begin.startswith(magic):
            raise LogError(_other_bag(what))
    if begin.startswith(MAGIC) and not _is_ours(log):
        return _bag([log], config, choice)
    if choice != Choice():
        raise LogError(
            "--topic and --yaw-axis are only for a ROS 2 bag, and this log is not a ROS 2 bag: "
            "leave both options out"
        )
    if log.stat().st_size > MAX_FILE_BYTES:
        raise MendableError(f"{log} is larger than 1 GiB: use a part of it; ten minutes are enough")
    return read(_measured(log) if begin.startswith(MAGIC) else log.read_bytes())


def _files_of(directory: Path) -> list[Path]:
    files = [path for path in directory.iterdir() if path.suffix == ".mcap"]
    if not files:
        for suffix, (_, what) in OTHER_BAGS.items():
            if any(path.suffix == suffix for path in directory.iterdir()):
                raise LogError(_other_bag(what))
        raise LogError(
            f"this directory contains no MCAP file: give the directory of a ROS 2 bag with --log, "
            f"or {CSV_ADVICE}"
        )
    return sorted(files, key=lambda path: [int(n) for n in re.findall(r"\d+", path.stem)])


def _other_bag(what: str) -> str:
    return f"this log is a ROS bag {what} ({GUIDE_PAGE} has the commands)"


def _is_ours(log: Path) -> bool:
    with log.open("rb") as stream:
        try:
            return _reader(stream).get_header().profile == "acsard"
        except (*DAMAGE_ERRORS, StopIteration):
            return True  # the reader of acsard's recordings then reports the damage


def _reader(stream: IO[bytes]) -> NonSeekingReader:
    return NonSeekingReader(stream, record_size_limit=MAX_RECORD_BYTES)


def _bag(files: list[Path], config: Config, choice: Choice) -> Table:
    notes: list[str] = []
    messages = (message for file in files for message in _messages(file, notes))
    try:
        table = ros_bag_log.table(messages, config.joints.as_tuple(), choice)
    except LogError as error:
        attach_notes(error, notes)
        raise
    return replace(table, notes=(*notes, *table.notes))


def _messages(file: Path, notes: list[str]) -> Iterator[RosMessage]:
    with file.open("rb") as stream:
        try:
            for schema, channel, message in _reader(stream).iter_messages(log_time_order=False):
                type_ = "" if schema is None else schema.name
                encoding = channel.message_encoding
                if message.log_time > MAX_LOG_TIME_NS:
                    raise ValueError(f"a message has the impossible time {message.log_time} ns")
                yield RosMessage(channel.topic, type_, encoding, message.log_time, message.data)
        except EndOfFile:
            notes.append(f"{file.name} is cut off: only the messages before the cut are used")
        except BAG_DAMAGE as error:
            notes.append(
                f"{file.name} is damaged, so only the messages before the damaged place are used: "
                f"{error}"
            )


def _measured(log: Path) -> bytes:
    """Return the CSV table that `calibration_csv` makes of a black-box recording."""
    try:
        recording = Recording(log)
    except RecordingError as error:
        raise LogError(f"{error}; {CSV_ADVICE}") from None
    try:
        return calibration_csv(recording)
    except RecordingError as error:
        raise LogError(str(error)) from None

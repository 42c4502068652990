"""Reads the recorded drive of `acsard calibrate --log`, and calibrates with it."""

from __future__ import annotations

from pathlib import Path

from acsard.calibration.log_table import AS_CSV, LogError, noted, read
from acsard.calibration.runs import runs
from acsard.calibration.solve import Calibration, calibrate
from acsard.calibration.tape_distance import Tape
from acsard.core.config.settings import DriveConfig
from acsard.host.errors import MendableError, RecordingError
from acsard.recording.export import measured
from acsard.recording.file import Recording
from acsard.recording.mcap_records import MAGIC


def calibrated(log: Path, drive: DriveConfig, tape: Tape | None) -> Calibration:
    """Return the calibration from a CSV file or a black-box recording.

    Raises `LogError`, `RefusedError`, and `MendableError` for a file that cannot be read.
    """
    if log.is_dir():
        raise LogError(f"it is a directory (perhaps a ROS bag): {AS_CSV}")
    try:
        # The whole log is read into memory.
        if log.stat().st_size > 1 << 30:
            raise MendableError(f"{log} is larger than 1 GiB: cut it; ten minutes are enough")
        data = log.read_bytes()
    except OSError as error:
        raise MendableError(f"cannot read {log}: {error.strerror}; correct --log") from None
    if data.startswith(MAGIC):
        data = _measured(log)
    table = read(data)
    try:
        driven = runs(table)
    except LogError as error:
        noted(error, table.notes)
        raise
    return calibrate(driven, drive, tape)


def _measured(log: Path) -> bytes:
    """Return the measurements of a black-box recording as a CSV table.

    Raises `LogError` if the file is not a recording or if the recording has no gyro.
    """
    try:
        recording = Recording(log)
    except RecordingError as error:
        raise LogError(f"{error}; {AS_CSV}") from None
    try:
        return measured(recording)
    except RecordingError as error:
        raise LogError(str(error)) from None

"""Computes the calibration from the recorded drive that `acsard calibrate --log` names."""

from __future__ import annotations

from pathlib import Path

from acsard.calibration.log_table import CSV_ADVICE, LogError, attach_notes, read
from acsard.calibration.multipliers import Tape
from acsard.calibration.runs import runs
from acsard.calibration.solve import Calibration, calibrate
from acsard.core.config.settings import Config
from acsard.host.errors import MendableError, RecordingError
from acsard.recording.export import calibration_csv
from acsard.recording.file import MAGIC, Recording

MAX_FILE_BYTES = 1 << 30  # the file is read into memory


def calibrated(log: Path, config: Config, tape: Tape | None) -> Calibration:
    """Compute the calibration from a CSV file or a black-box recording of acsard.

    Raises `LogError` or `NoCalibrationError` for the content, and `MendableError` for the file.
    """
    if log.is_dir():
        raise LogError(f"this is a directory: {CSV_ADVICE}")
    try:
        if log.stat().st_size > MAX_FILE_BYTES:
            raise MendableError(
                f"{log} is larger than 1 GiB: use a part of it; ten minutes are enough"
            )
        with log.open("rb") as stream:
            ours = stream.read(len(MAGIC)) == MAGIC
        table = read(_measured(log) if ours else log.read_bytes())
    except OSError as error:
        raise MendableError(f"cannot read {log}: {error.strerror}; correct --log") from None
    try:
        driven = runs(table)
    except LogError as error:
        attach_notes(error, table.notes)
        raise
    return calibrate(driven, config.drive, tape, config.odometry, config.feedback)


def _measured(log: Path) -> bytes:
    try:
        return calibration_csv(Recording([log]))
    except RecordingError as error:
        raise LogError(str(error)) from None

"""The codes of files: the configuration, the recording, the latch file."""

from __future__ import annotations

from typing import Literal

from acsard.core.tables.finding_table import table

FileCode = Literal[
    "configuration_wrong", "configuration_read", "configuration_secret", "configuration_doubtful",
    "configuration_other_robot", "configuration_same", "configuration_options",
    "configuration_differs", "settings_same", "settings_changed", "recording_works",
    "recording_fails", "latch_file_works", "latch_file_fails",
]  # fmt: skip

FILES = table(
    FileCode,
    """
FAIL configuration: wrong
    {where}: {problem}
    -> correct your file; `acsard check --new FILE` writes all settings with their explanations
OK configuration: read
    {where}
OK configuration: secret
    this role may not read the daemon's configuration, and the file is of another robot: the
    daemon's port and files were not examined
WARN configuration: doubtful
    {warning}
    -> correct your file; `acsard check --new FILE` writes all settings with their explanations
OK configuration: other robot
    the file is not compared with the daemon: it is for robot {ours}, not for {runs}
OK configuration: same
    the running daemon uses the file's values
OK configuration: options
    the running daemon has other values than the file: {values}; they come from its options
WARN configuration: differs
    the running daemon has other values than the file: {values}
    -> they come from options of `acsard run`, from `acsard set`, from another file (name it with
    --config), or the file has changed since the daemon's start: restart the daemon with this file,
    or write the values into it
OK settings_same
    those of the start
OK settings_changed
    changed since the daemon's start: {differ}
OK recording_works
    on
WARN recording_fails | recording fails
    {trouble}
    -> free disk space, or set record.directory to a writable directory
OK latch_file_works
    written
WARN latch_file_fails | latch file fails
    {trouble}
    -> free disk space, or set control.state_directory to a writable directory
""",
)

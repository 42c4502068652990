"""acsard finds the end record of a recording without unpacking the file."""

from __future__ import annotations

import struct
import tracemalloc
from pathlib import Path

import pytest
import zstandard
from mcap.records import Chunk, DataEnd, Footer, Header, Metadata, MetadataIndex

from acsard.core.config.settings import Config
from acsard.recording.end_record import (
    END_RECORD_NAME,
    TAIL_BYTES,
    EndRecord,
    as_metadata,
    read_end,
)
from acsard.recording.mcap_records import MAGIC, encoded
from tests.scenarios.taped import Tape
from tests.scenarios.world import World

LAST = EndRecord(1, 2, "start", "bug", "in step 3")

ZEROS = bytes(1 << 24)

BOMB = Chunk(
    compression="zstd",
    data=zstandard.compress(ZEROS),
    message_start_time=0,
    message_end_time=0,
    uncompressed_crc=0,
    uncompressed_size=len(ZEROS),
)
"""A chunk of a few kB that has 16 MB inside."""


FRONT = MAGIC + encoded(Header("", ""))
BACK = encoded(Metadata(END_RECORD_NAME, as_metadata(LAST)), DataEnd(0))


def footer(summary_at: int) -> bytes:
    return encoded(Footer(summary_at, 0, 0)) + MAGIC


@pytest.mark.parametrize("case", ["no summary", "summary of chunks", "index of a chunk"])
def test_a_chunk_that_unpacks_to_megabytes_is_not_unpacked(case: str, tmp_path: Path) -> None:
    path, data = tmp_path / "a.mcap", FRONT + encoded(BOMB) + BACK
    if case == "index of a chunk":
        data += encoded(MetadataIndex(len(FRONT), 100, END_RECORD_NAME)) + footer(len(data))
    else:
        data += footer(len(FRONT) if case == "summary of chunks" else 0)
    path.write_bytes(data)
    tracemalloc.start()
    try:
        assert read_end(path) == LAST
        assert tracemalloc.get_traced_memory()[1] < len(ZEROS) / 8
    finally:
        tracemalloc.stop()


def test_the_end_record_lies_well_within_the_bytes_that_are_searched(
    tmp_path: Path,
) -> None:
    tape, path = Tape(), tmp_path / "a.mcap"
    World(recorder=tape).drive(0.5, 0.2, seconds=1.0)
    tape.write(path, Config())
    data = path.read_bytes()
    assert read_end(path) is not None
    # The summary has the record's name as well, behind the record itself.
    name = struct.pack("<I", len(END_RECORD_NAME)) + END_RECORD_NAME.encode()
    assert len(data) - data.index(name) < TAIL_BYTES / 16


@pytest.mark.parametrize(
    "data",
    [
        pytest.param(b"", id="nothing"),
        pytest.param(MAGIC * 2, id="no footer"),
        pytest.param(FRONT + footer(0), id="no end record"),
        pytest.param(FRONT + BACK + footer(0)[:-1], id="cut"),
        pytest.param(FRONT + BACK + footer(0) + b"\0", id="bytes behind the end"),
        pytest.param(bytes(8) + BACK + footer(0), id="no beginning"),
        pytest.param(
            FRONT + encoded(Metadata(END_RECORD_NAME, {"said": "x"}), DataEnd(0)) + footer(0),
            id="x",
        ),
        pytest.param(FRONT + BACK.replace(b"wall_ns", b"wall\xff\xff\xff") + footer(0), id="text"),
    ],
)
def test_a_file_without_a_valid_end_has_no_end_record(data: bytes, tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(data)
    assert read_end(path) is None


def test_the_time_to_search_many_names_of_the_record_is_proportional_to_their_number(
    tmp_path: Path,
) -> None:
    """The search decodes only the last place that has the form of an end record."""
    path, name = (
        tmp_path / "a.mcap",
        struct.pack("<I", len(END_RECORD_NAME)) + END_RECORD_NAME.encode(),
    )
    path.write_bytes(FRONT + BACK + name * 4000 + footer(0))
    assert read_end(path) == LAST

"""The export of a recording says in one sentence that the disk is full.

`tests/scenarios/test_export.py` compares the file with what was published.
"""

from __future__ import annotations

from pathlib import Path

from tests.system.harness import ROOT, acsard, finish

RECORDED = ROOT / "tests" / "recordings" / "quiet.rec.zst"


def test_an_export_to_a_full_disk_ends_with_one_sentence_and_leaves_no_file(tmp_path: Path) -> None:
    words = acsard("recording", "export", str(RECORDED), "new.mcap")
    # Blocks of 512 bytes per file. Python would write the beginning of its bytecode, too.
    limit = 'ulimit -f 16; export PYTHONDONTWRITEBYTECODE=1; exec "$@"'
    full = ["sh", "-c", limit, "sh", *words]
    ended = finish(full, tmp_path)
    assert (ended.code, ended.err) == (1, "acsard: cannot write new.mcap: File too large")
    assert not [*tmp_path.iterdir()]

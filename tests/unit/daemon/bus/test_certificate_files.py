"""New certificate files count once they belong together and no longer change."""

from __future__ import annotations

from pathlib import Path

import pytest

from acsard.daemon.bus import certificate_files as module
from acsard.daemon.bus.certificate_files import LOOK_NS, CertificateFiles
from acsard.daemon.bus.tls import files_in
from acsard.host import clock
from acsard.machine.authority import Authority


class Files:
    """The files of a robot, looked at by a clock that each look advances."""

    def __init__(self, where: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.where, self._now_ns = where, 0
        self.authority = Authority.make(where, "test", 10)
        self.issue()
        monkeypatch.setattr(clock, "mono_ns", lambda: self._now_ns)
        self._files = CertificateFiles(*files_in(str(where)))

    def issue(self) -> None:
        self.authority.issue(self.where, "robot", [], 10)

    def renewed(self) -> bool:
        self._now_ns += LOOK_NS
        return self._files.renewed()


@pytest.fixture
def files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Files:
    return Files(tmp_path, monkeypatch)


def test_a_new_certificate_is_noticed_once(files: Files) -> None:
    assert [files.renewed() for _ in range(3)] == [False, False, False]
    files.issue()
    # The first look sees that the files change, and the second that they no longer do.
    assert [files.renewed() for _ in range(4)] == [False, True, False, False]


def test_each_further_certificate_is_noticed(files: Files) -> None:
    for _ in range(3):
        files.issue()
        assert [files.renewed() for _ in range(2)] == [False, True]


@pytest.mark.parametrize("missing", ["certificate.pem", "key.pem"])
def test_files_that_are_copied_one_after_the_other_count_when_all_are_there(
    files: Files, missing: str
) -> None:
    file = files.where / missing
    old = file.read_bytes()
    files.issue()
    new = file.read_bytes()
    file.write_bytes(old)
    assert [files.renewed() for _ in range(4)] == [False] * 4
    file.unlink()
    assert [files.renewed() for _ in range(4)] == [False] * 4
    file.write_bytes(new)
    assert [files.renewed() for _ in range(2)] == [False, True]


def test_the_files_are_not_looked_at_more_often(
    files: Files, monkeypatch: pytest.MonkeyPatch
) -> None:
    files.renewed()
    files.issue()
    monkeypatch.setattr(module, "LOOK_NS", 0)
    assert not any(files._files.renewed() for _ in range(10))

"""What is done to a machine, step by step, as values: a person reads one, then it is done."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

from msgspec import Struct

from acsard.host.errors import MendableError, NotPermittedError
from acsard.host.exits import Exit, ExitError

OURS = ("bin", "acsard", "acsard.service.d", "acsard-door.service.d", "acsard-web.service.d")
"""Directories that are removed with the last file in them."""

RUN_S = 60.0
"""A command that takes longer has hung."""


class File(Struct, frozen=True):
    """One file of the service."""

    path: Path
    content: bytes
    mode: int = 0o644
    kept: bool = False
    """The user's to change: never replaced, removed only while it is as it was written."""

    def found(self) -> bytes | None:
        """What is there now, None for nothing."""
        try:
            return self.path.read_bytes()
        except FileNotFoundError:
            return None
        except OSError as error:
            raise _unreadable(self.path, error) from None

    def condition(self) -> str:
        """How it is, in a word or two."""
        try:
            found = self.found()
        except MendableError:
            return "unreadable"
        if found is None:
            return "missing"
        return "as installed" if found == self.content else "changed"


class Write(Struct, frozen=True):
    """A file is made, or made anew."""

    file: File

    def __str__(self) -> str:
        return (
            f"write   {self.file.path}  ({len(self.file.content)} bytes, mode {self.file.mode:o})"
        )

    def do(self) -> None:
        """With directories that the service's own user can enter whatever the umask."""
        path = self.file.path
        made = [place for place in path.parents if not place.exists()]
        path.parent.mkdir(parents=True, exist_ok=True)
        for place in made:
            place.chmod(0o755)
        path.unlink(missing_ok=True)  # a link is replaced, not written through
        path.write_bytes(self.file.content)
        path.chmod(self.file.mode)


class Remove(Struct, frozen=True):
    """A file is removed, and the directories made for it as far as they are empty."""

    path: Path

    def __str__(self) -> str:
        return f"remove  {self.path}"

    def do(self) -> None:
        """Remove it."""
        self.path.unlink()
        self.tidy(self.path)

    @staticmethod
    def tidy(path: Path) -> None:
        """Remove the directories of ours that nothing is left in."""
        for place in path.parents:
            if place.name not in OURS:
                return
            try:
                place.rmdir()
            except OSError:
                return  # something else lives there


class RemoveAll(Struct, frozen=True):
    """A file or a whole directory is removed, whatever is in it."""

    path: Path

    def __str__(self) -> str:
        return f"remove  {self.path}" + ("/ and all in it" if self.path.is_dir() else "")

    def do(self) -> None:
        """Remove it."""
        if self.path.is_dir() and not self.path.is_symlink():
            shutil.rmtree(self.path)
            Remove.tidy(self.path)
        else:
            Remove(self.path).do()


class Keep(Struct, frozen=True):
    """A file stays as it is."""

    path: Path
    why: str = ""

    def __str__(self) -> str:
        return f"keep    {self.path}" + (f"  ({self.why})" if self.why else "")

    def do(self) -> None:
        """Nothing."""


class Run(Struct, frozen=True):
    """A command is run."""

    words: tuple[str, ...]
    may_fail: bool = False
    """A machine without udev, or a unit that never failed, is no reason to stop halfway."""

    def __str__(self) -> str:
        return f"run     {' '.join(self.words)}"

    def do(self) -> None:
        """Raises `ExitError` with what it says unless it may fail."""
        try:
            done = called(self.words, RUN_S)
            failed = done.stderr.strip() if done.returncode else ""
        except (OSError, subprocess.TimeoutExpired) as error:
            failed = str(error)
        if failed and not self.may_fail:
            raise ExitError(Exit.FAILURE, f"{' '.join(self.words)}: {failed}")


Step = Write | Remove | RemoveAll | Keep | Run


def _unreadable(path: Path, error: OSError) -> MendableError:
    if isinstance(error, PermissionError):
        return NotPermittedError(f"no permission to read {path}; run it by sudo")
    return ExitError(Exit.FAILURE, f"cannot read {path}: {error.strerror}; look what it is")


def called(words: tuple[str, ...], within_s: float) -> subprocess.CompletedProcess[str]:
    """A command that has ended; raises `OSError` or `subprocess.TimeoutExpired`."""
    return subprocess.run(words, capture_output=True, text=True, timeout=within_s, check=False)

"""Changes of a machine as values: the user reads the steps before they are carried out."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

from msgspec import Struct

from acsard.host.errors import MendableError, NotPermittedError
from acsard.host.processes import called

OURS = ("bin", "acsard", "acsard.service.d", "acsard-gateway.service.d", "acsard-web.service.d")
"""Directories that are removed with the last file in them."""


class File(Struct, frozen=True):
    """One file of the service."""

    path: Path
    content: bytes
    mode: int = 0o644
    kept: bool = False
    """True for a file that the user may change. It is not replaced, nor removed if changed."""

    def found(self) -> bytes | None:
        """Return the present content of the path, or None if the file does not exist."""
        try:
            return self.path.read_bytes()
        except FileNotFoundError:
            return None
        except OSError as error:
            raise _unreadable(self.path, error) from None

    def condition(self) -> str:
        """Return the file's condition in a word or two."""
        try:
            found = self.found()
        except MendableError:
            return "unreadable"
        if found is None:
            return "missing"
        return "as installed" if found == self.content else "changed"


class Write(Struct, frozen=True):
    """Step that writes a file."""

    file: File

    def __str__(self) -> str:
        return (
            f"write   {self.file.path}  ({len(self.file.content)} bytes, mode {self.file.mode:o})"
        )

    def do(self) -> None:
        """Write the file. New directories are open to the service's user, whatever the umask."""
        path = self.file.path
        made = [place for place in path.parents if not place.exists()]
        path.parent.mkdir(parents=True, exist_ok=True)
        for place in made:
            place.chmod(0o755)
        # A link is replaced, not written through.
        path.unlink(missing_ok=True)
        path.write_bytes(self.file.content)
        path.chmod(self.file.mode)


class Remove(Struct, frozen=True):
    """Step that removes a file, or a directory with everything in it."""

    path: Path

    def __str__(self) -> str:
        return f"remove  {self.path}" + ("/ and everything in it" if self._is_directory else "")

    @property
    def _is_directory(self) -> bool:
        return self.path.is_dir() and not self.path.is_symlink()

    def do(self) -> None:
        """Remove it, and acsard's own directories that become empty."""
        if self._is_directory:
            shutil.rmtree(self.path)
        else:
            self.path.unlink()
        for place in self.path.parents:
            if place.name not in OURS:
                return
            try:
                place.rmdir()
            except OSError:
                # The directory holds something else.
                return


class Keep(Struct, frozen=True):
    """Step that leaves a file as it is, with the reason."""

    path: Path
    why: str = ""

    def __str__(self) -> str:
        return f"keep    {self.path}" + (f"  ({self.why})" if self.why else "")

    def do(self) -> None:
        """Do nothing."""


class Run(Struct, frozen=True):
    """Step that runs a command."""

    words: tuple[str, ...]
    may_fail: bool = False
    """True if a failure must not end the installation: the machine may have no udev, or a unit
    that never failed cannot be reset.
    """

    def __str__(self) -> str:
        return f"run     {' '.join(self.words)}"

    def do(self) -> None:
        """Run the command; raise `MendableError` with its error output, unless it may fail."""
        try:
            done = called(self.words, 60.0)
            failed = done.stderr.strip() if done.returncode else ""
        except (OSError, subprocess.TimeoutExpired) as error:
            failed = str(error)
        if failed and not self.may_fail:
            raise MendableError(f"{' '.join(self.words)}: {failed}")


Step = Write | Remove | Keep | Run


def _unreadable(path: Path, error: OSError) -> MendableError:
    if isinstance(error, PermissionError):
        return NotPermittedError(f"no permission to read {path}; run it with sudo")
    return MendableError(f"cannot read {path}: {error.strerror}; check the file")

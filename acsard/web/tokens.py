"""Creates, stores and checks the access tokens of clients on other machines.

The token file contains the SHA-256 hash of each token, and not the token itself. A token has 32
random bytes, so nobody can compute a token from its hash.
"""

from __future__ import annotations

import fcntl
import hashlib
import hmac
import os
import secrets
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import msgspec
from msgspec import Struct
from msgspec.structs import asdict

from acsard.core.values import ROLES, Role
from acsard.host import clock
from acsard.host.atomic_file import replace
from acsard.host.errors import MSGSPEC_ERRORS, MendableError, NotPermittedError, UsageError
from acsard.web.callers import AdmittedClient

FILE = "tokens.json"

# State directory of the service `acsard-web`.
SERVICE_DIRECTORY = Path("/var/lib/acsard-web")

# of one robot
MAX_TOKENS = 200

WRITE_INTERVAL_S = 60  # of the time in the token file: more writes would wear out an SD card


class Token(Struct, frozen=True):
    """The stored record of a token."""

    name: str
    role: str  # admits nobody if only a later version knows it
    digest: str
    made: int  # s since 1970
    ends: int  # s since 1970
    robot: str  # whose page it opens


class _File(Struct, frozen=True):
    tokens: list[Token]
    newest: int = 0  # the newest time that a server has seen, s since 1970


class Vault:
    """The access tokens of one robot. The token file also contains tokens of other robots.

    The clock of a robot without a battery begins in 1970 at each start. An expired token stays
    expired, because the time is the clock's or the newest in the file, whichever is later. The
    latter goes on, or no token would ever expire on a robot that never learns the time.
    """

    def __init__(self, directory: Path, robot: str) -> None:
        self.path, self.robot = directory / FILE, robot
        # The stamp of the file (mtime ns, inode) when it was read, and its content: a tuple,
        # because several threads replace them.
        self._read: tuple[tuple[int, int] | None, _File] = None, _File([])
        self._newest = 0.0, clock.steady_s()  # time of a file, and when it was read, s

    def now_s(self) -> float:
        """Return the time of the tokens, s, as of the last call that read the token file."""
        newest_s, read_s = self._newest
        return max(time.time(), newest_s + clock.steady_s() - read_s)

    def _learn(self, newest_s: float) -> None:
        if newest_s > self.now_s():
            self._newest = newest_s, clock.steady_s()

    def find_owner(self, text: str) -> AdmittedClient | None:
        """Return the owner of a valid token, as of the last call that read the token file."""
        return owner_in(self._own(self._read[1].tokens), text, self.now_s())

    def left_s(self, digest: str) -> int:
        """Return the time until a token expires; 0 if it has expired or is unknown."""
        ends = [token.ends for token in self.all() if token.digest == digest]
        return max(0, int(max(ends, default=0) - self.now_s()))

    def all(self) -> list[Token]:
        """Return this robot's tokens, also expired ones; [] if the file cannot be read."""
        return self._own(self._shared().tokens)

    def _own(self, tokens: list[Token]) -> list[Token]:
        return [token for token in tokens if token.robot == self.robot]

    def _shared(self) -> _File:
        try:
            status = self.path.stat()
            stamp = status.st_mtime_ns, status.st_ino
            read = self._read
            if stamp != read[0]:
                read = stamp, msgspec.json.decode(self.path.read_bytes(), type=_File)
        except (OSError, *MSGSPEC_ERRORS):
            # The file is missing or unreadable. A token that cannot be checked must not be
            # accepted.
            read = None, _File([])
        self._read = read
        self._learn(read[1].newest)
        return read[1]

    def valid_digests(self) -> frozenset[str]:
        """Return the digests of the tokens that are valid now, and store the time if it is due."""
        tokens, now_s = self.all(), self.now_s()
        if tokens and now_s >= self._read[1].newest + WRITE_INTERVAL_S:
            # Without room on the disk, the tokens expire by the clock alone.
            with suppress(MendableError, NotPermittedError, UsageError), self._changing():
                pass
        return frozenset(token.digest for token in tokens if token.ends > now_s)

    def unknown_to(self, service: Path = SERVICE_DIRECTORY) -> str:
        """Return a warning if the service `acsard-web` reads another token file, else ""."""
        if self.path.parent == service or not os.path.lexists(service):
            return ""
        return (
            f"this token is in {self.path}, a file that the service acsard-web on this machine "
            "does not read: to invite users to the page of that service, run this command with sudo"
        )

    def invite(self, role: Role, name: str, days: int, hours: int = 0) -> tuple[str, Token]:
        """Create a token, and return its text, which is stored nowhere, and its record.

        Expired tokens are deleted. Raises `UsageError` for a name in use, or for too many tokens.
        """
        with self._changing() as tokens:
            now_s = int(self.now_s())
            tokens[:] = [record for record in tokens if record.ends > now_s]
            ours = self._own(tokens)
            if any(record.name == name for record in ours):
                raise UsageError(
                    f"the token {name} exists already: either give another --name, or revoke the "
                    f"old token with --revoke {name}"
                )
            if len(ours) >= MAX_TOKENS:
                raise UsageError(
                    f"the robot already has {MAX_TOKENS} tokens: revoke some with --revoke NAME"
                )
            text = secrets.token_urlsafe(32)
            ends = now_s + 3600 * (24 * days + hours)
            token = Token(name, role, _digest(text), now_s, ends, self.robot)
            tokens.append(token)
        return text, token

    def revoke(self, name: str) -> None:
        """Delete the robot's token with this name. Raises `UsageError` if there is none."""
        with self._changing() as tokens:
            ours = self._own(tokens)
            if all(token.name != name for token in ours):
                known = ", ".join(token.name for token in ours) or "none"
                raise UsageError(
                    f"there is no token {name} of {self.robot} in {self.path}; the robot's tokens: "
                    f"{known}"
                )
            tokens[:] = [
                token for token in tokens if (token.name, token.robot) != (name, self.robot)
            ]

    @contextmanager
    def _changing(self) -> Iterator[list[Token]]:
        directory = self.path.parent
        try:
            directory.mkdir(mode=0o700, parents=True, exist_ok=True)
            handle = os.open(directory, os.O_RDONLY | os.O_DIRECTORY)
            try:
                fcntl.flock(handle, fcntl.LOCK_EX)
                data = self._load()
                file = self._decoded(data)
                self._read = None, file
                self._learn(file.newest)
                tokens = list(file.tokens)
                yield tokens
                # A field that only a later version knows may limit its token, so it is kept.
                raw = msgspec.json.decode(data)
                stored = {row["digest"]: row for row in raw["tokens"]}
                rows = [stored.get(token.digest, {}) | asdict(token) for token in tokens]
                self._write(raw | {"tokens": rows, "newest": int(self.now_s())})
            finally:
                os.close(handle)
        except PermissionError:
            raise NotPermittedError(
                f"no permission to write {self.path}: run this command with sudo"
            ) from None
        except OSError as error:
            raise MendableError(f"cannot write {self.path}: {error.strerror}") from None

    def _load(self) -> bytes:
        try:
            return self.path.read_bytes()
        except FileNotFoundError:
            return b'{"tokens":[]}'

    def _decoded(self, data: bytes) -> _File:
        try:
            return msgspec.json.decode(data, type=_File)
        except MSGSPEC_ERRORS as error:
            raise UsageError(
                f"{self.path} is not a list of tokens ({error}): correct it, or move it away "
                "and invite all users again"
            ) from None

    def _write(self, content: dict[str, Any]) -> None:
        # If root writes the file, give it to the directory's owner, because the service reads it as
        # its own user.
        directory = self.path.parent.stat()
        owner = (directory.st_uid, directory.st_gid) if os.geteuid() == 0 else None
        replace(self.path, msgspec.json.encode(content), mode=0o600, owner=owner)


def place() -> Path:
    """Return the directory of the token file: for the service and for root that of the service."""
    if "STATE_DIRECTORY" in os.environ:
        return Path(os.environ["STATE_DIRECTORY"].partition(":")[0])
    if os.geteuid() == 0 and SERVICE_DIRECTORY.is_dir():
        return SERVICE_DIRECTORY
    base = os.environ.get("XDG_STATE_HOME") or str(Path.home() / ".local" / "state")
    return Path(base) / "acsard-web"


def owner_in(tokens: Sequence[Token], text: str, now_s: float) -> AdmittedClient | None:
    """Return the owner of a token that is in `tokens` and has not expired by `now_s`."""
    if not text or len(text) > 200:
        return None
    digest, match = _digest(text), None
    for token in tokens:
        if hmac.compare_digest(token.digest, digest):
            match = token
    if match is None or match.ends <= now_s:
        return None
    role = next((role for role in ROLES if role == match.role), None)
    return role and AdmittedClient(role, match.name, match.digest)


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode(errors="surrogateescape")).hexdigest()

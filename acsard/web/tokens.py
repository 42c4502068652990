"""Tokens for who comes from elsewhere: made once, kept as hashes, until they end or are revoked.

A token is 32 bytes of chance, so a plain hash of it cannot be turned round.
"""

from __future__ import annotations

import fcntl
import hashlib
import hmac
import os
import secrets
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec
from msgspec import Struct

from acsard.host.errors import NotPermittedError, UsageError
from acsard.values import Role
from acsard.web.who import Who

FILE, MODE = "tokens.json", 0o600

SERVICE = Path("/var/lib/acsard-web")
"""The state directory of the service."""

HOUR_S, DAY_S = 3600, 86400

MOST = 200
"""Of one robot."""


class Token(Struct, frozen=True):
    """What is kept of one."""

    name: str
    role: Role
    digest: str
    made: int
    """Seconds since 1970."""
    ends: int
    """The same."""
    robot: str = ""
    """The id of the robot whose page it opens; "" is any: it was made before tokens had one."""


class Vault:
    """The tokens in a file that only its owner may read; read again when it has changed. Robots of
    one user share the file, and each sees its own tokens alone."""

    def __init__(self, directory: Path, robot: str = "") -> None:
        """`robot` is its id."""
        self.path, self.robot = directory / FILE, robot
        self._read: tuple[tuple[int, int] | None, list[Token]] = None, []
        """Its stamp and its tokens: one value, since several threads look."""

    def who(self, text: str) -> Who | None:
        """Whose this token is, while it counts."""
        if not text or len(text) > 200:
            return None
        digest, found = _digest(text), None
        for token in self.all():
            if hmac.compare_digest(token.digest, digest):
                found = token
        if found is None or found.ends <= time.time():
            return None
        return Who(found.role, found.name, found.digest)

    def left_s(self, digest: str) -> int:
        """Seconds until it ends."""
        ends = [one.ends for one in self.all() if one.digest == digest]
        return max(0, int(max(ends, default=0) - time.time()))

    def all(self) -> list[Token]:
        """Those of this robot, also what has ended; none where they cannot be read."""
        return [one for one in self._shared() if self._ours(one)]

    def _ours(self, token: Token) -> bool:
        return token.robot in ("", self.robot)

    def _shared(self) -> list[Token]:
        """Those of all robots that share the file."""
        try:
            seen = self.path.stat()
            stamp = seen.st_mtime_ns, seen.st_ino
            read = self._read
            if stamp != read[0]:
                read = stamp, msgspec.json.decode(self.path.read_bytes(), type=list[Token])
        except (OSError, msgspec.MsgspecError):
            read = None, []  # there are none; or whom we cannot look up we let in no more
        self._read = read
        return read[1]

    def counting(self) -> frozenset[str]:
        """What those are known by that have not ended and are not revoked."""
        now_s = time.time()
        return frozenset(one.digest for one in self.all() if one.ends > now_s)

    def unknown_to(self, service: Path = SERVICE) -> str:
        """That a service on this machine does not know these; "" where none is, or it does."""
        if self.path.parent == service or not os.path.lexists(service):
            return ""
        return (
            f"kept in {self.path}, which the service on this machine does not read: for its page "
            "do the same with sudo"
        )

    def invite(self, role: Role, name: str, days: int, hours: int = 0) -> tuple[str, Token]:
        """A new token, to be shown once, and what is kept of it, which ends after so many days and
        hours; raises `UsageError`."""
        with self._changing() as tokens:
            now_s = int(time.time())
            tokens[:] = [one for one in tokens if one.ends > now_s]
            ours = [one for one in tokens if self._ours(one)]
            if any(one.name == name for one in ours):
                raise UsageError(f"there is a token {name} already: another --name, or --revoke it")
            if len(ours) >= MOST:
                raise UsageError(f"there are {MOST} tokens already: --revoke some")
            text = secrets.token_urlsafe(32)
            ends = now_s + days * DAY_S + hours * HOUR_S
            token = Token(name, role, _digest(text), now_s, ends, self.robot)
            tokens.append(token)
        return text, token

    def revoke(self, name: str) -> None:
        """It counts no more, from now on; raises `UsageError` where there is none."""
        with self._changing() as tokens:
            ours = [one for one in tokens if self._ours(one)]
            if all(one.name != name for one in ours):
                known = ", ".join(one.name for one in ours) or "none"
                raise UsageError(
                    f"there is no token {name} of {self.robot} in {self.path}; there are: {known}"
                )
            tokens[:] = [one for one in tokens if one.name != name or not self._ours(one)]

    @contextmanager
    def _changing(self) -> Iterator[list[Token]]:
        """The tokens, written when all went well; nobody else changes them meanwhile."""
        directory = self.path.parent
        try:
            directory.mkdir(mode=0o700, parents=True, exist_ok=True)
            handle = os.open(directory, os.O_RDONLY | os.O_DIRECTORY)
            try:
                fcntl.flock(handle, fcntl.LOCK_EX)
                tokens = self._kept()
                yield tokens
                self._write(tokens)
            finally:
                os.close(handle)
        except PermissionError:
            raise NotPermittedError(f"no permission to write {self.path}: use sudo") from None

    def _kept(self) -> list[Token]:
        """What the file holds, none where there is none; raises `UsageError`."""
        try:
            return msgspec.json.decode(self.path.read_bytes(), type=list[Token])
        except FileNotFoundError:
            return []
        except msgspec.MsgspecError as error:
            raise UsageError(
                f"{self.path} cannot be read as tokens ({error}): mend it, or move it away and "
                "invite all anew"
            ) from None

    def _write(self, tokens: list[Token]) -> None:
        directory = self.path.parent
        handle, name = tempfile.mkstemp(dir=directory, prefix=f".{FILE}.")
        try:
            with os.fdopen(handle, "wb") as new:
                new.write(msgspec.json.encode(tokens))
                new.flush()
                os.fchmod(new.fileno(), MODE)
                owner = directory.stat()
                if os.geteuid() == 0:  # the service reads it as a user of its own
                    os.fchown(new.fileno(), owner.st_uid, owner.st_gid)
                os.fsync(new.fileno())
            os.replace(name, self.path)
        except BaseException:
            os.unlink(name)
            raise


def place() -> Path:
    """Where the tokens are: the service's state directory, else the user's own."""
    if "STATE_DIRECTORY" in os.environ:
        return Path(os.environ["STATE_DIRECTORY"].partition(":")[0])
    if os.geteuid() == 0 and SERVICE.is_dir():
        return SERVICE
    base = os.environ.get("XDG_STATE_HOME") or str(Path.home() / ".local" / "state")
    return Path(base) / "acsard-web"


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode(errors="surrogateescape")).hexdigest()

"""The codes of findings: one table `code -> (level, text, advice)`.

Programs read the code, and people the text. State, sources, events, latches, `diagnostics` and
`acsard doctor` carry a code. A text or an advice is a format string, into which `reason` or
`sentence` inserts the values. To add a code, add it twice in the file of its subject in `tables/`:
to the type and to the table below the type.
"""

from __future__ import annotations

from typing import Literal

from msgspec import Struct
from msgspec.structs import replace

from acsard.core.tables.bus_codes import BUS, BusCode, TlsCode
from acsard.core.tables.certificate_codes import CERTIFICATES, CertificateCode
from acsard.core.tables.computer_codes import COMPUTER, ComputerCode
from acsard.core.tables.file_codes import FILES, FileCode
from acsard.core.tables.finding_table import Entry, Level
from acsard.core.tables.link_codes import LINK, LineCode, LinkCode
from acsard.core.tables.message_codes import MESSAGES, MessageCode
from acsard.core.tables.motor_codes import MOTORS, FaultCode, MotorCode
from acsard.core.tables.pose_codes import POSE, GyroCode, PoseCode
from acsard.core.tables.sender_codes import SENDERS, AgeCode, SenderCode, SourcesCode
from acsard.core.tables.stop_codes import STOPS, InputCode, RestCode

# Of the reason in `state`.
StateCode = Literal[RestCode, FaultCode, LinkCode, SenderCode]

# Reasons for which a message of a client is refused.
RefusalCode = Literal[MessageCode, AgeCode]

Code = Literal[
    StateCode, InputCode, MotorCode, LineCode, PoseCode, GyroCode, SourcesCode, MessageCode,
    FileCode, CertificateCode, ComputerCode, BusCode, TlsCode,
]  # fmt: skip

CODES: dict[str, Entry] = {
    **SENDERS, **STOPS, **MOTORS, **LINK, **POSE, **MESSAGES, **FILES, **CERTIFICATES, **COMPUTER,
    **BUS,
}  # fmt: skip


class Reason(Struct, frozen=True, gc=False):
    """A code with its text for people."""

    code: Code
    text: str
    advice: str = ""
    part: str = ""  # such as a wheel; it distinguishes reasons of the same code

    @property
    def level(self) -> Level:
        return level_of(self.code)


def level_of(code: str) -> Level:
    """Return the level of a code; one that only a later version knows is a warning."""
    return CODES[code].level if code in CODES else "warning"


def reason(code: Code, part: str = "", /, **values: object) -> Reason:
    """Return the reason of a code, with the values in its text and its advice."""
    entry = CODES[code]
    return Reason(code, entry.text.format(**values), entry.advice.format(**values), part)


def sentence(code: Code, **values: object) -> Reason:
    """Return the reason of a code, with its advice at the end of its text."""
    return joined(reason(code, **values))


def received_text(code: str, text: str) -> str:
    """Return the text of a received reason, with its code if only a later version knows it."""
    return f"{text} ({code})" if code and code not in CODES else text


def joined(why: Reason) -> Reason:
    """Return a reason with its advice at the end of its text."""
    if not why.advice:
        return why
    return replace(why, text=f"{why.text}{CODES[why.code].joint} {why.advice}", advice="")

"""The check names what it receives at the port by the codes of the daemon."""

from __future__ import annotations

from collections.abc import Callable

from acsard.core.codes import CODES
from tests.each import each
from tests.unit.checkup_robots import Checked, Robot

SKETCH = b"!acsard-mcu sketch watchdog_ms=300 counts=748\r\n"


class Sends(Robot):
    """A device that sends other bytes in place of each reply; `n` counts the replies."""

    def __init__(self, change: Callable[[bytes, int], bytes]) -> None:
        super().__init__("plain_only")
        self._change, self._count, self._held = change, 0, b""

    def listen(self, until_ns: int) -> list[tuple[int, bytes]]:
        pieces = []
        for at_ns, data in super().listen(until_ns):
            *replies, self._held = (self._held + data).split(b"\r\n")
            for reply in replies:
                self._count += 1
                if changed := self._change(reply + b"\r\n", self._count):
                    pieces.append((at_ns, changed))
        return pieces


@each(
    ("change", "code"),
    [
        (lambda reply, n: b"", "received_nothing"),
        (lambda reply, n: b"!status estop=0\r\n", "received_statuses"),
        (lambda reply, n: SKETCH if n == 1 else b"", "received_identity"),
        (lambda reply, n: SKETCH + b"!status estop=ok\r\n", "received_identity"),
        (lambda reply, n: b"motor loop ok\r\n", "received_text"),
        (lambda reply, n: b"a 0.0, b 0.0, c 0.0, d 0.0\r\n", "received_form"),
        (lambda reply, n: reply.replace(b"d", b"e"), "received_letters"),
        (lambda reply, n: reply[:12], "received_cut"),
        (lambda reply, n: b"\xff" + reply, "received_foreign"),
        (lambda reply, n: b"\x81\x9c\xe0\x07" * 4, "received_garbage"),
        (lambda reply, n: reply if n == 5 else b"", "received_sparse"),
        (lambda reply, n: reply if n == 5 else b"\xff" + reply[3:], "received_few"),
        (lambda reply, n: b"Brownout detector was triggered\r\n", "received_brownout"),
        (lambda reply, n: b"rst:0x1 (POWERON_RESET),boot:0x13\r\n", "received_boot"),
        (lambda reply, n: b"$GPGGA,123519,4807.038,N,01131.000,E,1*47\r\n", "received_nmea"),
    ],
)
def test_bytes_that_are_no_replies_have_the_code_and_the_advice_of_the_daemon(
    change: Callable[[bytes, int], bytes], code: str
) -> None:
    finding = Checked(Sends(change)).findings[0]
    assert (finding.name, finding.verdict, finding.code) == ("baud rate", "FAIL", code)
    assert finding.figure == CODES[code].figure
    assert finding.mend.startswith(CODES[code].advice.partition("{")[0])

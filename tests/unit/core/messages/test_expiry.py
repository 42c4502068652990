"""The end of a certificate is reported in time, and an unreadable end is reported as well."""

from __future__ import annotations

from acsard.core.messages.expiry import DAY_NS, expiry
from tests.each import each

NOW_NS = 1_700_000_000_000_000_000


@each(
    ("days", "level", "words"),
    [
        (400, 0, "valid for 400 days"),
        (30, 0, "valid for 30 days"),
        (29, 1, "valid for 29 days"),
        (0, 1, "valid for 0 days"),
        (-2, 2, "expired 2 days ago: TLS refuses every client"),
    ],
)
def test_it_is_a_warning_a_month_before_and_an_error_after(
    days: int, level: int, words: str
) -> None:
    assert expiry(NOW_NS + days * DAY_NS, NOW_NS) == (level, words)


def test_an_end_that_nobody_can_read_is_a_warning_with_its_mend() -> None:
    level, words = expiry(None, NOW_NS)
    assert level == 1
    assert "`acsard doctor`" in words

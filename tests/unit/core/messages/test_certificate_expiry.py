"""The daemon reports in time that a certificate expires. It also reports an unreadable date."""

from __future__ import annotations

from acsard.core.messages.certificate_expiry import DAY_NS, expiry
from tests.each import each

NOW_NS = 1_700_000_000_000_000_000


@each(
    ("days", "code", "words"),
    [
        (400, "valid", "valid for 400 days"),
        (30, "valid", "valid for 30 days"),
        (29, "expires", "expires in 29 days"),
        (0, "expires", "expires in 0 days"),
        (
            -2,
            "expired",
            "expired 2 days ago: if it is the certificate of the robot, TLS refuses every client",
        ),
    ],
)
def test_expiry_is_a_warning_for_a_month_before_the_end_and_an_error_after_it(
    days: int, code: str, words: str
) -> None:
    assert expiry({"": NOW_NS + days * DAY_NS}, NOW_NS) == (code, words)


def test_the_certificate_that_expires_first_is_named_unless_it_is_the_robot_s_own() -> None:
    ends = {"": NOW_NS + 10 * DAY_NS, "the authority": NOW_NS + 400 * DAY_NS}
    assert expiry(ends, NOW_NS)[1] == "expires in 10 days"
    ends["the router tls/router.local:7447"] = NOW_NS - 3 * DAY_NS
    text = "expired 3 days ago (certificate of the router tls/router.local:7447)"
    assert expiry(ends, NOW_NS) == ("expired", text)
    ends[""] = NOW_NS - DAY_NS
    assert expiry(ends, NOW_NS) == ("expired", f"{text}: TLS refuses every client")


def test_an_authority_that_expires_together_with_its_gateway_certificate_is_named() -> None:
    """The gateway's report is the earlier expiry of its own certificate and of its authority's."""
    ends = {"": NOW_NS + 10 * DAY_NS, "the authority": NOW_NS + 10 * DAY_NS}
    assert expiry(ends, NOW_NS) == ("expires", "expires in 10 days (certificate of the authority)")


def test_an_expired_authority_is_not_said_to_block_the_clients() -> None:
    """Zenoh ignores the dates of an authority, as `test_tls_trouble.py` shows."""
    ends = {"": NOW_NS + 10 * DAY_NS, "the authority": NOW_NS - 3 * DAY_NS}
    assert expiry(ends, NOW_NS)[1] == "expired 3 days ago (certificate of the authority)"


def test_an_unreadable_certificate_is_a_warning_with_the_remedy() -> None:
    level, words = expiry({}, NOW_NS)
    assert level == "unknown"
    assert words.startswith("unknown: the TLS gateway is not running, or ")
    assert "`acsard doctor`" in words

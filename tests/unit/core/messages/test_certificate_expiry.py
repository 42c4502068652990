"""The daemon reports in time that a certificate expires. It also reports an unreadable date."""

from __future__ import annotations

from acsard.core.messages.certificate_expiry import DAY_NS, expiry
from tests.each import each

NOW_NS = 1_700_000_000_000_000_000


@each(
    ("days", "code"),
    [(400, "valid"), (30, "valid"), (29, "expires"), (0, "expires"), (-2, "expired")],
)
def test_expiry_is_a_warning_for_a_month_before_the_end_and_an_error_after_it(
    days: int, code: str
) -> None:
    assert expiry({"": NOW_NS + days * DAY_NS}, NOW_NS)[0] == code


def test_an_unreadable_certificate_is_unknown() -> None:
    assert expiry({}, NOW_NS)[0] == "unknown"


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
    assert expiry(ends, NOW_NS)[1].endswith(" (certificate of the authority)")

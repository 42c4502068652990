"""Refusals are logged as one line, by reason and by client, exactly once."""

from __future__ import annotations

from acsard.web.counts import KNOWN, NAMED, Counts


def test_refusals_are_one_line_by_reason_and_told_once() -> None:
    counts = Counts()
    assert counts.news() is None
    for _ in range(12):
        counts.refuse("bad_token")
    counts.refuse("origin")
    told = counts.news()
    assert told is not None
    assert (told.name, told.level, told.count) == ("page_refused", "warning", 13)
    assert told.text == "12 bad token, 1 origin"
    assert counts.news() is None
    counts.refuse("origin")
    told = counts.news()
    assert told is not None
    assert told.text == "1 origin"
    assert counts.refused() == {"bad_token": 12, "origin": 2}


def test_who_was_refused_most_is_named_and_with_the_next_line_anew() -> None:
    counts = Counts()
    for _ in range(3):
        counts.refuse("role", "192.168.1.50 (tv)")
    counts.refuse("bad_token", "192.168.1.7")
    counts.refuse("slow")
    told = counts.news()
    assert told is not None
    assert told.text == (
        "3 role, 1 bad token, 1 slow; 3 from 192.168.1.50 (tv), 1 from 192.168.1.7, 1 from others"
    )
    counts.refuse("role", "192.168.1.7")
    told = counts.news()
    assert told is not None
    assert told.text == "1 role; 1 from 192.168.1.7"


def test_who_has_many_addresses_makes_no_line_longer() -> None:
    counts = Counts()
    for n in range(2 * KNOWN):
        counts.refuse("bad_token", f"2001:db8::{n:x}")
    for _ in range(2):
        counts.refuse("bad_token", "2001:db8::1")
    told = counts.news()
    assert told is not None
    assert told.text.count(" from ") == NAMED + 1
    assert "; 3 from 2001:db8::1, " in told.text
    assert told.text.endswith(f", {2 * KNOWN - NAMED} from others")

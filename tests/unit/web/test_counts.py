"""What was refused goes to the log as one line, by reason, and once."""

from __future__ import annotations

from acsard.web.counts import Counts


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

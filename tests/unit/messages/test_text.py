"""Text from an unknown sender cannot control a terminal."""

from __future__ import annotations

import json

from hypothesis import given
from hypothesis import strategies as st

from acsard.messages.text import json_line, lines, printable

HOSTILE = "a\x1b]0;PWNED\x07b\x9b2J\u202ec\r\nd\te"


def test_nothing_that_a_terminal_obeys_is_left() -> None:
    assert printable(HOSTILE) == "a\ufffd]0;PWNED\ufffdb\ufffd2J\ufffdc  d e"
    assert lines(HOSTILE) == "a\ufffd]0;PWNED\ufffdb\ufffd2J\ufffdc \nd e"
    assert printable("Zürich, 8.5 °C") == "Zürich, 8.5 °C"


@given(st.text(alphabet=st.characters(exclude_categories=["Cs"], max_codepoint=0xFFFF)))
def test_json_stays_the_same_and_can_be_printed(text: str) -> None:
    line = json_line(json.dumps(text, ensure_ascii=False))
    assert json.loads(line) == text
    assert line.isprintable()

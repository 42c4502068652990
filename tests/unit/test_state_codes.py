"""Each code of the table is produced somewhere, and no other code is published."""

from __future__ import annotations

import re
import string
from pathlib import Path
from typing import get_args

import acsard
from acsard.core.codes import CODES, Code, StateCode, StopCode, joined, reason, sentence
from acsard.recording.file import SUFFIX, Recording
from tests import recordings

PACKAGE = Path(acsard.__file__).parent

VALUES = {
    "source": "app", "seconds": 0.5, "alone": "", "lasts": "", "ros": "", "note": "2",
    "firmware": "", "others": "2 other senders", "bumpers": "front bumper pressed",
    "direction": "backwards",
    "speed": 0.1, "by": "ann", "cause": "why", "places": "1 place", "dots": ".",
    "threshold": "21 V", "charged": "21.4 V", "wheel": "rear_left", "figures": "(1 rad/s)",
    "trouble": "why", "received": "nothing", "interval": "0.20", "longest": 0.25,
    "named": "rain", "wheels": "front_left and front_right", "share": "50 %",
}  # fmt: skip
"""A value for each name in the texts."""


def test_the_recordings_publish_only_codes_of_the_table() -> None:
    seen = set()
    for path in Path(recordings.__file__).parent.glob(f"*{SUFFIX}"):
        for step in Recording([path]).steps():
            code = step.recorded.status.code
            assert code in get_args(StateCode)
            seen.add(code)
            assert {event.code for event in step.recorded.events} <= {"", *CODES}
    assert len(seen) > 5


def test_every_text_and_every_advice_is_a_sentence_that_needs_only_known_values() -> None:
    names = set()
    for code in get_args(Code):
        entry = CODES[code]
        for part in (entry.text, entry.advice):
            names |= {name for _, name, _, _ in string.Formatter().parse(part) if name}
        why = sentence(code, **VALUES)
        assert why.code == code
        assert why.text or code == "nothing"
        assert not re.search(r"[;:]$|  ", why.text)
        assert joined(reason(code, "", **VALUES)).text == why.text
    assert names == set(VALUES)


def test_each_stop_and_each_reason_to_rest_says_what_to_do() -> None:
    for code in (*get_args(StopCode), "switched_off", "no_command"):
        assert CODES[code].advice, code

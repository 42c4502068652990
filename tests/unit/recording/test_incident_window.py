"""An event keeps the files recorded around its time."""

from __future__ import annotations

from acsard.recording.retention import AROUND_NS, IncidentWindow, Kind


def kind(around: IncidentWindow[str]) -> Kind:
    """Return the kind of the file that is being written now."""
    return around.kind


def test_a_file_that_ended_less_than_a_minute_before_an_incident_is_retained_once() -> None:
    around = IncidentWindow[str]()
    for number in range(4):
        around.begin(number * AROUND_NS // 2)
        around.end(str(number), (number + 1) * AROUND_NS // 2)
    around.begin(2 * AROUND_NS)
    assert around.happened(2 * AROUND_NS + 1) == ["2", "3"]
    assert kind(around) == "kept"
    assert around.happened(2 * AROUND_NS + 2) == []


def test_a_file_that_begins_less_than_a_minute_after_an_incident_is_near() -> None:
    around = IncidentWindow[str]()
    around.begin(0)
    assert kind(around) == "plain"
    around.happened(10)
    around.end("it", 20)
    around.begin(9 + AROUND_NS)
    assert kind(around) == "near"
    around.end("near", 10 + AROUND_NS)
    around.begin(10 + AROUND_NS)
    assert kind(around) == "plain"
    assert around.happened(10 + AROUND_NS) == []


def test_incidents_count_over_a_restart() -> None:
    around = IncidentWindow[str]()
    around.earlier("plain", "plain", -5)
    around.earlier("near", "near", -5)
    around.begin(0)
    assert kind(around) == "plain"
    assert around.happened(1) == ["plain"]
    other = IncidentWindow[str]()
    other.earlier("kept", "kept", -5)
    other.begin(0)
    assert kind(other) == "near"


def test_a_crash_before_this_run_is_an_incident() -> None:
    around = IncidentWindow[str]()
    around.earlier_happened(-AROUND_NS)
    around.begin(0)
    assert kind(around) == "plain"
    around.earlier_happened(1 - AROUND_NS)
    around.begin(0)
    assert kind(around) == "near"

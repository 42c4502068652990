"""Tests of the effective track that odometry uses.

Odometry uses the configured track until it has learned a track from the gyro. The learned track
stays within bounds.
"""

from __future__ import annotations

import pytest

from acsard.core.motion.learned_track import (
    CERTAIN,
    CONFIGURED,
    TRACK_RATIO_RANGE,
    UNCERTAIN,
    LearnedTrack,
    Track,
    tracks,
)
from acsard.core.values import GyroStatus, TrackUse

SURE = CERTAIN / 2


def event_kind(track: LearnedTrack) -> str | None:
    return None if track.event is None else track.event.kind


def test_the_configured_track_is_used_until_the_learned_track_is_certain() -> None:
    track = LearnedTrack(1.0)
    track.choose(None)
    track.choose(Track(1.6, 2 * CERTAIN))
    assert (track.used, track.use, track.event) == (CONFIGURED, "uncertain", None)


def test_a_certain_learned_track_is_used_and_reported_once() -> None:
    track = LearnedTrack(1.5)
    track.choose(Track(1.2, CERTAIN))
    assert track.used == Track(1.2, CERTAIN)
    assert track.event is not None
    assert (track.event.name, track.event.kind, track.event.level) == (
        "learned_track",
        "used",
        "info",
    )
    assert track.event.text.endswith(": learned 1.800 ± 0.180 (in use), configured 1.500")
    track.choose(Track(1.25, SURE))
    assert track.used == Track(1.25, SURE)
    assert event_kind(track) is None


def test_a_learned_track_in_use_is_dropped_only_if_it_becomes_clearly_uncertain() -> None:
    track = LearnedTrack(1.0)
    for deviation, use in (
        (SURE, "used"), (1.5 * CERTAIN, "used"), (1.01 * UNCERTAIN, "uncertain"),
        (1.5 * CERTAIN, "uncertain"), (CERTAIN, "used"),
    ):  # fmt: skip
        track.choose(Track(1.6, deviation))
        assert track.use == use
        assert (track.used == CONFIGURED) is (use != "used")


@pytest.mark.parametrize("share", [0.99 * TRACK_RATIO_RANGE[0], 1.01 * TRACK_RATIO_RANGE[1]])
def test_a_learned_track_too_far_from_the_configured_one_is_reported_and_not_used(
    share: float,
) -> None:
    track = LearnedTrack(1.0)
    track.choose(Track(share, SURE))
    assert track.used == CONFIGURED
    assert track.event is not None
    assert track.event.level == "warning"
    assert "(out of range, not used), configured 1.000 (in use)" in track.event.text
    track.choose(Track(share, SURE))
    assert event_kind(track) is None


@pytest.mark.parametrize(
    ("bound", "inwards"), [(TRACK_RATIO_RANGE[0], 1.0), (TRACK_RATIO_RANGE[1], -1.0)]
)
def test_a_learned_track_at_a_bound_is_not_switched_on_and_off(
    bound: float, inwards: float
) -> None:
    """Odometry uses a learned track until it leaves the bounds.

    To be used again, the learned track must come back a little further inside the bounds.
    """
    within, beyond = (Track(bound * (1.0 + inwards * off), SURE) for off in (0.001, -0.001))
    track = LearnedTrack(1.0)
    track.choose(Track(1.0, SURE))
    track.choose(Track(bound, SURE))
    assert track.use == "used"
    reports = []
    for _ in range(10):
        for learned in (beyond, within):
            track.choose(learned)
            reports.append(event_kind(track))
    assert reports == ["too far off", *[None] * 19]
    track.choose(Track(bound * (1.0 + inwards * 0.06), SURE))
    assert event_kind(track) == "used"


def test_a_learned_track_too_far_off_is_reported_once_while_it_is_nearly_certain() -> None:
    track, reports = LearnedTrack(1.0), []
    for _ in range(10):
        for deviation in (0.99 * CERTAIN, 1.01 * CERTAIN):
            track.choose(Track(2 * TRACK_RATIO_RANGE[1], deviation))
            reports.append(event_kind(track))
    assert reports == ["too far off", *[None] * 19]


@pytest.mark.parametrize(
    ("use", "text"),
    [
        ("shown", "learned 1.800 ± 0.090 (only reported), configured 1.500 (in use)"),
        ("uncertain", "learned 1.800 ± 0.090 (uncertain), configured 1.500 (in use)"),
        ("used", "learned 1.800 ± 0.090 (in use), configured 1.500"),
    ],
)
def test_the_text_compares_the_learned_and_the_configured_multiplier(
    use: TrackUse, text: str
) -> None:
    assert tracks(GyroStatus("used", track=1.2, track_deviation=0.05, track_use=use), 1.5) == text
    assert tracks(GyroStatus("used", track_use=use), 1.5) == ""

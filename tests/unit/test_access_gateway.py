"""The health of the TLS gateway's sessions."""

from __future__ import annotations

from acsard.daemon.gateway.session_health import (
    FIRST_CONNECTION_NS,
    LOST_DAEMON_NS,
    MAX_UNANSWERED,
    STUCK_AFTER_NS,
    Observation,
    SessionHealth,
    connection_counts,
)

S = 10**9
MOST = 4


def observation(at_ns: int, *holders: str, linked: bool = True) -> Observation:
    return Observation(at_ns, holders, linked)


def test_a_gateway_with_free_connections_reports_nothing() -> None:
    health = SessionHealth(MOST, 0)
    assert health.full_event(observation(S, "ann", "ben", "ben")) is None
    assert health.restart_event(observation(S), S // 4) is None
    assert health.full == 0


def test_a_full_gateway_names_its_clients_once_a_minute_and_counts_every_observation() -> None:
    holders = [name for name in "abcdefgh" for _ in range(ord(name))]
    assert connection_counts(holders) == "104 by h, 103 by g, 102 by f, 101 by e, 100 by d"
    health, events = SessionHealth(MOST, 0), []
    for number in range(2 * 60 * 4 + 1):
        event = health.full_event(observation(number * S // 4, "ben", "ann", "ben", ""))
        if event is not None:
            events.append((number * S // 4, event))
    assert [at for at, _ in events] == [0, 60 * S, 120 * S]
    _, event = events[0]
    assert (event.name, event.level) == ("gateway_full", "warning")
    assert event.text.startswith(
        "all 4 connections are in use, 2 by ben, 1 by ann, 1 by an unnamed"
    )
    assert health.full == 2 * 60 * 4 + 1


MOMENT = S // 4


def test_an_observation_that_takes_too_long_restarts_the_gateway() -> None:
    health, stuck = SessionHealth(MOST, 0), observation(S)
    assert [health.restart_event(stuck, MOMENT) for _ in range(STUCK_AFTER_NS // MOMENT + 1)][
        -1
    ] is None
    over = health.restart_event(stuck, MOMENT)
    assert over is not None
    assert (over.name, over.level) == ("gateway_stuck", "error")


def test_a_stall_of_the_whole_machine_does_not_restart_the_gateway() -> None:
    health = SessionHealth(MOST, 0)
    assert health.restart_event(observation(S), MOMENT) is None
    assert health.restart_event(observation(S), 60 * S) is None
    assert health.restart_event(observation(61 * S), MOMENT) is None


def test_a_connected_daemon_that_answers_no_query_restarts_the_gateway() -> None:
    health = SessionHealth(MOST, 0)
    for number in range(MAX_UNANSWERED):
        assert health.restart_event(Observation(S, linked=True, unanswered=number), 0) is None
    over = health.restart_event(Observation(S, linked=True, unanswered=MAX_UNANSWERED), 0)
    assert over is not None
    assert (over.name, over.level) == ("gateway_lost_daemon", "warning")
    assert "4 queries unanswered" in over.text


def test_a_lost_daemon_restarts_the_gateway_later_after_the_start() -> None:
    for first, limit_ns in (([observation(S)], LOST_DAEMON_NS), ([], FIRST_CONNECTION_NS)):
        health = SessionHealth(MOST, S)
        for look in (*first, observation(S + limit_ns, linked=False)):
            assert health.restart_event(look, MOMENT) is None, "it may come back"
        over = health.restart_event(observation(S + limit_ns + 1, linked=False), MOMENT)
        assert over is not None
        assert over.name == "gateway_lost_daemon"

"""The server refuses requests beyond a limit until time passes or a client leaves."""

from __future__ import annotations

from pathlib import Path

import pytest

from acsard.core.values import NS_PER_S
from acsard.host.rate_limits import Buckets
from acsard.web.limits import (
    COMMAND_RATE,
    GUESSES,
    GUESSES_OF_ONE,
    HANDSHAKE_RATE,
    MAX_LOCAL_TCP_CONNECTIONS,
    MAX_LOCAL_WEBSOCKETS,
    MAX_TCP_CONNECTIONS,
    MAX_TCP_OF_NETWORK,
    MAX_TCP_OF_TOKEN,
    MAX_WEBSOCKETS,
    MAX_WEBSOCKETS_OF_NETWORK,
    MAX_WEBSOCKETS_OF_TOKEN,
    MAX_WEBSOCKETS_OF_TOKEN_IN_NETWORK,
    MIN_TCP_CONNECTIONS,
    OPENINGS,
    PICTURES,
    REFUSAL_DELAY_S,
    REQUEST_RATE,
    RESERVED_TCP_OF_TOKEN,
    STOPS,
    STRANGER_RATE,
    Sockets,
    WebSocketLimits,
    sockets_for,
)


def test_a_token_has_a_share_of_the_connections_over_all_its_addresses() -> None:
    limits = WebSocketLimits()
    refusals = [limits.enter(f"10.0.0.{n}", "wall") for n in range(MAX_WEBSOCKETS)]
    assert refusals.count("") == MAX_WEBSOCKETS_OF_TOKEN < MAX_WEBSOCKETS
    assert str(MAX_WEBSOCKETS_OF_TOKEN) in refusals[-1]
    assert not limits.enter("10.0.1.1", "phone")
    limits.leave("10.0.0.0", "wall")
    assert not limits.enter("10.0.2.1", "wall")


def test_a_refused_token_takes_no_place_of_its_address() -> None:
    limits = WebSocketLimits()
    for n in range(MAX_WEBSOCKETS_OF_TOKEN):
        limits.enter(f"10.0.0.{n}", "wall")
    assert all(limits.enter("10.0.1.1", "wall") for _ in range(2 * MAX_WEBSOCKETS_OF_NETWORK))
    assert not limits.enter("10.0.1.1", "phone")


def test_a_token_has_a_share_of_its_address_and_leaves_others_theirs() -> None:
    limits = WebSocketLimits()
    refusals = [limits.enter("10.0.0.1", "broken") for _ in range(MAX_WEBSOCKETS_OF_NETWORK)]
    assert refusals.count("") == MAX_WEBSOCKETS_OF_TOKEN_IN_NETWORK < MAX_WEBSOCKETS_OF_NETWORK
    assert (
        f"{MAX_WEBSOCKETS_OF_TOKEN_IN_NETWORK} pages with this token are open at 10.0.0.1"
        in refusals[-1]
    )
    assert "broken" not in refusals[-1]
    assert not limits.enter("10.0.0.1", "phone")
    assert not limits.enter("10.0.0.2", "broken")
    limits.leave("10.0.0.1", "broken")
    assert limits.refusal("10.0.0.1", "broken") == ""


def test_an_address_has_a_share_of_the_connections_over_all_its_tokens() -> None:
    limits = WebSocketLimits()
    refusals = [limits.enter("10.0.0.1", f"token{n}") for n in range(MAX_WEBSOCKETS)]
    assert refusals.count("") == MAX_WEBSOCKETS_OF_NETWORK
    assert f"{MAX_WEBSOCKETS_OF_NETWORK} from 10.0.0.1" in refusals[-1]
    assert not limits.enter("10.0.0.2", "token0")


def test_all_addresses_of_an_ipv6_network_share_the_limits_of_one_address() -> None:
    limits = WebSocketLimits()
    refusals = [
        limits.enter(f"2001:db8::{n + 1:x}", "broken") for n in range(MAX_WEBSOCKETS_OF_NETWORK)
    ]
    assert refusals.count("") == MAX_WEBSOCKETS_OF_TOKEN_IN_NETWORK
    assert "are open at 2001:db8::/64 already" in refusals[-1]
    refusals = [limits.enter(f"2001:db8::{n + 1:x}", f"token{n}") for n in range(MAX_WEBSOCKETS)]
    assert refusals.count("") == MAX_WEBSOCKETS_OF_NETWORK - MAX_WEBSOCKETS_OF_TOKEN_IN_NETWORK
    assert f"{MAX_WEBSOCKETS_OF_NETWORK} from 2001:db8::/64" in refusals[-1]
    assert not limits.enter("2001:db8:0:1::1", "broken")
    limits.leave("2001:db8::9", "broken")
    assert not limits.enter("2001:db8::a", "broken")


def test_local_browsers_have_reserved_connections() -> None:
    limits = WebSocketLimits()
    for n in range(2 * MAX_WEBSOCKETS):
        limits.enter(f"127.0.0.{n % 9}", f"token{n}")
    assert limits.refusal("127.0.0.1", "another")
    refusals = [limits.enter("127.0.0.1", "") for _ in range(MAX_LOCAL_WEBSOCKETS + 1)]
    assert refusals[:-1] == [""] * MAX_LOCAL_WEBSOCKETS
    assert "on the robot itself" in refusals[-1]
    limits.leave("127.0.0.1", "")
    assert not limits.enter("::1", "")


def test_the_manual_states_the_limits_of_the_connections() -> None:
    page = Path(__file__).parents[3] / "deploy" / "web" / "README.md"
    text = " ".join(page.read_text(encoding="utf-8").split())
    assert (
        f"There are {MAX_WEBSOCKETS} WebSockets for other machines: at most "
        f"{MAX_WEBSOCKETS_OF_NETWORK} of one network (with any tokens), "
        f"{MAX_WEBSOCKETS_OF_TOKEN} with one token (from all its "
        f"networks), and {MAX_WEBSOCKETS_OF_TOKEN_IN_NETWORK} with one token from one network"
    ) in text
    assert f"another {MAX_LOCAL_WEBSOCKETS} WebSockets for the machine itself" in text
    assert f"room for {MAX_TCP_CONNECTIONS} TCP connections from other machines" in text
    assert f"for another {MAX_LOCAL_TCP_CONNECTIONS} from the machine itself" in text
    fewest = next(files for files in range(4096) if sockets_for(files) == MAX_TCP_CONNECTIONS)
    assert f"fewer than {fewest} files" in text
    assert f"A network with {MAX_TCP_OF_NETWORK} such connections" in text
    assert f"A token keeps {MAX_TCP_OF_TOKEN} connections" in text
    assert f"{COMMAND_RATE.hz:g} commands a second, and {COMMAND_RATE.burst:g} at once" in text
    assert f"Some requests wait {REFUSAL_DELAY_S:g} s beyond a rate" in text
    assert f"{STOPS.hz:g} stops or `whoami` a second of one token in one network" in text
    assert f"{PICTURES.hz:g} pictures, {OPENINGS.hz:g} new WebSockets" in text
    assert f"{STRANGER_RATE.hz:g} requests a second of one network without a token" in text
    assert f"{STRANGER_RATE.burst:g} of the requests without a token may come at once" in text
    shakes = HANDSHAKE_RATE
    assert f"begin {shakes.burst:g} TLS handshakes at once, then {shakes.hz:g} a second" in text
    most, hz = GUESSES_OF_ONE.burst, GUESSES_OF_ONE.hz
    assert f"may try {most:g} wrong tokens at once, then one every {1 / hz:g} s" in text
    assert (GUESSES.burst / most, GUESSES.hz / hz) == pytest.approx((10, 10))


def test_each_token_has_its_own_rate_limit() -> None:
    paces, most = Buckets(REQUEST_RATE), int(REQUEST_RATE.burst)
    grants = [paces.take("one", 0) for _ in range(most + 1)]
    assert grants == [True] * most + [False]
    assert paces.take("another", 0)
    assert paces.take("one", NS_PER_S)


def _filled(*networks: str) -> Sockets[str]:
    """Return TCP places that are all used by other clients, by turns from these networks."""
    sockets = Sockets[str](MAX_TCP_CONNECTIONS)
    for n in range(MAX_TCP_CONNECTIONS):
        assert sockets.enter(networks[n % len(networks)], f"stranger {n}") is None
    return sockets


def test_a_full_network_displaces_its_own_oldest_connection_without_a_token() -> None:
    sockets = Sockets[int](MAX_TCP_CONNECTIONS)
    for n in range(MAX_TCP_OF_NETWORK):
        assert sockets.enter("10.0.0.1", n) is None
    sockets.prove(0, "token")
    assert sockets.enter("10.0.0.1", 100) is None  # the known one takes no stranger's place
    assert sockets.enter("10.0.0.1", 101) == 1
    assert sockets.enter("10.0.0.2", 102) is None


def test_if_all_places_are_taken_a_phone_displaces_a_connection_of_the_largest_crowd() -> None:
    sockets = _filled("a", "b", "c", "d", "e")
    assert sockets.enter("phone", "phone") == "stranger 0"
    for n in range(1000):
        assert sockets.enter("abcde"[n % 5], f"more {n}") != "phone"


def test_a_connection_with_a_valid_token_is_never_displaced() -> None:
    sockets = _filled("a", "b", "c", "d", "e")
    sockets.prove("stranger 0", "token")
    victims = [sockets.enter("abcde"[n % 5], f"more {n}") for n in range(1000)]
    assert None not in victims
    assert "stranger 0" not in victims


def test_the_connections_of_a_token_that_has_ended_are_found() -> None:
    sockets = Sockets[str](MAX_TCP_CONNECTIONS)
    proofs = {
        "none": [],
        "lent": ["lent"],
        "kept": ["kept"],
        "both": ["lent", "kept"],
        "here": [""],
    }
    for connection, tokens in proofs.items():
        sockets.enter("10.0.0.1", connection)
        for token in tokens:
            sockets.prove(connection, token)
    assert sockets.ended({"kept", "lent"}) == []
    assert sockets.ended({"kept"}) == ["lent"]
    assert sockets.ended(()) == ["lent", "kept", "both"]


def test_the_connections_of_a_token_beyond_its_share_are_found_when_it_ends() -> None:
    sockets = Sockets[int](MAX_TCP_CONNECTIONS)
    for n in range(MAX_TCP_OF_TOKEN + 20):
        sockets.enter(f"10.0.0.{n}", n)
        sockets.prove(n, "lent")
    assert len(sockets.ended({"kept"})) == MAX_TCP_OF_TOKEN + 20
    sockets.leave(MAX_TCP_OF_TOKEN + 5)
    assert len(sockets.ended({"kept"})) == MAX_TCP_OF_TOKEN + 19


def test_a_token_keeps_a_share_of_the_places_only() -> None:
    sockets = _filled("a", "b", "c", "d", "e")
    for n in range(MAX_TCP_CONNECTIONS):
        sockets.prove(f"stranger {n}", "greedy")
    victims = {sockets.enter(f"phone {n}", f"phone {n}") for n in range(100)}
    assert len(victims) == 100
    assert victims < {f"stranger {n}" for n in range(MAX_TCP_OF_TOKEN, MAX_TCP_CONNECTIONS)}


def test_if_all_connections_have_shown_a_token_the_token_with_the_most_gives_a_place() -> None:
    sockets = _filled("a", "b", "c", "d", "e")
    for n in range(MAX_TCP_CONNECTIONS):
        sockets.prove(f"stranger {n}", f"token {min(n // 50, 4)}")  # token 4 has 56
    assert sockets.enter("phone", "phone") == "stranger 200"


def test_no_token_loses_the_connections_of_one_browser() -> None:
    sockets = _filled("a", "b", "c", "d", "e")
    for n in range(MAX_TCP_CONNECTIONS):
        sockets.prove(f"stranger {n}", f"token {n // RESERVED_TCP_OF_TOKEN}")
    assert sockets.enter("phone", "phone") == "phone"
    sockets.leave("phone")  # it has no place to give back
    sockets.leave("stranger 9")
    assert sockets.enter("phone", "phone") is None


def test_connections_stay_below_the_limit_of_open_files() -> None:
    assert sockets_for(65536) == sockets_for(2048) == sockets_for(1024) == MAX_TCP_CONNECTIONS
    for files in (384, 512, 768):
        assert MIN_TCP_CONNECTIONS <= sockets_for(files) < MAX_TCP_CONNECTIONS
        assert sockets_for(files) + MAX_LOCAL_TCP_CONNECTIONS < files
    assert sockets_for(64) == MIN_TCP_CONNECTIONS

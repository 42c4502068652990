"""Who may send which request to the page: addresses, hosts, origins, proxies and roles."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from acsard.web.callers import (
    LOCAL_NAME,
    MAX_TOKENS,
    AdmittedClient,
    RequestFacts,
    RequestRefusedError,
    by_listed_page,
    cookie_name,
    network_of,
    place,
    require_own_origin,
    tokens_in,
    tokens_offered,
)
from tests.each import each

NAMES = frozenset({"robot.local", "192.168.1.7"})

MAINTAINER = AdmittedClient("maintainer", LOCAL_NAME)
"""The identity of a client on the robot itself."""


@each(
    ("peer", "host"),
    [
        ("127.0.0.1", "localhost:8080"), ("127.0.0.1", "127.0.0.1:8080"),
        ("127.8.8.8", "LOCALHOST"), ("::1", "[::1]:8080"), ("::ffff:127.0.0.1", "127.0.0.1"),
    ],
)  # fmt: skip
def test_a_browser_on_the_robot_s_machine_is_local(peer: str, host: str) -> None:
    assert place(RequestFacts(peer, False, host), NAMES) == "here"
    assert place(RequestFacts(peer, True, host), NAMES) == "here"


@each(
    ("facts", "reason"),
    [
        # a name of an attacker that resolves to 127.0.0.1
        (RequestFacts("127.0.0.1", False, "evil.example:8080"), "host"),
        (RequestFacts("127.0.0.1", False, ""), "host"),
        (RequestFacts("127.0.0.1", False, "localhost.evil.example"), "host"),
        (RequestFacts("127.0.0.1", False, "robot.local"), "host"),
        (RequestFacts("192.168.1.50", False, "robot.local"), "plain"),
        (RequestFacts("192.168.1.50", False, "localhost"), "plain"),
        (RequestFacts("192.168.1.50", True, "localhost"), "host"),
        (RequestFacts("192.168.1.50", True, "127.0.0.1"), "host"),
        (RequestFacts("192.168.1.50", True, "evil.example"), "host"),
        (RequestFacts("", True, ""), "host"),
    ],
)
def test_any_other_host_name_is_refused(facts: RequestFacts, reason: str) -> None:
    with pytest.raises(RequestRefusedError) as error:
        place(facts, NAMES)
    assert error.value.reason == reason


@each("secure", [False, True])
@each("host", ["localhost:8080", "robot.local"])
def test_a_request_through_a_proxy_is_refused(secure: bool, host: str) -> None:
    with pytest.raises(RequestRefusedError, match="proxy") as error:
        place(RequestFacts("127.0.0.1", secure, host, proxied=True), NAMES)
    assert error.value.reason == "proxy"


@pytest.mark.parametrize("host", ["robot.local:8443", "Robot.Local", "192.168.1.7:8443"])
def test_https_with_a_name_of_the_robot_is_remote(host: str) -> None:
    assert place(RequestFacts("192.168.1.50", True, host), NAMES) == "away"
    # A client on the machine that uses the public name needs a token like others.
    assert place(RequestFacts("127.0.0.1", True, host), NAMES) == "away"


@each(
    ("secure", "host", "origin", "site"),
    [
        (False, "localhost:8080", "http://localhost:8080", None),
        (False, "localhost:8080", "http://localhost:8080", "same-origin"),
        (True, "robot.local", "https://Robot.local", None),
        (False, "localhost:8080", None, None),  # a program without a browser
        (False, "localhost:8080", None, "none"),  # typed into the address bar
    ],
)
def test_the_robot_s_own_page_and_programs_pass_the_origin_check(
    secure: bool, host: str, origin: str | None, site: str | None
) -> None:
    require_own_origin(RequestFacts("127.0.0.1", secure, host, origin, site))


@each(
    ("origin", "site"),
    [
        ("http://evil.example", None), ("https://localhost:8080", None),
        ("http://localhost:8081", None), ("http://localhost", None), ("null", None), ("", None),
        (None, "cross-site"), (None, "same-site"),
    ],
)  # fmt: skip
def test_a_page_of_another_origin_is_refused(origin: str | None, site: str | None) -> None:
    with pytest.raises(RequestRefusedError) as error:
        require_own_origin(RequestFacts("127.0.0.1", False, "localhost:8080", origin, site))
    assert error.value.reason == "origin"


def test_a_role_has_the_permissions_of_the_roles_below_it() -> None:
    viewer, operator = AdmittedClient("viewer", "tv"), AdmittedClient("operator", "phone")
    assert [viewer.may("viewer"), viewer.may("operator")] == [True, False]
    assert [operator.may("operator"), operator.may("maintainer")] == [True, False]
    assert MAINTAINER.may("maintainer")
    operator.require("operator", "clear")
    with pytest.raises(
        RequestRefusedError, match="clear is for operators; your role is viewer"
    ) as error:
        viewer.require("operator", "clear")
    assert error.value.reason == "role"


def test_a_page_reads_its_own_cookie_first_and_no_other_robot_s_cookie() -> None:
    """A page also receives the cookies of other robots.

    A browser sends the cookies of all ports of a host.
    """
    cookies = {
        cookie_name("robot1", 8444): "elsewhere",
        cookie_name("robot2", 8443): "another robot's",
        cookie_name("robot1-8443", 8443): "another robot's",
        cookie_name("robot1", 8443): "own",
        "session": "no token",
    }
    assert tokens_in(cookies, "robot1", 8443) == ["own", "elsewhere"]
    assert tokens_in(cookies, "robot3", 8443) == []
    assert tokens_in({}, "robot1", 8443) == []


def test_a_limited_number_of_cookies_is_read_and_includes_the_page_s_own() -> None:
    cookies = {cookie_name("robot1", port): str(port) for port in range(9000)}
    tokens = tokens_in(cookies, "robot1", 8443)
    assert (len(tokens), tokens[0]) == (MAX_TOKENS, "8443")


def test_an_ipv6_address_counts_by_its_network_and_an_ipv4_address_by_itself() -> None:
    addresses = ("2001:db8:1:2:3::4", "2001:db8:1:2::ffff", "2001:db8:1:3::4", "192.168.1.7", "")
    assert [network_of(address) for address in addresses] == [
        "2001:db8:1:2::/64", "2001:db8:1:2::/64", "2001:db8:1:3::/64", "192.168.1.7", "",
    ]  # fmt: skip
    assert network_of("fe80::1%eth0") == "fe80::/64"


def test_an_origin_is_listed_only_if_all_its_parts_match() -> None:
    origins = {"http://127.0.0.1:5173", "https://panel.example"}
    for origin, listed in {
        "http://127.0.0.1:5173": True,
        "HTTPS://panel.example": True,
        "http://127.0.0.1:51730": False,
        "http://127.0.0.1": False,
        "https://panel.example.evil.example": False,
        "https://panel.example:8443": False,
        "null": False,
        "": False,
        None: False,
    }.items():
        facts = RequestFacts("127.0.0.1", False, "localhost:8080", origin)
        assert by_listed_page(facts, origins) == listed, origin


def test_the_robot_s_own_page_keeps_its_cookie_if_its_origin_is_listed_too() -> None:
    origins = {"https://robot1.local:8443", "http://robot1.local:8443"}
    own = RequestFacts("192.168.1.7", True, "Robot1.local:8443", "https://robot1.local:8443")
    require_own_origin(own)
    assert not by_listed_page(own, origins)
    assert by_listed_page(replace(own, host="192.168.1.4:8443"), origins)
    assert by_listed_page(replace(own, secure=False), origins)


def test_a_token_may_be_the_name_of_a_subprotocol() -> None:
    assert tokens_offered("acsard, acsard.token.a-B_9") == ["a-B_9"]
    assert tokens_offered("acsard") == tokens_offered("") == tokens_offered("token.x") == []
    many = ", ".join(f"acsard.token.{n}" for n in range(500))
    assert tokens_offered(many) == [str(n) for n in range(MAX_TOKENS)]

"""Tests that find the connected endpoints of `bus.connect` from the links that Zenoh reports."""

from __future__ import annotations

from acsard.daemon.bus.router_links import unreached
from tests.each import each

A, B = "tcp/127.0.0.1:7447", "tcp/127.0.0.1:7450"


@each(
    ("mode", "endpoints", "ends", "missing"),
    [
        ("peer", (A,), {A}, ()),
        ("peer", (A,), set(), (A,)),
        # the TLS gateway or a ROS node connected to this process
        ("peer", (A,), {"tcp/127.0.0.1:50123"}, (A,)),
        ("peer", (A, B), {A}, (B,)),
        ("peer", (A, B), {A, B}, ()),
        ("peer", ("tcp/localhost:7447",), {A}, ()),
        ("peer", ("tcp/localhost:7447", B), {B}, ("tcp/localhost:7447",)),
        ("peer", ("tcp/nobody.invalid:7447",), set(), ("tcp/nobody.invalid:7447",)),
        # the name was resolved before
        ("peer", ("tcp/nobody.invalid:7447",), {"tcp/10.0.0.7:7447"}, ()),
        ("peer", ("tls/nobody.invalid:7447",), {A}, ("tls/nobody.invalid:7447",)),
        ("peer", ("tls/127.0.0.1:7447",), {A}, ("tls/127.0.0.1:7447",)),
        ("peer", ("tcp/127.0.0.1:7447?rel=0",), {A}, ()),
        ("peer", ("tcp/[::1]:7447",), {"tcp/[::1]:7447"}, ()),
        ("peer", ("unixsock-stream//run/zenoh",), set(), ("unixsock-stream//run/zenoh",)),
        ("client", (A, B), {B}, ()),
        ("client", (A, B), set(), (A, B)),
    ],
)
def test_an_endpoint_without_a_link_to_it_is_missing(
    mode: str, endpoints: tuple[str, ...], ends: set[str], missing: tuple[str, ...]
) -> None:
    assert unreached(mode, endpoints, ends) == missing

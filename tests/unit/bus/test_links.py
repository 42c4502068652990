"""Which of `bus.connect` is connected, by the links that Zenoh has."""

from __future__ import annotations

import pytest

from acsard.bus.links import unreached

A, B = "tcp/127.0.0.1:7447", "tcp/127.0.0.1:7450"


@pytest.mark.parametrize(
    ("mode", "endpoints", "ends", "routers", "missing"),
    [
        ("peer", (A,), {A}, 1, ()),
        ("peer", (A,), set(), 0, (A,)),
        ("peer", (A,), {"tcp/127.0.0.1:50123"}, 0, (A,)),  # a ROS node that dialled us
        ("peer", (A,), {A}, 0, ()),  # another peer, which no router is
        ("peer", (A, B), {A}, 1, (B,)),
        ("peer", (A, B), {A, B}, 2, ()),
        ("peer", ("tcp/localhost:7447",), {A}, 0, ()),
        ("peer", ("tcp/localhost:7447", B), {B}, 1, ("tcp/localhost:7447",)),
        ("peer", ("tcp/nobody.invalid:7447",), set(), 0, ("tcp/nobody.invalid:7447",)),
        ("peer", ("tcp/nobody.invalid:7447",), {A}, 1, ()),  # by a name that only Zenoh knows
        ("peer", ("tls/127.0.0.1:7447",), {A}, 0, ("tls/127.0.0.1:7447",)),
        ("peer", ("tcp/127.0.0.1:7447?rel=0",), {A}, 0, ()),
        ("peer", ("tcp/[::1]:7447",), {"tcp/[::1]:7447"}, 0, ()),
        ("peer", ("unixsock-stream//run/zenoh",), set(), 0, ("unixsock-stream//run/zenoh",)),
        ("client", (A, B), {B}, 1, ()),
        ("client", (A, B), set(), 0, (A, B)),
    ],
)
def test_an_endpoint_without_a_link_to_it_is_missing(
    mode: str, endpoints: tuple[str, ...], ends: set[str], routers: int, missing: tuple[str, ...]
) -> None:
    assert unreached(mode, endpoints, ends, routers) == missing

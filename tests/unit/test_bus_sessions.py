"""An error of Zenoh's session names the addresses that the session uses, and the right remedy."""

from __future__ import annotations

import pytest

from acsard.bus.zenoh_sessions import daemon_session
from acsard.core.config.settings import BusConfig, Config
from acsard.host.errors import InUseError, MendableError


def test_a_client_that_cannot_open_its_session_names_its_router_and_no_address_to_listen_on() -> (
    None
):
    config = Config(bus=BusConfig(mode="client", connect=("nonsense",)))
    with pytest.raises(MendableError) as caught:
        daemon_session(config)
    assert not isinstance(caught.value, InUseError)
    text = str(caught.value)
    assert text.startswith("cannot open the Zenoh session to nonsense: ")
    assert text.endswith("; check bus.connect, then start acsard again")
    assert "listen" not in text

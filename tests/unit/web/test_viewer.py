"""What cannot be put on the bus is dropped and counted, and the next command is looked at."""

from __future__ import annotations

from typing import Any

from acsard.client import Client
from acsard.client.commander import Commander, Sender, Wish
from acsard.core.messages.signature import unpack
from acsard.core.values import Twist
from acsard.web.limits import COMMANDS
from acsard.web.metrics import Counts
from acsard.web.viewer import ViewerCommands

PATIENCE_S = 20.0

AHEAD = Wish(Twist(0.2, 0.0), 1000, steady=True)


def test_what_cannot_be_sent_is_dropped_and_the_next_one_is_looked_at() -> None:
    def broken() -> Client | None:
        raise OverflowError("no room in 64 bits")

    counts = Counts()
    commands = ViewerCommands(broken, counts)
    senders = {name: (Commander(), Sender(name)) for name in "ab"}
    for name in "aba":
        commands.give(name, "app", *senders[name], AHEAD)
        commands.outbox.flush(PATIENCE_S)
    assert counts.all() == {"commands_dropped": 3}
    assert not commands.outbox.dead.done()


def test_a_command_is_put_with_the_stamp_and_the_clock_of_its_sender() -> None:
    put: list[Any] = []

    class Fake:
        def put(self, twist: Any, signature: Any, source: str) -> None:
            assert source == "teleop"
            put.append((twist.linear.x, twist.angular.z, unpack(signature.pack())))

    fake: Any = Fake()
    counts = Counts()
    commands = ViewerCommands(lambda: fake, counts)
    commander, sender = Commander(), Sender("joe/aa")
    for stamp_ns in (1000, 2000):
        wish = Wish(Twist(0.2, -0.5), stamp_ns, steady=True)
        assert commands.give("joe", "teleop", commander, sender, wish)
        commands.outbox.flush(PATIENCE_S)
    assert [(x, z) for x, z, _ in put] == [(0.2, -0.5)] * 2
    signed = [one for *_, one in put]
    assert [one.stamp for one in signed] == [1000, 2000]
    assert [one.sequence for one in signed] == [1, 2]
    assert {(one.sender, one.steady) for one in signed} == {("joe/aa", True)}
    assert counts.all() == {"commands": 2}


def test_a_token_that_commands_without_end_is_refused_except_a_zero_after_a_speed() -> None:
    commands, sender = ViewerCommands(lambda: None, Counts()), Sender("joe/aa")
    flooding, driving, other = Commander(), Commander(), Commander()
    rest = Wish(Twist(0.0, 0.0), 1000, steady=True)
    assert commands.give("token", "teleop", driving, sender, AHEAD)
    given = [commands.give("token", "app", flooding, sender, rest) for _ in range(1000)]
    assert COMMANDS.most - 1 <= given.count(True) < COMMANDS.most + 100
    assert not commands.give("token", "teleop", driving, sender, AHEAD)
    assert commands.give("token", "teleop", driving, sender, rest)
    assert not commands.give("token", "teleop", driving, sender, rest)
    assert commands.give("another", "teleop", other, sender, AHEAD)

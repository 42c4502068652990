"""Plays a plan without the judges, for a comparison with another checkout.

The judges check the present promises, and an older product breaks some of them. So a paired run
compares the behaviour of both products without judging either.
"""

from __future__ import annotations

from typing import Any

from tests.simulate.actors import Run
from tests.simulate.product import StepResult
from tests.simulate.roads import NS, Message


class Unjudged(Run):
    """A run that hands each step to `log` and judges nothing."""

    def played(self) -> str:
        """Play the plan without the lawful drive at its end. Return an exception as text, or ""."""
        try:
            self._begin()
            self.run_to(int(self.plan["seconds"] * NS))
        except Exception as error:  # noqa: BLE001 - the product may raise any
            return f"{type(error).__name__}: {error}"
        return ""

    @property
    def simulated_s(self) -> float:
        """The simulated time in s, without the time in which the host slept."""
        return (self.true_ns - self.slept_ns) / NS

    def deliver(self, sender: dict[str, Any], message: Message) -> None:
        """Deliver a message to the daemon if it runs."""
        if self.product.alive:
            at_ns = self._arrival(message.arrives_ns)
            command = self.sampled(sender, message)
            if command is None:
                return
            boot_ns = at_ns + self.slept_ns
            self.product.deliver(
                at_ns, command.key, command.payload, boot_ns=boot_ns, **command.options
            )

    def _fed(self, at_ns: int, data: bytes) -> None: ...

    def _check_state(self) -> None: ...

    def _weigh(self) -> None: ...

    def _take_answers(self) -> None:
        for ticket, _ in self.product.replies():
            self._calls.pop(ticket, None)

    def _judge(self, snapshot: StepResult) -> None:
        if self._calls:
            self._take_answers()
        if self.log is not None:
            self.log(
                {
                    "at": snapshot.at_ns, "mode": snapshot.mode, "reason": snapshot.reason,
                    "lines": [[at, line.decode("latin-1")] for at, line in snapshot.lines],
                    "odometry": snapshot.estimates,
                }
            )  # fmt: skip

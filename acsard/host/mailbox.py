"""Hands items from any threads to one reader: bounded, newest wins, with a wake-up.

A writer never waits, neither for the reader nor for a lock. If the reader falls behind, each new
item takes the place of the oldest one. A writer stores its item before it wakes the reader, and the
reader looks at the items after it wakes, so no wake-up is lost. The reader may be woken although no
item waits.

Two kinds of queues are not mailboxes: one whose oldest items are worth more than its newest ones
(the log, the recording), and one in which no item may be lost (replies to queries).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from threading import Lock
from typing import Generic, TypeVar

from acsard.core.values import NS_PER_S
from acsard.host import clock

T = TypeVar("T")


class Bell:
    """Signal that wakes one waiting thread.

    If `ring` was called before `wait`, once or several times, that wait ends at once.
    """

    def __init__(self) -> None:
        self._lock = Lock()
        self._lock.acquire()

    def ring(self) -> None:
        """End the present wait, or the next one if no thread waits. Any thread may call this."""
        # Releasing a lock is the cheapest way to wake a thread.
        if self._lock.locked():
            try:
                self._lock.release()
            except RuntimeError:
                pass  # another thread called this method at the same moment

    def wait(self, seconds: float | None = None) -> bool:
        """Wait until `ring` is called. Return False after `seconds`; None waits for ever."""
        return self._lock.acquire(timeout=-1 if seconds is None else max(0.0, seconds))


class Mailbox(Generic[T]):
    """The items that wait for their reader, in the order of their arrival."""

    def __init__(self, most: int, wake: Callable[[], object] | None = None) -> None:
        """Create an empty mailbox.

        Args:
            most: largest number of waiting items.
            wake: function that `put` calls on the writer's thread after it has stored an item. The
                default ends the reader's `wait`.
        """
        self.waiting: deque[T] = deque(maxlen=most)
        """The items that wait, the oldest on the left. Only the reader may remove items from it.

        The attribute is public because the daemon checks about forty mailboxes in each step. A
        method call for each of them would take too long.
        """
        self.lost = 0
        """Number of items that newer ones have displaced. It is exact if there is one writer."""
        self._bell = Bell()
        self.wake = wake or self._bell.ring
        """Wakes the reader. A writer that uses `store` calls it afterwards."""
        self.closed = False
        """Whether no more items will arrive. Earlier items may still wait."""

    # The writers' side

    def store(self, item: T) -> bool:
        """Store an item without waking the reader; return False if the oldest item was dropped.

        The result is exact if there is one writer.
        """
        items = self.waiting
        room = len(items) < items.maxlen  # type: ignore[operator]
        if not room:
            # Count the loss before storing the item, so that a reader of the item sees the count.
            self.lost += 1
        items.append(item)
        return room

    def put(self, item: T) -> bool:
        """Store an item and wake the reader; return False if the oldest item was dropped for it."""
        room = self.store(item)
        self.wake()
        return room

    def close(self) -> None:
        """Mark the end of the items, and wake the reader, which still gets the items that wait."""
        self.closed = True
        self.wake()

    # The reader's side

    def wakes(self, wake: Callable[[], object]) -> None:
        """Let writers call `wake` from now on, instead of ending `wait`.

        It is called at once if an item waits or the mailbox is closed.
        """
        self.wake = wake
        if self.waiting or self.closed:
            wake()

    def pop(self) -> T | None:
        """Remove and return the oldest item, or return None if none waits."""
        # No other thread can take the item in between, because there is one reader.
        return self.waiting.popleft() if self.waiting else None

    def take(self) -> list[T]:
        """Remove and return the items that wait now. Items that arrive during the call stay."""
        items = self.waiting
        return [items.popleft() for _ in range(len(items))]

    def wait(self, seconds: float | None = None) -> bool:
        """Wait for an item or for `close`. Return False after `seconds`; None waits for ever."""
        began_ns, left = clock.mono_ns(), seconds
        while not (self.waiting or self.closed):
            if left is not None and left <= 0:
                return False
            self._bell.wait(left)
            if seconds is not None:
                left = seconds - (clock.mono_ns() - began_ns) / NS_PER_S
        return True

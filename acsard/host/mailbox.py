"""Passes items from any threads to one reader through a bounded queue, and wakes the reader.

A writer never waits for the reader or for a lock: a new item displaces the oldest one of a full
queue. A writer stores its item before it wakes the reader, and the reader looks for items after it
wakes, so no item is overlooked. Do not use it where old items are worth more than new ones (the
log, the recording), or where no item may be lost (replies to queries).
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
    """Wakes another thread: `ring` ends its `wait`, or the next one if it does not wait yet."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._lock.acquire()

    def ring(self) -> None:
        """End the present or the next `wait`. Any thread may call this."""
        # Releasing a lock is the cheapest way to wake a thread.
        if self._lock.locked():
            try:
                self._lock.release()
            except RuntimeError:
                pass  # another thread called this method at the same moment

    def wait(self, seconds: float | None = None) -> bool:
        """Return True when `ring` is called, or False after `seconds` (None: no limit)."""
        return self._lock.acquire(timeout=-1 if seconds is None else max(0.0, seconds))


class Mailbox(Generic[T]):
    """Bounded queue of the items that wait for one reader, in the order of their arrival."""

    def __init__(self, most: int, wake: Callable[[], object] | None = None) -> None:
        # `put` calls `wake` in the writer's thread. Without it, it wakes a reader in `wait`.
        # The oldest comes first, and only the reader removes items. Public, because a control step
        # reads forty mailboxes, and forty calls would be slow.
        self.waiting: deque[T] = deque(maxlen=most)
        self.lost = 0  # approximate with several writers
        self._bell = Bell()
        self.wake = wake or self._bell.ring  # for a writer that calls `store`
        self.closed = False  # no writer stores more; earlier items may still wait

    # The writers' side

    def store(self, item: T) -> bool:
        """Store an item without waking the reader; return False if the oldest item went for it.

        The result may be wrong if several threads store at the same time.
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
        """Declare that no more items will come, and wake the reader; items that wait stay."""
        self.closed = True
        self.wake()

    # The reader's side

    def wakes(self, wake: Callable[[], object]) -> None:
        """Replace the function that wakes the reader, and call it if an item waits already.

        Such a reader must not call `wait`.
        """
        self.wake = wake
        if self.waiting or self.closed:
            wake()

    def pop(self) -> T | None:
        # No other thread can take the item in between, because there is one reader.
        return self.waiting.popleft() if self.waiting else None

    def take(self) -> list[T]:
        """Remove and return the items that wait now. Items that arrive during the call stay."""
        items = self.waiting
        return [items.popleft() for _ in range(len(items))]

    def wait(self, seconds: float | None = None) -> bool:
        """Return True when there is an item or no more will come, or False after `seconds`."""
        began_ns, left = clock.mono_ns(), seconds
        while not (self.waiting or self.closed):
            if left is not None and left <= 0:
                return False
            self._bell.wait(left)
            if seconds is not None:
                left = seconds - (clock.mono_ns() - began_ns) / NS_PER_S
        return True

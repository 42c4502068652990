"""Passes items from any threads to one reader through a bounded queue, and wakes the reader.

A writer never waits for the reader or for a lock. If the queue is full, each new item displaces the
oldest item. A writer stores its item before it wakes the reader, and the reader looks for items
after it wakes. So no item is overlooked, but the reader may wake without an item.

Do not use a mailbox in two cases: old items are worth more than new ones (the log, the recording),
or no item may be lost (replies to queries).
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
    """Signal with which a thread wakes another thread.

    `ring` ends the `wait` of the other thread. If no thread waits, `ring` ends the next `wait`.
    """

    def __init__(self) -> None:
        self._lock = Lock()
        self._lock.acquire()

    def ring(self) -> None:
        """Wake the thread that waits. If no thread waits, the next `wait` returns immediately.

        Any thread may call this.
        """
        # Releasing a lock is the cheapest way to wake a thread.
        if self._lock.locked():
            try:
                self._lock.release()
            except RuntimeError:
                pass  # another thread called this method at the same moment

    def wait(self, seconds: float | None = None) -> bool:
        """Wait until `ring` is called, and return True.

        Return False if that does not happen within `seconds` s. None means no time limit.
        """
        return self._lock.acquire(timeout=-1 if seconds is None else max(0.0, seconds))


class Mailbox(Generic[T]):
    """Bounded queue of the items that wait for one reader, in the order of their arrival."""

    def __init__(self, most: int, wake: Callable[[], object] | None = None) -> None:
        """Create a mailbox for at most `most` items.

        `wake` is a function that `put` calls in the thread of the writer, after it has stored an
        item. If `wake` is None, `put` wakes a reader that waits in the method `wait`.
        """
        self.waiting: deque[T] = deque(maxlen=most)
        """The items that wait, the oldest item at index 0. Only the reader may remove items. The
        attribute is public, because a control step reads forty mailboxes, and forty method calls
        would be slow."""
        self.lost = 0
        """Total number of items that newer items have displaced. With several writers, this number
        is approximate."""
        self._bell = Bell()
        self.wake = wake or self._bell.ring
        """Function that wakes the reader. A writer that calls `store` must call `wake`
        afterwards."""
        self.closed = False
        """True if no writer will store more items. Earlier items may still wait for the reader."""

    # The writers' side

    def store(self, item: T) -> bool:
        """Store an item without waking the reader.

        If the mailbox is full, drop its oldest item and return False, else return True. The result
        may be wrong if several threads store items at the same time.
        """
        items = self.waiting
        room = len(items) < items.maxlen  # type: ignore[operator]
        if not room:
            # Count the loss before storing the item, so that a reader of the item sees the count.
            self.lost += 1
        items.append(item)
        return room

    def put(self, item: T) -> bool:
        """Store an item and wake the reader.

        If the mailbox is full, drop its oldest item and return False, else return True.
        """
        room = self.store(item)
        self.wake()
        return room

    def close(self) -> None:
        """Declare that no more items will come, and wake the reader.

        The reader can still take the items that wait.
        """
        self.closed = True
        self.wake()

    # The reader's side

    def wakes(self, wake: Callable[[], object]) -> None:
        """Replace the function that wakes the reader.

        A reader that calls this method must not call `wait`. If an item waits already or the
        mailbox is closed, `wake` is called immediately.
        """
        self.wake = wake
        if self.waiting or self.closed:
            wake()

    def pop(self) -> T | None:
        """Remove and return the oldest item, or return None if no item waits."""
        # No other thread can take the item in between, because there is one reader.
        return self.waiting.popleft() if self.waiting else None

    def take(self) -> list[T]:
        """Remove and return all items that wait now. Items that arrive during the call stay."""
        items = self.waiting
        return [items.popleft() for _ in range(len(items))]

    def wait(self, seconds: float | None = None) -> bool:
        """Wait until the mailbox contains an item or is closed, and return True.

        Return False if neither happens within `seconds` s. None means no time limit.
        """
        began_ns, left = clock.mono_ns(), seconds
        while not (self.waiting or self.closed):
            if left is not None and left <= 0:
                return False
            self._bell.wait(left)
            if seconds is not None:
                left = seconds - (clock.mono_ns() - began_ns) / NS_PER_S
        return True

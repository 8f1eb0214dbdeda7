"""From a capture thread to the event loop: room for one, the newest wins."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from typing import Generic, TypeVar

T = TypeVar("T")


class NewestMailbox(Generic[T]):
    """Holds the newest item until the event loop takes it.

    Create it on the event loop that takes from it; ``put`` is for another thread.
    """

    def __init__(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._lock = threading.Lock()
        self._item: T | None = None
        self._filled = asyncio.Event()

    def put(self, item: T) -> T | None:
        """Leave an item; return the one that it replaced because nobody took it. Never blocks."""
        with self._lock:
            replaced, self._item = self._item, item
        with contextlib.suppress(RuntimeError):  # the loop has ended: nobody will take anything any more
            self._loop.call_soon_threadsafe(self._filled.set)
        return replaced

    async def get(self) -> T:
        """Wait for an item and take it."""
        while True:
            await self._filled.wait()
            self._filled.clear()
            with self._lock:
                item, self._item = self._item, None
            if item is not None:
                return item

"""Serves a few connections at once on the event loop, none of which can slow the service or take it all for itself."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import Awaitable, Callable
from typing import Final

from companion.log import Log

LONGEST_REQUEST_BYTES: Final = 4096
"""Of one line; whoever sends a longer one is hung up on."""

Conversation = Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]]


class Connections:
    """Holds one conversation with each connection, with so many at the most.

    A conversation ends with its connection, when it is over, or when it raises OSError, ValueError or TimeoutError: a
    peer that sends nonsense, or does not read, is a peer's matter.

    Parameters
    ----------
    converse
        The conversation; it owns its time limits.
    most
        Connections at once.
    turned_away
        What one more is sent before it is closed.
    log
        Takes ``status_failed``, once, when a conversation fails by a fault of ours.
    """

    def __init__(self, converse: Conversation, *, most: int, turned_away: bytes, log: Log) -> None:
        self._converse = converse
        self._most = most
        self._turned_away = turned_away
        self._log = log
        self._open: set[asyncio.Task[None]] = set()
        self._has_failed = False

    async def serve(self, listener: socket.socket) -> None:
        """Serve until cancelled; connections are closed then, the listener is the caller's.

        Raises
        ------
        OSError
            When the listener cannot be used.
        """
        start = asyncio.start_unix_server if listener.family == socket.AF_UNIX else asyncio.start_server
        server = await start(self._connected, sock=listener, limit=LONGEST_REQUEST_BYTES)
        try:
            await asyncio.Event().wait()
        finally:
            server.close()
            for task in self._open:
                task.cancel()
            await asyncio.gather(*self._open, return_exceptions=True)

    async def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        # What is written is then known to be with the kernel when drain() returns: a peer that does not read is noticed.
        writer.transport.set_write_buffer_limits(high=0)
        task = asyncio.current_task()
        try:
            if task is None or len(self._open) >= self._most:
                writer.write(self._turned_away)
                return
            self._open.add(task)
            with contextlib.suppress(OSError, ValueError, TimeoutError):
                await self._converse(reader, writer)
        except asyncio.CancelledError:
            pass  # serve() is over; asyncio's streams of Python 3.11 would log it as a failure of ours
        except Exception:  # noqa: BLE001  flying goes on whatever is wrong with the telling of it
            if not self._has_failed:
                self._has_failed = True
                self._log.exception("status_failed")
        finally:
            if task is not None:
                self._open.discard(task)
            if writer.transport.get_write_buffer_size():
                writer.transport.abort()
            else:
                writer.close()

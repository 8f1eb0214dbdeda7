"""Who looks: one task sends to each what waits for it; none can slow another, and none the flight."""

from __future__ import annotations

import asyncio
import contextlib
import json
import threading
from collections.abc import Callable
from typing import Any, Final

from starlette.websockets import WebSocket, WebSocketDisconnect

from companion.web.outgoing import Outgoing
from companion.web.state import LiveState

TICK_S: Final = 0.1
"""Increments go out so often; pictures as they come."""
_SEND_S: Final = 15.0
"""A viewer that takes nothing for so long is let go."""


class Viewer:
    """One open page."""

    def __init__(self) -> None:
        self.outgoing = Outgoing()
        self.wake = asyncio.Event()
        self.pictures = True
        self.details = True


class Viewers:
    """All who look at the live page.

    Parameters
    ----------
    state
        What is shown; it is used under `lock`, as its messages are taken by another thread.
    lock
        Held while `state` is used.
    max_clients
        At one time.
    on_change
        Called when somebody comes, goes, or wants something else.
    """

    def __init__(
        self, state: LiveState, lock: threading.Lock, *, max_clients: int, on_change: Callable[[], None]
    ) -> None:
        self._state = state
        self._lock = lock
        self._max_clients = max_clients
        self._on_change = on_change
        self._viewers: set[Viewer] = set()
        self._newest_picture: bytes | None = None

    @property
    def count(self) -> int:
        """How many look."""
        return len(self._viewers)

    @property
    def want_pictures(self) -> bool:
        """Whether anybody looks at pictures."""
        return any(viewer.pictures for viewer in self._viewers)

    @property
    def want_details(self) -> bool:
        """Whether anybody looks at what the detector saw on its way."""
        return any(viewer.details and viewer.pictures for viewer in self._viewers)

    @property
    def newest_picture(self) -> bytes | None:
        """The newest picture message, where there is one."""
        return self._newest_picture

    def add_picture(self, picture: bytes) -> None:
        """Send a picture to who wants it."""
        self._newest_picture = picture
        for viewer in self._viewers:
            if viewer.pictures:
                viewer.outgoing.add_picture(picture)
                viewer.wake.set()

    def snapshot(self) -> dict[str, Any]:
        """Return all that is known."""
        with self._lock:
            known = self._state.snapshot()
        return {"latest": known.latest, "appended": known.appended}

    async def tick(self) -> None:
        """Hand out what is new, for ever."""
        while True:
            await asyncio.sleep(TICK_S)
            with self._lock:
                new = self._state.increment()
            if new:
                for viewer in self._viewers:
                    viewer.outgoing.add(new)
                    viewer.wake.set()

    async def serve(self, socket: WebSocket) -> None:
        """Serve one viewer until it goes."""
        if len(self._viewers) >= self._max_clients:
            await socket.accept()
            await socket.close(4001, f"{self._max_clients} are looking already")
            return
        await socket.accept()
        viewer = Viewer()
        with self._lock:
            viewer.outgoing.begin(self._state.snapshot())
        if self._newest_picture is not None:
            viewer.outgoing.add_picture(self._newest_picture)
        viewer.wake.set()
        self._viewers.add(viewer)
        self._changed()
        sending = asyncio.create_task(self._send(socket, viewer), name="viewer-send")
        try:
            await self._receive(socket, viewer)
        finally:
            self._viewers.discard(viewer)
            self._changed()
            sending.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await sending

    async def _send(self, socket: WebSocket, viewer: Viewer) -> None:
        try:
            while True:
                await viewer.wake.wait()
                viewer.wake.clear()
                while viewer.outgoing.has_any():
                    message, picture = viewer.outgoing.take()
                    async with asyncio.timeout(_SEND_S):
                        if message is not None:
                            await socket.send_text(json.dumps(message, separators=(",", ":")))
                        if picture is not None:
                            await socket.send_bytes(picture)
        except (TimeoutError, WebSocketDisconnect, RuntimeError):
            # Gone, or as good as gone. RuntimeError: Starlette's answer to sending after the end.
            with contextlib.suppress(RuntimeError, WebSocketDisconnect, TimeoutError):
                async with asyncio.timeout(1.0):
                    await socket.close(1008)

    async def _receive(self, socket: WebSocket, viewer: Viewer) -> None:
        """Take what a viewer may say: that it has shown a picture, and what it wants. Whatever else ends it."""
        try:
            while True:
                said = json.loads(await socket.receive_text())
                match said:
                    case {"type": "shown"}:
                        viewer.outgoing.shown()
                        viewer.wake.set()
                    case {"type": "want", "pictures": bool(pictures), "details": bool(details)}:
                        viewer.pictures, viewer.details = pictures, details
                        self._changed()
                    case _:
                        await socket.close(1003, "not understood")
                        return
        except (ValueError, KeyError):  # no JSON, or no text
            with contextlib.suppress(RuntimeError, WebSocketDisconnect):
                await socket.close(1003, "not understood")
        except WebSocketDisconnect:
            return

    def _changed(self) -> None:
        with self._lock:
            self._state.put("viewers", len(self._viewers))
        self._on_change()

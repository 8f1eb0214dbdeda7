"""The gate in front of the application: refuses, limits the size of what comes, and puts the headers on every answer."""

from __future__ import annotations

import time
from collections.abc import Callable

from starlette.datastructures import MutableHeaders
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from companion.web.security import HEADERS, MAX_BODY_BYTES, Asked, Gate, Refusal, headers_of


class Guard:
    """An ASGI application around another.

    Parameters
    ----------
    app
        What is guarded.
    gate
        Decides.
    now_s
        Monotonic time.
    """

    def __init__(self, app: ASGIApp, gate: Gate, *, now_s: Callable[[], float] = time.monotonic) -> None:
        self._app = app
        self._gate = gate
        self._now_s = now_s

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request, or open one socket."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        is_socket = scope["type"] == "websocket"
        asked = Asked(
            "WEBSOCKET" if is_socket else scope["method"], scope["path"], headers_of(scope["headers"])
        )
        refusal = self._gate.refusal(asked, self._now_s()) or (None if is_socket else _body_refusal(asked))
        if is_socket:
            if refusal is not None:
                await _refuse_socket(scope, receive, send, refusal)
            else:
                await self._app(scope, receive, send)
            return

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    headers[name] = value
                headers.setdefault("Cache-Control", "no-store")
            await send(message)

        if refusal is not None:
            response = JSONResponse({"error": refusal.reason}, refusal.status)
            await response(scope, receive, send_with_headers)
            return
        await self._app(scope, _Limited(receive), send_with_headers)


class _Limited:
    """Receives a body, and no more of it than is allowed: a client need not say beforehand how much it sends."""

    def __init__(self, receive: Receive) -> None:
        self._receive = receive
        self._bytes = 0

    async def __call__(self) -> Message:
        message = await self._receive()
        if message["type"] == "http.request":
            self._bytes += len(message.get("body", b""))
            if self._bytes > MAX_BODY_BYTES:
                # To the application the client has gone: nothing of such a body is used.
                return {"type": "http.disconnect"}
        return message


def _body_refusal(asked: Asked) -> Refusal | None:
    length = asked.headers.get("content-length", "0")
    if not (length.isascii() and length.isdecimal()):
        return Refusal(400, "Content-Length is no number")
    if int(length[:20]) > MAX_BODY_BYTES:
        return Refusal(413, f"more than {MAX_BODY_BYTES} bytes")
    if asked.method == "POST":
        media_type = asked.headers.get("content-type", "").partition(";")[0].strip().lower()
        if media_type != "application/json":
            return Refusal(415, "Content-Type has to be application/json")
    return None


async def _refuse_socket(scope: Scope, receive: Receive, send: Send, refusal: Refusal) -> None:
    await receive()  # websocket.connect
    if "websocket.http.response" not in scope.get("extensions", {}):
        await send({"type": "websocket.close", "code": 1008, "reason": refusal.reason})
        return
    headers = [
        (b"content-type", b"application/json"),
        *((n.lower().encode(), v.encode()) for n, v in HEADERS.items()),
    ]
    await send({"type": "websocket.http.response.start", "status": refusal.status, "headers": headers})
    await send({"type": "websocket.http.response.body", "body": JSONResponse({"error": refusal.reason}).body})

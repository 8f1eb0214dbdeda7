"""Serves the metrics to Prometheus: GET /metrics and nothing else, over HTTP/1.1 with one request a connection."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Mapping
from typing import Final

from companion.log import Log
from companion.status.connections import Connections
from companion.status.metrics import Encoder, encoder
from companion.status.server import Snapshot

MOST_CLIENTS: Final = 4
_REQUEST_S: Final = 5.0
"""A client has to have asked by then, and to have read its answer by as much later."""
_MOST_HEADERS: Final = 64
_RETRY_S: Final = 5.0
_BACKLOG: Final = 8
_TEXT: Final = "text/plain; charset=utf-8"


class MetricsServer:
    """Answers scrapes of Prometheus.

    Parameters
    ----------
    host, port
        Where it listens.
    snapshot
        Returns the status of now.
    log
        Takes ``metrics_open``, ``metrics_failed`` and ``status_failed``.
    """

    def __init__(self, host: str, port: int, *, snapshot: Snapshot, log: Log) -> None:
        self._host = host
        self._port = port
        self._snapshot = snapshot
        self._log = log
        self._encode: Encoder | None = None
        self._encoding = asyncio.Lock()

    async def run(self) -> None:
        """Serve until cancelled. A port that cannot be had is announced, and tried again: flying goes on without."""
        said = ""
        self._encode = await asyncio.to_thread(encoder)
        connections = Connections(
            self._converse,
            most=MOST_CLIENTS,
            turned_away=response(503, f"{MOST_CLIENTS} clients are connected already\n".encode()),
            log=self._log,
        )
        while True:
            try:
                listener = await asyncio.to_thread(open_port, self._host, self._port)
            except OSError as error:
                if str(error) != said:
                    said = str(error)
                    self._log.error("metrics_failed", host=self._host, port=self._port, error=said)
                await asyncio.sleep(_RETRY_S)
                continue
            host, port = listener.getsockname()[:2]
            self._log.info("metrics_open", host=host, port=port)
            with listener:
                await connections.serve(listener)

    async def _converse(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        async with asyncio.timeout(_REQUEST_S):
            request_line = await reader.readline()
            headers = await _headers(reader)
        answer = await self._answer(request_line, headers)
        async with asyncio.timeout(_REQUEST_S):
            writer.write(answer)
            await writer.drain()

    async def _answer(self, request_line: bytes, headers: Mapping[str, str]) -> bytes:
        words = request_line.decode("latin-1").split()
        if len(words) != 3 or not words[2].startswith("HTTP/1."):
            return response(400, b"not a request of HTTP/1\n")
        method, target, _ = words
        if target.partition("?")[0] != "/metrics":
            return response(404, b"only /metrics\n")
        if method not in ("GET", "HEAD"):
            return response(405, b"only GET and HEAD\n", "Allow: GET, HEAD")
        body, content_type = await self._metrics(headers.get("accept", ""))
        return response(200, body, content_type=content_type, with_body=method == "GET")

    async def _metrics(self, accept: str) -> tuple[bytes, str]:
        encode = self._encode
        if encode is None:
            raise RuntimeError("not running: use run()")
        async with self._encoding:  # one at a time: a crowd of scrapes waits, the setpoints do not
            snapshot = await self._snapshot()
            return await asyncio.to_thread(encode, snapshot, accept)


def open_port(host: str, port: int) -> socket.socket:
    """Return a listening socket.

    Raises
    ------
    OSError
        When the host is not known, or the port cannot be had.
    """
    family, kind, protocol, _, address = socket.getaddrinfo(
        host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
    )[0]
    listener = socket.socket(family, kind | socket.SOCK_CLOEXEC, protocol)
    try:
        listener.setblocking(False)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(address)
        listener.listen(_BACKLOG)
    except OSError:
        listener.close()
        raise
    return listener


def response(
    status: int, body: bytes, *headers: str, content_type: str = _TEXT, with_body: bool = True
) -> bytes:
    """Return a response of HTTP/1.1 that ends the connection."""
    lines = [
        f"HTTP/1.1 {status} {_REASONS[status]}",
        f"Content-Type: {content_type}",
        f"Content-Length: {len(body)}",
        "Connection: close",
        *headers,
        "",
        "",
    ]
    head = "\r\n".join(lines).encode("latin-1")
    return head + body if with_body else head


_REASONS: Final = {
    200: "OK",
    400: "Bad Request",
    404: "Not Found",
    405: "Method Not Allowed",
    503: "Service Unavailable",
}


async def _headers(reader: asyncio.StreamReader) -> dict[str, str]:
    """Return the headers of a request by lower-case name.

    Raises
    ------
    ValueError
        When there are too many of them.
    """
    headers: dict[str, str] = {}
    for _ in range(_MOST_HEADERS):
        line = (await reader.readline()).decode("latin-1")
        if not line.strip():
            return headers
        name, _, value = line.partition(":")
        headers[name.strip().lower()] = value.strip()
    raise ValueError("too many headers")

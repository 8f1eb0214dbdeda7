"""The server: uvicorn on sockets made here, with the limits that keep a bad client its own problem."""

from __future__ import annotations

import socket
from typing import Final

import uvicorn
from starlette.types import ASGIApp

from companion.web.security import MAX_SOCKET_MESSAGE_BYTES

_SEND_BUFFER_BYTES: Final = 256 * 1024
"""In the kernel for each viewer. Larger, a slow one would be shown older pictures."""
_USER_TIMEOUT_MS: Final = 20_000
"""A viewer that takes nothing for so long is let go by the kernel, with whatever waits for it."""
_TCP_USER_TIMEOUT: Final = 18  # linux/tcp.h
_CONNECTIONS_BESIDE_VIEWERS: Final = 24
_KEEP_ALIVE_S: Final = 10
_PING_S: Final = 10.0
_MAX_HEADER_BYTES: Final = 16 * 1024
_SHUTDOWN_S: Final = 1


def listen(host: str, port: int) -> socket.socket:
    """Return a listening socket.

    Raises
    ------
    OSError
        When the address cannot be had.
    """
    family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    listener = socket.socket(family, kind | socket.SOCK_CLOEXEC, protocol)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        # These are handed on to every connection.
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER_BYTES)
        listener.setsockopt(socket.IPPROTO_TCP, _TCP_USER_TIMEOUT, _USER_TIMEOUT_MS)
        listener.bind(address)
        listener.listen(64)
    except OSError:
        listener.close()
        raise
    return listener


class PageServer:
    """Serves an application on a listening socket.

    Parameters
    ----------
    application
        What answers.
    max_clients
        Viewers; further connections are allowed for what they load.
    """

    def __init__(self, application: ASGIApp, *, max_clients: int) -> None:
        self._server = uvicorn.Server(
            uvicorn.Config(
                application,
                loop="none",
                http="h11",
                ws="websockets-sansio",
                lifespan="on",
                log_config=None,
                log_level="warning",
                access_log=False,
                server_header=False,
                date_header=False,
                proxy_headers=False,
                limit_concurrency=max_clients + _CONNECTIONS_BESIDE_VIEWERS,
                timeout_keep_alive=_KEEP_ALIVE_S,
                timeout_graceful_shutdown=_SHUTDOWN_S,
                h11_max_incomplete_event_size=_MAX_HEADER_BYTES,
                ws_max_size=MAX_SOCKET_MESSAGE_BYTES,
                ws_ping_interval=_PING_S,
                ws_ping_timeout=_PING_S,
                ws_per_message_deflate=False,
            )
        )

    async def serve(self, listener: socket.socket) -> None:
        """Serve until :meth:`stop`, or until cancelled."""
        await self._server.serve(sockets=[listener])

    def stop(self) -> None:
        """Have :meth:`serve` return soon."""
        self._server.should_exit = True

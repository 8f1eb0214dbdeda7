"""The status socket in the service: answers requests for as long as the service runs, whatever its clients do."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Mapping, MutableMapping
from pathlib import Path
from typing import Any, Final

from companion.errors import CompanionError
from companion.log import Log
from companion.status.connections import Connections
from companion.status.protocol import Request, pack_answer, pack_error, unpack_request
from companion.status.unix_socket import StatusError, inode_of, open_listener, remove

MOST_CLIENTS: Final = 8
STATUS: Final = "status"
"""The command that every service knows."""
_IDLE_S: Final = 30.0
"""A client that asks for nothing so long makes room for others."""
_STALLED_S: Final = 2.0
"""A client that has not read its answer by then is hung up on."""
_SPACING_S: Final = 0.05
"""Between the requests of one client."""
_RETRY_S: Final = 5.0

Command = Callable[[Mapping[str, Any]], Mapping[str, Any]]
"""Takes the arguments of a request and returns the answer, at once: it runs between two setpoints.

Raises `companion.errors.CompanionError` with one clear line where it cannot do what was asked."""

Snapshot = Callable[[], Awaitable[Mapping[str, Any]]]


class StatusServer:
    """Answers at a unix socket: `STATUS`, and what else was registered.

    Parameters
    ----------
    path
        Where the socket is.
    snapshot
        Returns the status of now.
    commands
        Further commands by name; may grow while it runs.
    log
        Takes ``status_socket_open``, ``status_socket_failed``, ``status_command``, ``status_command_failed`` and
        ``status_failed``.
    """

    def __init__(
        self, path: Path, *, snapshot: Snapshot, commands: MutableMapping[str, Command], log: Log
    ) -> None:
        self._path = path
        self._snapshot = snapshot
        self._commands = commands
        self._log = log

    async def run(self) -> None:
        """Serve until cancelled. A socket that cannot be opened is announced, and tried again: flying goes on without."""
        said = ""
        connections = Connections(
            self._converse,
            most=MOST_CLIENTS,
            turned_away=pack_error(f"{MOST_CLIENTS} clients are connected already"),
            log=self._log,
        )
        while True:
            try:
                listener = open_listener(self._path)
            except StatusError as error:
                if str(error) != said:
                    said = str(error)
                    self._log.error("status_socket_failed", error=said)
                await asyncio.sleep(_RETRY_S)
                continue
            inode = inode_of(self._path)
            self._log.info("status_socket_open", path=str(self._path))
            try:
                with listener:
                    await connections.serve(listener)
            finally:
                remove(self._path, inode)

    async def _converse(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while True:
            async with asyncio.timeout(_IDLE_S):
                line = await reader.readline()
            if not line:
                return
            writer.write(await self._answer(line))
            async with asyncio.timeout(_STALLED_S):
                await writer.drain()
            await asyncio.sleep(_SPACING_S)

    async def _answer(self, line: bytes) -> bytes:
        try:
            request = unpack_request(line)
            if request.command == STATUS:
                return pack_answer(await self._snapshot())
            return pack_answer(self._obey(request))
        except CompanionError as error:
            return pack_error(str(error))

    def _obey(self, request: Request) -> Mapping[str, Any]:
        command = self._commands.get(request.command)
        if command is None:
            known = ", ".join(sorted({STATUS, *self._commands}))
            raise StatusError(f"unknown command {request.command[:40]!r}; known: {known}")
        try:
            answer = command(request.arguments)
        except CompanionError as error:
            self._log.warning("status_command", command=request.command, refused=str(error))
            raise
        except Exception as error:
            self._log.exception("status_command_failed", command=request.command)
            raise StatusError(f"{request.command} failed: {error!r}") from error
        self._log.info("status_command", command=request.command)
        return answer

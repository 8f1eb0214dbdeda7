"""The other side of the status socket, for commands of the command line (blocking, with a time limit)."""

from __future__ import annotations

import socket
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

from companion.status.protocol import Request, pack_request, unpack_answer
from companion.status.unix_socket import StatusError

_TIMEOUT_S: Final = 5.0
_LONGEST_ANSWER_BYTES: Final = 1 << 20


class NotRunningError(StatusError):
    """Nobody answers at the socket: the service does not run, or is not the one that has it."""


class NoAnswerError(StatusError):
    """Somebody has the socket open, and does not answer."""


class StatusClient:
    """A connection to a running service; ``with`` is its lifetime.

    Parameters
    ----------
    path
        The socket.
    timeout_s
        The longest wait for one answer.

    Raises
    ------
    NotRunningError
        When there is no service.
    companion.status.unix_socket.StatusError
        When the socket may not be used.
    """

    def __init__(self, path: Path, *, timeout_s: float = _TIMEOUT_S) -> None:
        self._path = path
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_CLOEXEC)
        self._socket.settimeout(timeout_s)
        try:
            self._socket.connect(str(path))
        except (OSError, ValueError) as error:
            self._socket.close()
            raise _cannot_connect(path, error) from error
        self._reader = self._socket.makefile("rb")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, tb: TracebackType | None
    ) -> None:
        self._reader.close()
        self._socket.close()

    def ask(self, command: str, arguments: Mapping[str, Any] | None = None) -> dict[str, Any]:
        """Send one command and return its answer.

        Raises
        ------
        companion.status.protocol.ProtocolError
            When the service refuses it; says why.
        companion.status.unix_socket.StatusError
            When there is no answer.
        """
        try:
            self._socket.sendall(pack_request(Request(command, arguments or {})))
            line = self._reader.readline(_LONGEST_ANSWER_BYTES)
        except TimeoutError as error:
            raise NoAnswerError(
                f"{self._path}: no answer within {self._socket.gettimeout():g} s: the service hangs"
            ) from error
        except OSError as error:
            raise NotRunningError(f"the service has ended: {error.strerror}") from error
        if not line.endswith(b"\n"):
            raise NotRunningError("the service has ended")
        return unpack_answer(line)


def ask(path: Path, command: str, arguments: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Send one command over a connection of its own; see :meth:`StatusClient.ask`."""
    with StatusClient(path) as client:
        return client.ask(command, arguments)


def _cannot_connect(path: Path, error: OSError | ValueError) -> StatusError:
    match error:
        case FileNotFoundError() | NotADirectoryError():
            return NotRunningError(f"the service is not running: there is no socket {path}")
        case ConnectionRefusedError():
            return NotRunningError(
                f"the service is not running: nobody listens at {path}, which one that was killed has left"
            )
        case PermissionError():
            return StatusError(
                f"{path}: not allowed: for the service's user and group (sudo, or join the group void-companion)"
            )
        case BlockingIOError() | TimeoutError():
            return NoAnswerError(f"{path}: no answer: the service hangs")
    reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    return StatusError(f"{path}: cannot be used: {reason}")

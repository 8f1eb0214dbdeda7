"""What is said over the status socket: one JSON object a line each way, an answer for each request (pure).

    {"command": "status"}
    {"ok": true, "answer": {"state": "FOLLOW", ...}}

    {"command": "nonsense"}
    {"ok": false, "error": "unknown command nonsense; known: status"}

A request may bring ``"arguments"``, a table. The names in an answer are stable: what is added has new names.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from companion.errors import CompanionError

_MAX_DEPTH: Final = 8


class ProtocolError(CompanionError):
    """A line is not what the protocol allows."""


@dataclass(frozen=True, slots=True)
class Request:
    """One request.

    Attributes
    ----------
    command
        Its name.
    arguments
        What the command takes.
    """

    command: str
    arguments: Mapping[str, Any] = field(default_factory=dict)


def pack_request(request: Request) -> bytes:
    """Return the line of a request."""
    return _line({"command": request.command, "arguments": dict(request.arguments)})


def unpack_request(line: bytes) -> Request:
    """Read the line of a request.

    Raises
    ------
    ProtocolError
        When it is none.
    """
    packet = _object(line)
    command, arguments = packet.get("command"), packet.get("arguments", {})
    if not isinstance(command, str) or not isinstance(arguments, dict) or packet.keys() - _REQUEST_KEYS:
        raise ProtocolError('not a request; allowed: {"command": TEXT, "arguments": TABLE}')
    return Request(command, arguments)


def pack_answer(answer: Mapping[str, Any]) -> bytes:
    """Return the line of an answer; numbers that JSON does not know (NaN, infinities) become null."""
    return _line({"ok": True, "answer": _plain(answer, _MAX_DEPTH)})


def pack_error(error: str) -> bytes:
    """Return the line of an answer that says why not."""
    return _line({"ok": False, "error": error})


def unpack_answer(line: bytes) -> dict[str, Any]:
    """Read the line of an answer and return what it holds.

    Raises
    ------
    ProtocolError
        When it is none, or says why not.
    """
    packet = _object(line)
    answer = packet.get("answer")
    if packet.get("ok") is True and isinstance(answer, dict):
        return answer
    error = packet.get("error")
    raise ProtocolError(error if isinstance(error, str) else f"not an answer: {line[:60]!r}")


_REQUEST_KEYS: Final = frozenset({"command", "arguments"})


def _line(packet: Mapping[str, Any]) -> bytes:
    return json.dumps(packet, ensure_ascii=False, allow_nan=False).encode("utf-8", "backslashreplace") + b"\n"


def _object(line: bytes) -> dict[str, Any]:
    try:
        packet = json.loads(line)
    except (ValueError, RecursionError) as error:
        raise ProtocolError(f"not JSON: {error}") from error
    if not isinstance(packet, dict):
        raise ProtocolError("not a JSON object")
    return packet


def _plain(value: object, depth: int) -> object:
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if depth > 0 and isinstance(value, Mapping):
        return {str(key): _plain(item, depth - 1) for key, item in value.items()}
    if depth > 0 and isinstance(value, list | tuple):
        return [_plain(item, depth - 1) for item in value]
    return str(value)

"""The unix socket as a file: where it lies, who may open it, and what becomes of one that was left behind."""

from __future__ import annotations

import contextlib
import os
import socket
import stat
from pathlib import Path
from typing import Final

from companion.config import StatusConfig
from companion.errors import CompanionError

NAME: Final = "status.sock"
USUAL_FOLDER: Final = Path("/run/void-companion")
"""RuntimeDirectory of our unit."""
_MODE: Final = 0o660
"""The service's user and group: whoever may connect may also give commands."""
_BACKLOG: Final = 8


class StatusError(CompanionError):
    """The status socket cannot be opened, or nobody answers at it."""


def socket_path(config: StatusConfig, runtime_folder: Path | None) -> Path | None:
    """Return where the socket belongs: where it is configured, else in systemd's folder, else nowhere."""
    if config.socket:
        return Path(config.socket)
    return None if runtime_folder is None else runtime_folder / NAME


def runtime_folder(environment: dict[str, str] | os._Environ[str]) -> Path | None:
    """Return the first of the folders that ``RuntimeDirectory=`` has made, if any (systemd.exec)."""
    first = environment.get("RUNTIME_DIRECTORY", "").partition(":")[0]
    return Path(first) if first else None


def open_listener(path: Path) -> socket.socket:
    """Return a listening socket at a path; one that a dead process has left there is replaced.

    It is bound beside its place, given its permissions, and then moved: it is never there with others.

    Raises
    ------
    StatusError
        When it cannot be made, when another process answers there, or when something else lies there.
    """
    _check_place(path)
    beside = path.with_name(f".{path.name}.{os.getpid()}")
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_CLOEXEC)
    try:
        listener.setblocking(False)
        beside.unlink(missing_ok=True)
        listener.bind(str(beside))
        beside.chmod(_MODE)
        listener.listen(_BACKLOG)
        beside.replace(path)
    except (OSError, ValueError) as error:  # ValueError: a null character in the name
        listener.close()
        with contextlib.suppress(OSError, ValueError):
            beside.unlink(missing_ok=True)
        raise StatusError(f"{path}: cannot be made: {_reason(error)}") from error
    return listener


def remove(path: Path, inode: int) -> None:
    """Remove the socket at a path, where it is still the one with this inode."""
    with contextlib.suppress(OSError):
        if path.lstat().st_ino == inode:
            path.unlink()


def inode_of(path: Path) -> int:
    """Return the inode of what lies at a path; 0 where there is nothing."""
    try:
        return path.lstat().st_ino
    except OSError:
        return 0


def _check_place(path: Path) -> None:
    try:
        mode = path.lstat().st_mode
    except (OSError, ValueError):  # nothing there; or bind() says what is wrong with the name
        return
    if not stat.S_ISSOCK(mode):
        raise StatusError(f"{path}: is there and is no socket: it is left alone")
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_CLOEXEC) as probe:
        probe.setblocking(False)
        try:
            probe.connect(str(path))
        except BlockingIOError:  # somebody is there, with as many waiting as may wait
            pass
        except OSError:
            return
    raise StatusError(f"{path}: another process answers there")


def _reason(error: OSError | ValueError) -> str:
    return error.strerror if isinstance(error, OSError) and error.strerror else str(error)

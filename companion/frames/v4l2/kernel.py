"""Where Video4Linux 2 meets the operating system: nodes, their links, system calls. A test gives another one."""

from __future__ import annotations

import ctypes
import fcntl
import mmap
import os
import select
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

_NODES = Path("/dev")
_LINK_FOLDERS = (Path("/dev/v4l/by-id"), Path("/dev/v4l/by-path"))


@dataclass(frozen=True, slots=True)
class Node:
    """A device node, and the names of it that last.

    Attributes
    ----------
    path
        Such as ``/dev/video0``; the number is the kernel's and changes.
    links
        Names that udev gave it, the most lasting one first.
    """

    path: str
    links: tuple[str, ...] = ()


class OpenNode(Protocol):
    """An open device node. Used by one thread."""

    def ioctl(self, request: int, argument: ctypes.Structure) -> None:
        """Make a system call that reads and fills ``argument``; raises OSError."""
        ...

    def map(self, length: int, offset: int) -> NDArray[np.uint8]:
        """Return a driver's buffer as (length,) uint8; unmapped with the last array that looks at it."""
        ...

    def wait(self, timeout_s: float) -> bool:
        """Wait for a filled buffer; return whether there is one. Raises OSError when the device is gone."""
        ...

    def close(self) -> None:
        """Close the node."""
        ...


class Kernel(Protocol):
    """The operating system as a camera needs it."""

    def nodes(self) -> tuple[Node, ...]:
        """Return the video nodes that there are, in the order of their numbers."""
        ...

    def open(self, path: str) -> OpenNode:
        """Open a node; raises OSError."""
        ...


class LinuxKernel:
    """The kernel of this machine."""

    def nodes(self) -> tuple[Node, ...]:
        """Return the video nodes that there are, in the order of their numbers."""
        links: dict[str, list[str]] = {}
        for folder in _LINK_FOLDERS:
            for link in sorted(folder.iterdir()) if folder.is_dir() else ():
                links.setdefault(str(link.resolve()), []).append(str(link))
        numbered = (
            (int(path.name[5:]), str(path))
            for path in _NODES.glob("video*")
            if path.name[5:].isdecimal() and path.is_char_device()
        )
        return tuple(Node(path, tuple(links.get(path, ()))) for _, path in sorted(numbered))

    def open(self, path: str) -> OpenNode:
        """Open a node; raises OSError."""
        return _LinuxNode(path)


class _LinuxNode:
    def __init__(self, path: str) -> None:
        self._fd = os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)

    def ioctl(self, request: int, argument: ctypes.Structure) -> None:
        fcntl.ioctl(self._fd, request, argument)

    def map(self, length: int, offset: int) -> NDArray[np.uint8]:
        return np.frombuffer(mmap.mmap(self._fd, length, offset=offset), dtype=np.uint8)

    def wait(self, timeout_s: float) -> bool:
        poll = select.poll()
        poll.register(self._fd, select.POLLIN)
        return bool(poll.poll(max(0.0, timeout_s) * 1000))

    def close(self) -> None:
        os.close(self._fd)

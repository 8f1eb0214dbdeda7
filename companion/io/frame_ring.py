"""Shared memory that frames cross to the I/O process in: a ring without a name, written without waiting for the reader.

Each slot has the number of its frame in front of the pixels, 0 while they are being written. Whoever reads a slot looks at
the number before and after: a frame that was overwritten meanwhile is lost, never torn.
"""

from __future__ import annotations

import mmap
import os
import struct
from typing import Final

import numpy as np
from numpy.typing import NDArray

N_SLOTS: Final = 8
_NUMBER: Final = struct.Struct("<Q")
_HEADER_BYTES: Final = 64
"""A cache line, so that pixels begin at an aligned address."""


class FrameRing:
    """The service's side: writes frames, the oldest make room.

    Parameters
    ----------
    frame_bytes
        Room for one frame.

    Raises
    ------
    OSError
        When there is not enough memory.
    """

    def __init__(self, frame_bytes: int) -> None:
        self.frame_bytes = frame_bytes
        self._slot_bytes = slot_bytes_of(frame_bytes)
        self._written = 0
        self.fd = os.memfd_create("companion-io-frames", os.MFD_CLOEXEC)
        try:
            # Reserved now: without it, writing to full memory later would kill the process (SIGBUS).
            os.posix_fallocate(self.fd, 0, self._slot_bytes * N_SLOTS)
            self._map = mmap.mmap(self.fd, self._slot_bytes * N_SLOTS)
        except OSError:
            os.close(self.fd)
            raise

    def write(self, image: NDArray[np.uint8]) -> int:
        """Copy a frame, (H, W) uint8, into the next slot; return its number, from 1."""
        self._written += 1
        at = self._written % N_SLOTS * self._slot_bytes
        _NUMBER.pack_into(self._map, at, 0)
        view = np.frombuffer(self._map, np.uint8, image.size, at + _HEADER_BYTES)
        np.copyto(view.reshape(image.shape), image)
        _NUMBER.pack_into(self._map, at, self._written)
        return self._written

    def close(self) -> None:
        """Unmap the memory on this side."""
        self._map.close()
        os.close(self.fd)


class MappedRing:
    """The I/O process's side: reads frames.

    Parameters
    ----------
    fd
        The memory's file descriptor; it is closed here.
    frame_bytes
        As the service made it.
    """

    def __init__(self, fd: int, frame_bytes: int) -> None:
        self._slot_bytes = slot_bytes_of(frame_bytes)
        self._frame_bytes = frame_bytes
        try:
            self._map = mmap.mmap(fd, self._slot_bytes * N_SLOTS, prot=mmap.PROT_READ)
        finally:
            os.close(fd)

    def read(self, number: int, height_px: int, width_px: int) -> NDArray[np.uint8] | None:
        """Return a copy of a frame, (H, W) uint8; None where a newer one has taken its place."""
        if not 0 < height_px * width_px <= self._frame_bytes:
            raise ValueError(f"expected at most {self._frame_bytes} px, got {width_px} x {height_px}")
        at = number % N_SLOTS * self._slot_bytes
        if self._number_at(at) != number:
            return None
        image = np.frombuffer(self._map, np.uint8, height_px * width_px, at + _HEADER_BYTES).copy()
        if self._number_at(at) != number:
            return None
        image.flags.writeable = False
        return image.reshape(height_px, width_px)

    def close(self) -> None:
        """Unmap the memory on this side."""
        self._map.close()

    def _number_at(self, at: int) -> int:
        return int(_NUMBER.unpack_from(self._map, at)[0])


def slot_bytes_of(frame_bytes: int) -> int:
    """Return the room for a frame and its number, whole cache lines."""
    return -(-frame_bytes // _HEADER_BYTES) * _HEADER_BYTES + _HEADER_BYTES

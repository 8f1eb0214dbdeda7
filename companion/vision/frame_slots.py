"""Shared memory that frames cross to the worker in: one copy, no name.

The memory has no name in the file system, so there is nothing to clean up: it is gone with the last process
that has it mapped, however that process ends.
"""

from __future__ import annotations

import mmap
import os
import tempfile

import numpy as np
from numpy.typing import NDArray

N_SLOTS = 2
"""One that the worker reads, one that the next frame is written to."""


class FrameSlots:
    """The service's side: writes frames.

    Parameters
    ----------
    slot_bytes
        Room for one frame.

    Raises
    ------
    OSError
        When there is not enough memory.
    """

    def __init__(self, slot_bytes: int) -> None:
        self.slot_bytes = slot_bytes
        self.fd = _anonymous_file()
        try:
            # Reserved now: without it, writing to full memory later would kill the process (SIGBUS).
            os.posix_fallocate(self.fd, 0, slot_bytes * N_SLOTS)
            self._map = mmap.mmap(self.fd, slot_bytes * N_SLOTS)
        except OSError:
            os.close(self.fd)
            raise

    def write(self, slot: int, image: NDArray[np.uint8]) -> None:
        """Copy a frame into a slot.

        Parameters
        ----------
        slot
            0 to N_SLOTS - 1.
        image
            (H, W) uint8 of at most ``slot_bytes``.
        """
        np.copyto(_view(self._map, slot, self.slot_bytes, image.shape[0], image.shape[1]), image)

    def close(self) -> None:
        """Unmap the memory on this side."""
        self._map.close()
        os.close(self.fd)


class MappedSlots:
    """The worker's side: reads frames.

    Parameters
    ----------
    fd
        The memory's file descriptor; it is closed here.
    slot_bytes, n_slots
        As the service made it.
    """

    def __init__(self, fd: int, slot_bytes: int, n_slots: int) -> None:
        self._slot_bytes = slot_bytes
        try:
            self._map = mmap.mmap(fd, slot_bytes * n_slots, prot=mmap.PROT_READ)
        finally:
            os.close(fd)

    def read(self, slot: int, height_px: int, width_px: int) -> NDArray[np.uint8]:
        """Return a frame as an array of its own, (H, W) uint8: the pair's earlier frame outlives its slot."""
        return _view(self._map, slot, self._slot_bytes, height_px, width_px).copy()

    def close(self) -> None:
        """Unmap the memory on this side."""
        self._map.close()


def _view(memory: mmap.mmap, slot: int, slot_bytes: int, height_px: int, width_px: int) -> NDArray[np.uint8]:
    if not 0 < height_px * width_px <= slot_bytes:
        raise ValueError(f"expected at most {slot_bytes} px, got {width_px} x {height_px}")
    flat = np.frombuffer(memory, np.uint8, count=height_px * width_px, offset=slot * slot_bytes)
    return flat.reshape(height_px, width_px)


def _anonymous_file() -> int:
    if hasattr(os, "memfd_create"):
        return os.memfd_create("companion-frames", os.MFD_CLOEXEC)
    # A Python built for an older C library: a file in the same kind of memory, without a name.
    with tempfile.TemporaryFile(dir="/dev/shm") as file:
        return os.dup(file.fileno())

"""The driver's buffers: mapped once, filled by the driver, looked at, and queued again."""

from __future__ import annotations

import contextlib
import ctypes
import errno
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from companion.errors import SourceError
from companion.frames.v4l2 import abi
from companion.frames.v4l2.device import VideoDevice

N_BUFFERS = 4
"""Two that the driver fills in turn, one with the newest image, one that somebody looks at."""


@dataclass(frozen=True, slots=True)
class Filled:
    """A buffer that the driver has filled.

    Attributes
    ----------
    index
        To queue it again.
    data
        (N,) uint8, the bytes that are used, in the driver's memory.
    damaged
        Whether the driver says that they may not be right.
    time_ns
        CLOCK_MONOTONIC, or None where the driver's time stamp is of another clock.
    sequence
        The driver's number of the image; gaps are images that it dropped.
    """

    index: int
    data: NDArray[np.uint8]
    damaged: bool
    time_ns: int | None
    sequence: int


class Buffers:
    """The buffers of one device from STREAMON to STREAMOFF.

    Parameters
    ----------
    device
        With its format set.

    Raises
    ------
    companion.errors.SourceError
        When the driver has no buffers that can be mapped, or somebody else is streaming.
    OSError
        When the device does not answer.
    """

    def __init__(self, device: VideoDevice) -> None:
        self._device = device
        self._node = device.node
        wanted = abi.RequestBuffers(count=N_BUFFERS, type=device.buffer_type, memory=abi.MEMORY_MMAP)
        try:
            self._node.ioctl(abi.REQBUFS, wanted)
        except OSError as error:
            if error.errno == errno.EBUSY:
                raise SourceError(f"{device.path}: another program is using this camera") from error
            if error.errno == errno.EINVAL:
                raise SourceError(f"{device.path}: this driver has no buffers that can be mapped") from error
            raise
        if wanted.count < 2:
            raise SourceError(f"{device.path}: the driver gave {wanted.count} buffers; 2 are needed")
        self._memory: list[NDArray[np.uint8]] = [self._mapped(i) for i in range(wanted.count)]
        for index in range(wanted.count):
            self.queue(index)
        self._node.ioctl(abi.STREAMON, abi.BufferType(device.buffer_type))

    def next_filled(self, timeout_s: float) -> Filled | None:
        """Return the oldest filled buffer, or None when there is none within the time; raises OSError."""
        if not self._node.wait(timeout_s):
            return None
        buffer, planes = self._described()
        try:
            self._node.ioctl(abi.DQBUF, buffer)
        except BlockingIOError:
            return None
        used, offset = (planes[0].bytesused, planes[0].data_offset) if planes else (buffer.bytesused, 0)
        monotonic = buffer.flags & abi.BUF_FLAG_TIMESTAMP_MASK == abi.BUF_FLAG_TIMESTAMP_MONOTONIC
        time_ns = buffer.timestamp.tv_sec * 1_000_000_000 + buffer.timestamp.tv_usec * 1_000
        return Filled(
            buffer.index,
            self._memory[buffer.index][offset:used],
            bool(buffer.flags & abi.BUF_FLAG_ERROR),
            time_ns if monotonic else None,
            buffer.sequence,
        )

    def queue(self, index: int) -> None:
        """Give a buffer to the driver; raises OSError."""
        buffer, _planes = self._described(index)
        self._node.ioctl(abi.QBUF, buffer)

    def close(self) -> None:
        """Stop. Memory that somebody still looks at stays mapped, and is not filled any more."""
        with contextlib.suppress(OSError):  # it may be gone
            self._node.ioctl(abi.STREAMOFF, abi.BufferType(self._device.buffer_type))
        self._memory.clear()

    def _mapped(self, index: int) -> NDArray[np.uint8]:
        buffer, planes = self._described(index)
        self._node.ioctl(abi.QUERYBUF, buffer)
        if planes:
            return self._node.map(planes[0].length, planes[0].m.mem_offset)
        return self._node.map(buffer.length, buffer.m.offset)

    def _described(self, index: int = 0) -> tuple[abi.Buffer, ctypes.Array[abi.Plane] | None]:
        """Return what stands for a buffer in a call, and its planes, which have to live as long."""
        buffer = abi.Buffer(index=index, type=self._device.buffer_type, memory=abi.MEMORY_MMAP)
        if not self._device.is_multiplanar:
            return buffer, None
        planes = (abi.Plane * abi.MAX_PLANES)()
        buffer.m.planes = ctypes.cast(planes, ctypes.POINTER(abi.Plane))
        buffer.length = abi.MAX_PLANES
        return buffer, planes

"""A Video4Linux 2 camera, opened as the configuration asks and found again under another name."""

from __future__ import annotations

import contextlib
import errno
import zlib
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from companion.errors import SourceError
from companion.frames.capture import (
    CapturedImage,
    CaptureError,
    DamagedImageError,
    nothing_to_give_back,
)
from companion.frames.v4l2.buffers import Buffers, Filled
from companion.frames.v4l2.choose import choose_format
from companion.frames.v4l2.device import ActiveFormat, Identity, VideoDevice
from companion.frames.v4l2.kernel import Kernel
from companion.frames.v4l2.pixels import grey_image, is_compressed


@dataclass(frozen=True, slots=True)
class V4l2Wish:
    """How a camera is to be opened.

    Attributes
    ----------
    path
        A node, or better a link to it that lasts.
    format_name
        Four letters of a pixel format; "": the cheapest one that fits.
    width_px, height_px
        Size; 0: as the driver has it.
    rate_hz
        Frame rate; 0: as the driver has it.
    controls
        Names and values, in the order in which they are set.
    """

    path: str
    format_name: str = ""
    width_px: int = 0
    height_px: int = 0
    rate_hz: float = 0.0
    controls: tuple[tuple[str, str], ...] = ()


class V4l2Opener:
    """Opens the same camera each time it is called, under whatever name it has then.

    Parameters
    ----------
    wish
        Which camera, and how.
    kernel
        The operating system.
    """

    def __init__(self, wish: V4l2Wish, kernel: Kernel) -> None:
        self._wish = wish
        self._kernel = kernel
        self._known: Identity | None = None

    def __call__(self) -> V4l2Capture:
        """Open the camera.

        Raises
        ------
        companion.errors.SourceError
            When it is not there, or cannot do what is asked.
        OSError
            When its driver fails.
        """
        device = self._opened()
        try:
            capture = V4l2Capture(device, self._wish)
        except BaseException:
            device.node.close()
            raise
        self._known = device.identity
        return capture

    def _opened(self) -> VideoDevice:
        """Open the node that was asked for where it is that camera, else the one that is."""
        path = self._wish.path
        try:
            device = _device_at(self._kernel, path)
        except OSError as error:
            if (found := self._found_elsewhere()) is not None:
                return found
            if error.errno in (errno.ENOENT, errno.ENXIO, errno.ENODEV):
                raise SourceError(
                    f"{path}: no such camera; `companion cameras` lists those that are there"
                ) from error
            if error.errno == errno.EACCES:
                raise SourceError(f"{path}: no permission; add the user to the group video") from error
            if error.errno == errno.ENOTTY:
                raise SourceError(f"{path}: not a video device") from error
            raise SourceError(f"{path}: cannot be opened: {error.strerror or error}") from error
        if self._known is None or device.identity == self._known:
            return device
        found = self._found_elsewhere()
        if found is None:
            device.node.close()
            raise SourceError(f"{path}: is now {device.identity.card}, not {self._known.card}")
        device.node.close()
        return found

    def _found_elsewhere(self) -> VideoDevice | None:
        if self._known is None:
            return None
        same_model: list[VideoDevice] = []
        for node in self._kernel.nodes():
            device = None
            with contextlib.suppress(OSError, SourceError):
                device = _device_at(self._kernel, node.path)
            if device is None:
                continue
            if device.identity == self._known:
                for other in same_model:
                    other.node.close()
                return device
            if (device.identity.driver, device.identity.card) == (self._known.driver, self._known.card):
                same_model.append(device)
            else:
                device.node.close()
        if len(same_model) == 1:  # plugged in elsewhere, and there is no other like it
            return same_model[0]
        for device in same_model:
            device.node.close()
        return None


class V4l2Capture:
    """An open, streaming camera; satisfies ``companion.frames.capture.Capture``.

    Parameters
    ----------
    device
        The open device; closed with this.
    wish
        How it is to be set up.
    """

    def __init__(self, device: VideoDevice, wish: V4l2Wish) -> None:
        self._device = device
        self._format, rate_hz = _set_up(device, wish)
        set_controls = {name: device.set_control(name, value) for name, value in wish.controls}
        self._buffers = Buffers(device)
        self._returned: deque[int] = deque()
        self._last_sequence: int | None = None
        self._facts: dict[str, object] = {
            "camera": device.identity.card,
            "node": device.path,
            "format": self._format.name,
        }
        if rate_hz is not None:
            self._facts["rate_hz"] = round(rate_hz, 3)
        if set_controls:
            self._facts["controls"] = set_controls

    @property
    def facts(self) -> Mapping[str, object]:
        """What the log says of it."""
        return self._facts

    @property
    def format(self) -> ActiveFormat:
        """What the driver delivers."""
        return self._format

    def read(self, timeout_s: float) -> CapturedImage | None:
        """Return the newest image, or None when there is none within the time.

        Raises
        ------
        companion.frames.capture.CaptureError
            When the camera is gone.
        companion.frames.capture.DamagedImageError
            When what came is not a whole image.
        """
        try:
            self._queue_returned()
            filled = self._newest(timeout_s)
        except OSError as error:
            raise CaptureError(
                "unplugged" if error.errno == errno.ENODEV else f"failed: {error.strerror or error}"
            ) from error
        if filled is None:
            return None
        lost = 0 if self._last_sequence is None else max(0, filled.sequence - self._last_sequence - 1)
        self._last_sequence = filled.sequence
        try:
            image = self._grey_image(filled)
        except DamagedImageError:
            self._returned.append(filled.index)
            raise
        digest = zlib.crc32(filled.data.data)
        if is_compressed(self._format.name):  # decoded into memory of its own
            self._returned.append(filled.index)
            return CapturedImage(image, filled.time_ns, digest, lost, nothing_to_give_back)
        return CapturedImage(
            image, filled.time_ns, digest, lost, partial(self._returned.append, filled.index)
        )

    def close(self) -> None:
        """Stop and close."""
        self._buffers.close()
        with contextlib.suppress(OSError):  # gone already
            self._device.node.close()

    def _grey_image(self, filled: Filled) -> NDArray[np.uint8]:
        if filled.damaged:
            raise DamagedImageError("the driver says so")
        return grey_image(filled.data, self._format)

    def _queue_returned(self) -> None:
        while self._returned:
            self._buffers.queue(self._returned.popleft())

    def _newest(self, timeout_s: float) -> Filled | None:
        """Return the newest filled buffer; those that it overtook go back at once."""
        newest = self._buffers.next_filled(timeout_s)
        while newest is not None and (newer := self._buffers.next_filled(0.0)) is not None:
            self._buffers.queue(newest.index)
            newest = newer
        return newest


def _device_at(kernel: Kernel, path: str) -> VideoDevice:
    """Open a device; one that is no camera (USB cameras have a node for metadata) is closed again."""
    node = kernel.open(path)
    try:
        return VideoDevice(node, path)
    except BaseException:
        node.close()
        raise


def _set_up(device: VideoDevice, wish: V4l2Wish) -> tuple[ActiveFormat, float | None]:
    """Set format and rate; return what the driver made of them.

    Raises
    ------
    companion.errors.SourceError
        When the camera cannot do what is asked; says what it can do.
    """
    chosen = choose_format(
        device.formats(),
        device.active_format(),
        name=wish.format_name,
        width_px=wish.width_px,
        height_px=wish.height_px,
        rate_hz=wish.rate_hz,
        path=device.path,
    )
    try:
        active = device.set_format(chosen.name, chosen.width_px, chosen.height_px)
    except OSError as error:
        if error.errno == errno.EBUSY:
            raise SourceError(f"{device.path}: another program is using this camera") from error
        raise
    if (active.name, active.width_px, active.height_px) != (chosen.name, chosen.width_px, chosen.height_px):
        raise SourceError(
            f"{device.path}: asked for {chosen.name} of {chosen.width_px} x {chosen.height_px} px, the driver "
            f"gives {active.name} of {active.width_px} x {active.height_px} px"
        )
    return active, device.set_rate(wish.rate_hz)

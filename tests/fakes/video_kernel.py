"""A kernel with cameras that can be unplugged, stalled, frozen and broken: what a V4L2 driver answers, in Python."""

from __future__ import annotations

import errno
import threading
import time
import weakref
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.frames.v4l2 import abi
from companion.frames.v4l2.kernel import Node

PIXELS_BYTES = {
    "GREY": (1, 1),
    "YUYV": (2, 1),
    "UYVY": (2, 1),
    "NV12": (1, 1.5),
    "MJPG": (0, 2),
    "BGR3": (3, 1),
}


@dataclass
class FakeControl:
    number: int
    name: str
    kind: int
    minimum: int
    maximum: int
    value: int
    flags: int = 0
    menu: dict[int, str | int] = field(default_factory=dict)


@dataclass
class FakeCamera:
    """One camera. The fields below the line may be changed by a test at any time, from any thread."""

    card: str = "Fake Camera: Fake Camera"
    bus_info: str = "usb-0000:00:14.0-1"
    driver: str = "uvcvideo"
    formats: dict[str, dict[tuple[int, int], tuple[float, ...]]] = field(
        default_factory=lambda: {"GREY": {(64, 48): (200.0,)}}
    )
    controls: list[FakeControl] = field(default_factory=list)
    multiplanar: bool = False
    padding_bytes: int = 0
    image: NDArray[np.uint8] | None = None
    timestamp_flag: int = abi.BUF_FLAG_TIMESTAMP_MONOTONIC | abi.BUF_FLAG_TSTAMP_SRC_SOE
    period_s: float = 0.005
    capabilities: int | None = None
    # ----
    gone: bool = False
    stalled: bool = False
    frozen: bool = False
    damaged: bool = False
    truncated: bool = False
    delivers_px: tuple[int, int] | None = None
    time_offset_ns: int = 0
    opened: int = 0
    in_use: bool = False
    pictures: int = 0

    def picture(self, width_px: int, height_px: int) -> NDArray[np.uint8]:
        """The scene, with the number of the picture in its first pixels so that no two are alike."""
        if not self.frozen:
            self.pictures += 1
        if self.image is not None:
            grey = self.image.copy()
        else:
            y, x = np.mgrid[:height_px, :width_px]
            grey = ((x * 3 + y * 5) % 256).astype(np.uint8)
        grey[0, :4] = np.frombuffer(self.pictures.to_bytes(4, "little"), np.uint8)
        return grey


class FakeKernel:
    """Cameras by the path of their node; a test plugs and unplugs them by changing ``cameras``."""

    def __init__(self, cameras: dict[str, FakeCamera], links: dict[str, str] | None = None) -> None:
        self.cameras = cameras
        self.links = links or {}
        self.opened: list[FakeNode] = []

    def nodes(self) -> tuple[Node, ...]:
        return tuple(
            Node(path, tuple(link for link, to in self.links.items() if to == path)) for path in self.cameras
        )

    def mapped(self) -> int:
        """Return how many buffers somebody has mapped: as long as there is one, no driver can be removed."""
        return sum(memory() is not None for node in self.opened for memory in node.mapped)

    def open(self, path: str) -> FakeNode:
        path = self.links.get(path, path)
        camera = self.cameras.get(path)
        if camera is None or camera.gone:
            raise OSError(errno.ENOENT, "No such file or directory")
        camera.opened += 1
        self.opened.append(FakeNode(camera))
        return self.opened[-1]


class FakeNode:
    def __init__(self, camera: FakeCamera) -> None:
        self.camera = camera
        name, sizes = next(iter(camera.formats.items()))
        self.name = name
        self.size_px = next(iter(sizes))
        self.rate_hz = 30.0
        self.memory: list[NDArray[np.uint8]] = []
        self.mapped: list[weakref.ref[NDArray[np.uint8]]] = []
        self.queued: list[int] = []
        self.streaming = False
        self.closed = threading.Event()
        self.next_s = 0.0
        self.sequence = 0
        self.owns = False

    # ------------------------------------------------- what the source calls

    def ioctl(self, request: int, argument) -> None:
        if self.camera.gone or self.closed.is_set():
            raise OSError(errno.ENODEV, "No such device")
        calls = {
            abi.QUERYCAP: self._querycap,
            abi.ENUM_FMT: self._enum_fmt,
            abi.G_FMT: self._describe_format,
            abi.S_FMT: self._set_format,
            abi.G_PARM: self._get_rate,
            abi.S_PARM: self._set_rate,
            abi.ENUM_FRAMESIZES: self._enum_sizes,
            abi.ENUM_FRAMEINTERVALS: self._enum_intervals,
            abi.QUERYCTRL: self._query_control,
            abi.QUERYMENU: self._query_menu,
            abi.G_CTRL: self._get_control,
            abi.S_CTRL: self._set_control,
            abi.REQBUFS: self._request_buffers,
            abi.QUERYBUF: self._query_buffer,
            abi.QBUF: self._queue,
            abi.DQBUF: self._dequeue,
            abi.STREAMON: self._stream_on,
            abi.STREAMOFF: self._stream_off,
        }
        calls[request](argument)

    def map(self, length: int, offset: int) -> NDArray[np.uint8]:
        memory = self.memory[offset // 4096]
        assert length == memory.size
        mapped = np.frombuffer(memory.data, np.uint8)
        self.mapped.append(weakref.ref(mapped))
        return mapped

    def wait(self, timeout_s: float) -> bool:
        until_s = time.monotonic() + timeout_s
        while True:
            if self.camera.gone:
                return True  # POLLERR: the call that follows says what it is
            now_s = time.monotonic()
            if self.streaming and not self.camera.stalled and self.queued and now_s >= self.next_s:
                return True
            if now_s >= until_s:
                return False
            time.sleep(min(0.002, max(0.0, until_s - now_s)))

    def close(self) -> None:
        assert not self.closed.is_set(), "closed twice"
        self.closed.set()
        if self.owns:
            self.camera.in_use = False

    # ------------------------------------------------------ what it answers

    def _querycap(self, argument) -> None:
        argument.driver = self.camera.driver.encode()
        argument.card = self.camera.card.encode()[:31]
        argument.bus_info = self.camera.bus_info.encode()
        kind = abi.CAP_VIDEO_CAPTURE_MPLANE if self.camera.multiplanar else abi.CAP_VIDEO_CAPTURE
        caps = self.camera.capabilities
        argument.device_caps = kind | abi.CAP_STREAMING if caps is None else caps
        argument.capabilities = argument.device_caps | abi.CAP_DEVICE_CAPS

    @property
    def _type(self) -> int:
        multi = self.camera.multiplanar
        return abi.BUF_TYPE_VIDEO_CAPTURE_MPLANE if multi else abi.BUF_TYPE_VIDEO_CAPTURE

    def _check_type(self, argument) -> None:
        if argument.type != self._type:
            raise OSError(errno.EINVAL, "Invalid argument")

    def _enum_fmt(self, argument) -> None:
        self._check_type(argument)
        name = self._entry(list(self.camera.formats), argument.index)
        argument.pixelformat = abi.fourcc(name)
        argument.description = f"format {name}".encode()

    def _entry(self, entries, index):
        if index >= len(entries):
            raise OSError(errno.EINVAL, "Invalid argument")
        return entries[index]

    def _enum_sizes(self, argument) -> None:
        sizes = self.camera.formats.get(abi.fourcc_name(argument.pixel_format), {})
        argument.type = abi.ENUM_DISCRETE
        argument.u.discrete.width, argument.u.discrete.height = self._entry(list(sizes), argument.index)

    def _enum_intervals(self, argument) -> None:
        sizes = self.camera.formats[abi.fourcc_name(argument.pixel_format)]
        rate_hz = self._entry(list(sizes[argument.width, argument.height]), argument.index)
        argument.type = abi.ENUM_DISCRETE
        argument.u.discrete = abi.Fraction(1000, round(rate_hz * 1000))

    def _lengths(self) -> tuple[int, int]:
        line, planes = PIXELS_BYTES[self.name]
        line_bytes = self.size_px[0] * line + (self.camera.padding_bytes if line else 0)
        return line_bytes, int((line_bytes or self.size_px[0]) * self.size_px[1] * planes)

    def _describe_format(self, argument) -> None:
        self._check_type(argument)
        line_bytes, image_bytes = self._lengths()
        pix = argument.fmt.pix_mp if self.camera.multiplanar else argument.fmt.pix
        pix.pixelformat = abi.fourcc(self.name)
        pix.width, pix.height = self.size_px
        if self.camera.multiplanar:
            pix.num_planes = 1
            pix = pix.plane_fmt[0]
        pix.bytesperline, pix.sizeimage = line_bytes, image_bytes

    def _set_format(self, argument) -> None:
        self._check_type(argument)
        pix = argument.fmt.pix_mp if self.camera.multiplanar else argument.fmt.pix
        name = abi.fourcc_name(pix.pixelformat)
        if name in self.camera.formats:
            self.name = name
        sizes = list(self.camera.formats[self.name])
        wanted = (pix.width, pix.height)
        self.size_px = wanted if wanted in sizes else sizes[0]
        self._describe_format(argument)

    def _get_rate(self, argument) -> None:
        self._check_type(argument)
        argument.parm.capture.capability = abi.CAP_TIMEPERFRAME
        argument.parm.capture.timeperframe = abi.Fraction(1000, round(self.rate_hz * 1000))

    def _set_rate(self, argument) -> None:
        interval = argument.parm.capture.timeperframe
        self.rate_hz = interval.denominator / interval.numerator
        self._get_rate(argument)

    def _control(self, number: int) -> FakeControl:
        for control in self.camera.controls:
            if control.number == number:
                return control
        raise OSError(errno.EINVAL, "Invalid argument")

    def _query_control(self, argument) -> None:
        if argument.id & abi.CTRL_FLAG_NEXT_CTRL:
            after = argument.id & ~abi.CTRL_FLAG_NEXT_CTRL
            later = sorted((c for c in self.camera.controls if c.number > after), key=lambda c: c.number)
            control = self._entry(later, 0)
        else:
            control = self._control(argument.id)
        argument.id, argument.type = control.number, control.kind
        argument.name = control.name.encode()
        argument.minimum, argument.maximum, argument.step = control.minimum, control.maximum, 1
        argument.default_value, argument.flags = control.minimum, control.flags

    def _query_menu(self, argument) -> None:
        control = self._control(argument.id)
        if argument.index not in control.menu:
            raise OSError(errno.EINVAL, "Invalid argument")
        entry = control.menu[argument.index]
        if control.kind == abi.CTRL_TYPE_INTEGER_MENU:
            argument.u.value = entry
        else:
            argument.u.name = entry.encode()

    def _get_control(self, argument) -> None:
        argument.value = self._control(argument.id).value

    def _set_control(self, argument) -> None:
        control = self._control(argument.id)
        if not control.minimum <= argument.value <= control.maximum:
            raise OSError(errno.ERANGE, "Numerical result out of range")
        control.value = argument.value

    def _request_buffers(self, argument) -> None:
        if self.camera.in_use:
            raise OSError(errno.EBUSY, "Device or resource busy")
        self.owns = self.camera.in_use = True
        size = self._lengths()[1]
        self.memory = [np.zeros(size, np.uint8) for _ in range(argument.count)]

    def _query_buffer(self, argument) -> None:
        length, offset = self.memory[argument.index].size, argument.index * 4096
        if self.camera.multiplanar:
            argument.m.planes[0].length, argument.m.planes[0].m.mem_offset = length, offset
        else:
            argument.length, argument.m.offset = length, offset

    def _queue(self, argument) -> None:
        assert argument.index not in self.queued, "a buffer is queued twice"
        self.queued.append(argument.index)

    def _stream_on(self, argument) -> None:
        assert argument.value == self._type
        self.streaming = True
        self.next_s = time.monotonic() + self.camera.period_s

    def _stream_off(self, argument) -> None:
        self.streaming = False
        self.queued.clear()

    def _dequeue(self, argument) -> None:
        now_s = time.monotonic()
        if not self.streaming or self.camera.stalled or not self.queued or now_s < self.next_s:
            raise BlockingIOError(errno.EAGAIN, "Resource temporarily unavailable")
        missed = int((now_s - self.next_s) / self.camera.period_s)
        self.next_s += (missed + 1) * self.camera.period_s
        self.sequence += 1
        index = self.queued.pop(0)
        data = self._encoded(self.camera.picture(*self.size_px))
        if self.camera.truncated:
            data = data[: data.size // 2]
        self.memory[index][: data.size] = data
        argument.index, argument.sequence = index, self.sequence
        argument.flags = self.camera.timestamp_flag | (abi.BUF_FLAG_ERROR if self.camera.damaged else 0)
        stamp_ns = time.monotonic_ns() + self.camera.time_offset_ns
        argument.timestamp.tv_sec, argument.timestamp.tv_usec = (
            stamp_ns // 1_000_000_000,
            stamp_ns // 1000 % 1_000_000,
        )
        if self.camera.multiplanar:
            argument.m.planes[0].bytesused = data.size
        else:
            argument.bytesused = data.size

    def _encoded(self, grey: NDArray[np.uint8]) -> NDArray[np.uint8]:
        if self.name == "MJPG":
            return cv2.imencode(".jpg", grey)[1].ravel()
        line_bytes, image_bytes = self._lengths()
        data = np.full(image_bytes, 128, np.uint8)
        rows = data[: line_bytes * grey.shape[0]].reshape(grey.shape[0], line_bytes)
        width_px = grey.shape[1]
        match self.name:
            case "YUYV":
                rows[:, : 2 * width_px : 2] = grey
            case "UYVY":
                rows[:, 1 : 2 * width_px : 2] = grey
            case _:
                rows[:, :width_px] = grey
        return data

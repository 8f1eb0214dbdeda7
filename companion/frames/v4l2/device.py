"""One camera's driver: who it is, its pixel formats, sizes, rates and controls."""

from __future__ import annotations

import ctypes
import errno
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal, TypeVar

from companion.errors import SourceError
from companion.frames.v4l2 import abi
from companion.frames.v4l2.kernel import OpenNode

ControlKind = Literal["integer", "boolean", "menu", "button", "bitmask"]

_CONTROL_KINDS: dict[int, ControlKind] = {
    abi.CTRL_TYPE_INTEGER: "integer",
    abi.CTRL_TYPE_BOOLEAN: "boolean",
    abi.CTRL_TYPE_MENU: "menu",
    abi.CTRL_TYPE_INTEGER_MENU: "menu",
    abi.CTRL_TYPE_BUTTON: "button",
    abi.CTRL_TYPE_BITMASK: "bitmask",
}
_MOST_ENTRIES = 512
"""A driver that enumerates more than this of anything never ends."""

S = TypeVar("S", bound=ctypes.Structure)


@dataclass(frozen=True, slots=True)
class Identity:
    """Who a camera is, whatever its node is called today."""

    driver: str
    card: str
    bus_info: str


@dataclass(frozen=True, slots=True)
class FrameSize:
    """A size that a camera can deliver, and how often.

    Attributes
    ----------
    width_px, height_px
        Size; the largest one where the driver names a range.
    least_px
        (width, height) of the smallest one where the driver names a range.
    rates_hz
        Frame rates, fastest first; the fastest and the slowest where the driver names a range.
    """

    width_px: int
    height_px: int
    least_px: tuple[int, int] | None
    rates_hz: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class PixelFormat:
    """A pixel format: its four letters, the driver's words for it, and its sizes."""

    name: str
    description: str
    sizes: tuple[FrameSize, ...]


@dataclass(frozen=True, slots=True)
class ControlInfo:
    """A control of a camera, such as its exposure.

    Attributes
    ----------
    name
        Lower case with underscores, as ``v4l2-ctl`` writes it.
    number
        The kernel's.
    kind
        What its value is.
    minimum, maximum, step, default
        Of its value.
    value
        As it stands; None where it cannot be read.
    choices
        Value and name of each entry of a menu.
    writable
        Whether it can ever be set.
    active
        Whether setting it has an effect now; ``exposure_time_absolute`` has none while the exposure is automatic.
    """

    name: str
    number: int
    kind: ControlKind
    minimum: int
    maximum: int
    step: int
    default: int
    value: int | None
    choices: tuple[tuple[int, str], ...]
    writable: bool
    active: bool


@dataclass(frozen=True, slots=True)
class ActiveFormat:
    """What the driver delivers from now on.

    Attributes
    ----------
    name
        Four letters of the pixel format.
    width_px, height_px
        Size.
    line_bytes
        Distance of two rows in memory; 0 for compressed images.
    """

    name: str
    width_px: int
    height_px: int
    line_bytes: int


class VideoDevice:
    """An open capture device.

    Parameters
    ----------
    node
        Its open node.
    path
        Its name in messages.

    Raises
    ------
    companion.errors.SourceError
        When it is not a camera that streams.
    OSError
        When it does not answer.
    """

    def __init__(self, node: OpenNode, path: str) -> None:
        self.node = node
        self.path = path
        capability = abi.Capability()
        node.ioctl(abi.QUERYCAP, capability)
        self.identity = Identity(
            abi.text(capability.driver), abi.text(capability.card), abi.text(capability.bus_info)
        )
        caps = capability.capabilities
        if caps & abi.CAP_DEVICE_CAPS:
            caps = capability.device_caps
        if caps & abi.CAP_VIDEO_CAPTURE:
            self.buffer_type = abi.BUF_TYPE_VIDEO_CAPTURE
        elif caps & abi.CAP_VIDEO_CAPTURE_MPLANE:
            self.buffer_type = abi.BUF_TYPE_VIDEO_CAPTURE_MPLANE
        else:
            raise SourceError(f"{path}: not a camera: this node of {self.identity.card} captures no video")
        if not caps & abi.CAP_STREAMING:
            raise SourceError(f"{path}: {self.identity.card} does not stream into buffers")

    @property
    def is_multiplanar(self) -> bool:
        """Whether it speaks the interface for images in several planes."""
        return self.buffer_type == abi.BUF_TYPE_VIDEO_CAPTURE_MPLANE

    # ---------------------------------------------------------------- formats

    def formats(self) -> tuple[PixelFormat, ...]:
        """Return all pixel formats with their sizes and rates."""
        return tuple(
            PixelFormat(
                abi.fourcc_name(found.pixelformat),
                abi.text(found.description),
                tuple(self._sizes(found.pixelformat)),
            )
            for found in self._enumerated(
                abi.ENUM_FMT, lambda i: abi.FormatDescription(index=i, type=self.buffer_type)
            )
        )

    def format_names(self) -> tuple[str, ...]:
        """Return the four letters of each pixel format, in the driver's order."""
        return tuple(
            abi.fourcc_name(found.pixelformat)
            for found in self._enumerated(
                abi.ENUM_FMT, lambda i: abi.FormatDescription(index=i, type=self.buffer_type)
            )
        )

    def active_format(self) -> ActiveFormat:
        """Return the format as it stands."""
        wanted = abi.Format(type=self.buffer_type)
        self.node.ioctl(abi.G_FMT, wanted)
        return self._active(wanted)

    def set_format(self, name: str, width_px: int, height_px: int) -> ActiveFormat:
        """Ask for a format and return what the driver makes of that, which may be another one."""
        wanted = abi.Format(type=self.buffer_type)
        self.node.ioctl(abi.G_FMT, wanted)
        pix = wanted.fmt.pix_mp if self.is_multiplanar else wanted.fmt.pix
        pix.pixelformat = abi.fourcc(name)
        pix.width, pix.height = width_px, height_px
        pix.field = abi.FIELD_NONE
        if self.is_multiplanar:
            for plane in pix.plane_fmt:
                plane.bytesperline = plane.sizeimage = 0
        else:
            pix.bytesperline = pix.sizeimage = 0
        self.node.ioctl(abi.S_FMT, wanted)
        return self._active(wanted)

    def set_rate(self, rate_hz: float) -> float | None:
        """Ask for a frame rate; return what the driver makes of it, or None where it knows of none."""
        wanted = abi.StreamParameters(type=self.buffer_type)
        try:
            self.node.ioctl(abi.G_PARM, wanted)
            if rate_hz > 0 and wanted.parm.capture.capability & abi.CAP_TIMEPERFRAME:
                wanted.parm.capture.timeperframe = abi.Fraction(1000, round(rate_hz * 1000))
                self.node.ioctl(abi.S_PARM, wanted)
        except OSError as error:
            if error.errno in (errno.ENOTTY, errno.EINVAL):
                return None
            raise
        interval = wanted.parm.capture.timeperframe
        return interval.denominator / interval.numerator if interval.numerator else None

    def _active(self, found: abi.Format) -> ActiveFormat:
        if self.is_multiplanar:
            pix = found.fmt.pix_mp
            line_bytes = pix.plane_fmt[0].bytesperline
        else:
            pix = found.fmt.pix
            line_bytes = pix.bytesperline
        return ActiveFormat(abi.fourcc_name(pix.pixelformat), pix.width, pix.height, line_bytes)

    def _sizes(self, pixel_format: int) -> Iterator[FrameSize]:
        for found in self._enumerated(
            abi.ENUM_FRAMESIZES, lambda i: abi.SizeEnumeration(index=i, pixel_format=pixel_format)
        ):
            if found.type == abi.ENUM_DISCRETE:
                width_px, height_px = found.u.discrete.width, found.u.discrete.height
                least = None
            else:
                steps = found.u.stepwise
                width_px, height_px = steps.max_width, steps.max_height
                least = (steps.min_width, steps.min_height)
            yield FrameSize(
                width_px, height_px, least, tuple(self._rates_hz(pixel_format, width_px, height_px))
            )
            if least is not None:
                return  # a range is the only entry

    def _rates_hz(self, pixel_format: int, width_px: int, height_px: int) -> Iterator[float]:
        for found in self._enumerated(
            abi.ENUM_FRAMEINTERVALS,
            lambda i: abi.IntervalEnumeration(
                index=i, pixel_format=pixel_format, width=width_px, height=height_px
            ),
        ):
            if found.type == abi.ENUM_DISCRETE:
                yield _rate_hz(found.u.discrete)
            else:
                yield _rate_hz(found.u.stepwise.min)
                yield _rate_hz(found.u.stepwise.max)
                return

    def _enumerated(self, request: int, make: Callable[[int], S]) -> Iterator[S]:
        for index in range(_MOST_ENTRIES):
            entry = make(index)
            try:
                self.node.ioctl(request, entry)
            except OSError as error:
                if error.errno in (errno.EINVAL, errno.ENOTTY):  # the end, or nothing to enumerate
                    return
                raise
            yield entry

    # --------------------------------------------------------------- controls

    def controls(self) -> tuple[ControlInfo, ...]:
        """Return all controls that are numbers, in the driver's order."""
        return tuple(self._controls())

    def set_control(self, name: str, value: str) -> int | None:
        """Set a control by name.

        Parameters
        ----------
        name
            As in :class:`ControlInfo`.
        value
            A number, ``true`` or ``false``, or for a menu the name of an entry or its beginning.

        Returns
        -------
        The value that the driver has then, or None where it cannot be read.

        Raises
        ------
        companion.errors.SourceError
            When there is no such control, or it does not take the value; says what is allowed.
        """
        known = {control.name: control for control in self.controls()}
        control = known.get(name)
        if control is None:
            raise SourceError(
                f"{self.path}: no control {name!r}; this camera has {', '.join(known) or 'none'}"
            )
        if not control.writable:
            raise SourceError(f"{self.path}: control {name} can only be read")
        number = control_value(control, value)
        if number is None:
            raise SourceError(
                f"{self.path}: control {name}: found {value!r}; allowed: {allowed_values(control)}"
            )
        try:
            self.node.ioctl(abi.S_CTRL, abi.Control(control.number, number))
        except OSError as error:
            if error.errno == errno.ENODEV:
                raise
            raise SourceError(
                f"{self.path}: control {name} cannot be set to {value}: {error.strerror}"
            ) from error
        return self._value(control.number)

    def _controls(self) -> Iterator[ControlInfo]:
        query = abi.QueryControl(id=abi.CTRL_FLAG_NEXT_CTRL)
        for _ in range(_MOST_ENTRIES):
            try:
                self.node.ioctl(abi.QUERYCTRL, query)
            except OSError as error:
                if error.errno in (errno.EINVAL, errno.ENOTTY):
                    return
                raise
            kind = _CONTROL_KINDS.get(query.type)
            if kind is not None and not query.flags & abi.CTRL_FLAG_DISABLED:
                readable = kind != "button" and not query.flags & abi.CTRL_FLAG_WRITE_ONLY
                yield ControlInfo(
                    name=plain_name(abi.text(query.name)),
                    number=query.id,
                    kind=kind,
                    minimum=query.minimum,
                    maximum=query.maximum,
                    step=query.step,
                    default=query.default_value,
                    value=self._value(query.id) if readable else None,
                    choices=self._choices(query) if kind == "menu" else (),
                    writable=not query.flags & abi.CTRL_FLAG_READ_ONLY,
                    active=not query.flags & abi.CTRL_FLAG_INACTIVE,
                )
            query = abi.QueryControl(id=query.id | abi.CTRL_FLAG_NEXT_CTRL)

    def _choices(self, query: abi.QueryControl) -> tuple[tuple[int, str], ...]:
        choices = []
        for index in range(max(0, query.minimum), min(query.maximum, _MOST_ENTRIES) + 1):
            entry = abi.QueryMenu(id=query.id, index=index)
            try:
                self.node.ioctl(abi.QUERYMENU, entry)
            except OSError as error:
                if error.errno == errno.EINVAL:  # menus have gaps
                    continue
                raise
            if query.type == abi.CTRL_TYPE_INTEGER_MENU:
                choices.append((index, str(entry.u.value)))
            else:
                choices.append((index, plain_name(abi.text(entry.u.name))))
        return tuple(choices)

    def _value(self, number: int) -> int | None:
        control = abi.Control(id=number)
        try:
            self.node.ioctl(abi.G_CTRL, control)
        except OSError as error:
            if error.errno == errno.ENODEV:
                raise
            return None
        return int(control.value)


def plain_name(name: str) -> str:
    """Return a driver's name as people type it: ``Exposure Time, Absolute`` is ``exposure_time_absolute``."""
    return re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")


def control_value(control: ControlInfo, value: str) -> int | None:
    """Return what a value in words is for a control, or None when it does not take it."""
    words = value.strip().lower()
    if control.kind == "boolean" and words in ("true", "false", "on", "off"):
        return int(words in ("true", "on"))
    try:
        number = int(words, 0)
    except ValueError:
        name = plain_name(words)
        exact = [at for at, choice in control.choices if choice == name]
        near = exact or [at for at, choice in control.choices if name and choice.startswith(name)]
        return near[0] if len(near) == 1 else None
    if control.kind == "menu":
        return number if number in dict(control.choices) else None
    return number if control.kind == "button" or control.minimum <= number <= control.maximum else None


def allowed_values(control: ControlInfo) -> str:
    """Return what a control takes, in words."""
    match control.kind:
        case "boolean":
            return "true or false"
        case "menu":
            return ", ".join(f"{at} ({name})" for at, name in control.choices)
        case "button":
            return "any number"
        case _:
            return f"{control.minimum} to {control.maximum}"


def _rate_hz(interval: abi.Fraction) -> float:
    return interval.denominator / interval.numerator if interval.numerator else 0.0

"""The part of the kernel's Video4Linux 2 interface that a camera needs: numbers and structures, no system call.

Names, layouts and values are those of the kernel's documentation, "Video for Linux API", chapter "Function Reference"
(https://docs.kernel.org/userspace-api/media/v4l/user-func.html). They never change: programs of twenty years ago use them.
"""

from __future__ import annotations

import ctypes
from ctypes import c_char, c_int32, c_int64, c_long, c_uint8, c_uint32, c_ulong
from typing import Final

# Capabilities of a device (VIDIOC_QUERYCAP)
CAP_VIDEO_CAPTURE: Final = 0x0000_0001
CAP_VIDEO_CAPTURE_MPLANE: Final = 0x0000_1000
CAP_STREAMING: Final = 0x0400_0000
CAP_DEVICE_CAPS: Final = 0x8000_0000

BUF_TYPE_VIDEO_CAPTURE: Final = 1
BUF_TYPE_VIDEO_CAPTURE_MPLANE: Final = 9
MEMORY_MMAP: Final = 1
FIELD_ANY: Final = 0
FIELD_NONE: Final = 1
CAP_TIMEPERFRAME: Final = 0x1000
MAX_PLANES: Final = 8

# Flags of a buffer
BUF_FLAG_ERROR: Final = 0x0000_0040
BUF_FLAG_TIMESTAMP_MASK: Final = 0x0000_E000
BUF_FLAG_TIMESTAMP_MONOTONIC: Final = 0x0000_2000
BUF_FLAG_TSTAMP_SRC_MASK: Final = 0x0007_0000
BUF_FLAG_TSTAMP_SRC_SOE: Final = 0x0001_0000

# Kinds and flags of controls
CTRL_TYPE_INTEGER: Final = 1
CTRL_TYPE_BOOLEAN: Final = 2
CTRL_TYPE_MENU: Final = 3
CTRL_TYPE_BUTTON: Final = 4
CTRL_TYPE_BITMASK: Final = 8
CTRL_TYPE_INTEGER_MENU: Final = 9
CTRL_FLAG_DISABLED: Final = 0x01
CTRL_FLAG_READ_ONLY: Final = 0x04
CTRL_FLAG_INACTIVE: Final = 0x10
CTRL_FLAG_WRITE_ONLY: Final = 0x40
CTRL_FLAG_NEXT_CTRL: Final = 0x8000_0000

# Kinds of an enumerated size or interval
ENUM_DISCRETE: Final = 1


class Capability(ctypes.Structure):
    """``struct v4l2_capability``."""

    _fields_ = (
        ("driver", c_char * 16),
        ("card", c_char * 32),
        ("bus_info", c_char * 32),
        ("version", c_uint32),
        ("capabilities", c_uint32),
        ("device_caps", c_uint32),
        ("reserved", c_uint32 * 3),
    )


class FormatDescription(ctypes.Structure):
    """``struct v4l2_fmtdesc``."""

    _fields_ = (
        ("index", c_uint32),
        ("type", c_uint32),
        ("flags", c_uint32),
        ("description", c_char * 32),
        ("pixelformat", c_uint32),
        ("mbus_code", c_uint32),
        ("reserved", c_uint32 * 3),
    )


class PixFormat(ctypes.Structure):
    """``struct v4l2_pix_format``."""

    _fields_ = (
        ("width", c_uint32),
        ("height", c_uint32),
        ("pixelformat", c_uint32),
        ("field", c_uint32),
        ("bytesperline", c_uint32),
        ("sizeimage", c_uint32),
        ("colorspace", c_uint32),
        ("priv", c_uint32),
        ("flags", c_uint32),
        ("ycbcr_enc", c_uint32),
        ("quantization", c_uint32),
        ("xfer_func", c_uint32),
    )


class PlanePixFormat(ctypes.Structure):
    """``struct v4l2_plane_pix_format``."""

    _pack_ = 1
    _fields_ = (("sizeimage", c_uint32), ("bytesperline", c_uint32), ("reserved", c_uint8 * 12))


class PixFormatMplane(ctypes.Structure):
    """``struct v4l2_pix_format_mplane``."""

    _pack_ = 1
    _fields_ = (
        ("width", c_uint32),
        ("height", c_uint32),
        ("pixelformat", c_uint32),
        ("field", c_uint32),
        ("colorspace", c_uint32),
        ("plane_fmt", PlanePixFormat * MAX_PLANES),
        ("num_planes", c_uint8),
        ("flags", c_uint8),
        ("ycbcr_enc", c_uint8),
        ("quantization", c_uint8),
        ("xfer_func", c_uint8),
        ("reserved", c_uint8 * 7),
    )


class _FormatUnion(ctypes.Union):
    # The pointer is there for the alignment that other members of the kernel's union ask for.
    _fields_ = (
        ("pix", PixFormat),
        ("pix_mp", PixFormatMplane),
        ("raw_data", c_uint8 * 200),
        ("alignment", c_ulong),
    )


class Format(ctypes.Structure):
    """``struct v4l2_format``."""

    _fields_ = (("type", c_uint32), ("fmt", _FormatUnion))


class Fraction(ctypes.Structure):
    """``struct v4l2_fract``."""

    _fields_ = (("numerator", c_uint32), ("denominator", c_uint32))


class CaptureParameters(ctypes.Structure):
    """``struct v4l2_captureparm``."""

    _fields_ = (
        ("capability", c_uint32),
        ("capturemode", c_uint32),
        ("timeperframe", Fraction),
        ("extendedmode", c_uint32),
        ("readbuffers", c_uint32),
        ("reserved", c_uint32 * 4),
    )


class _StreamUnion(ctypes.Union):
    _fields_ = (("capture", CaptureParameters), ("raw_data", c_uint8 * 200))


class StreamParameters(ctypes.Structure):
    """``struct v4l2_streamparm``."""

    _fields_ = (("type", c_uint32), ("parm", _StreamUnion))


class RequestBuffers(ctypes.Structure):
    """``struct v4l2_requestbuffers``."""

    _fields_ = (
        ("count", c_uint32),
        ("type", c_uint32),
        ("memory", c_uint32),
        ("capabilities", c_uint32),
        ("flags", c_uint8),
        ("reserved", c_uint8 * 3),
    )


class Timeval(ctypes.Structure):
    """``struct timeval``."""

    _fields_ = (("tv_sec", c_long), ("tv_usec", c_long))


class Timecode(ctypes.Structure):
    """``struct v4l2_timecode``."""

    _fields_ = (
        ("type", c_uint32),
        ("flags", c_uint32),
        ("frames", c_uint8),
        ("seconds", c_uint8),
        ("minutes", c_uint8),
        ("hours", c_uint8),
        ("userbits", c_uint8 * 4),
    )


class _PlaneMemory(ctypes.Union):
    _fields_ = (("mem_offset", c_uint32), ("userptr", c_ulong), ("fd", c_int32))


class Plane(ctypes.Structure):
    """``struct v4l2_plane``."""

    _fields_ = (
        ("bytesused", c_uint32),
        ("length", c_uint32),
        ("m", _PlaneMemory),
        ("data_offset", c_uint32),
        ("reserved", c_uint32 * 11),
    )


class _BufferMemory(ctypes.Union):
    _fields_ = (
        ("offset", c_uint32),
        ("userptr", c_ulong),
        ("planes", ctypes.POINTER(Plane)),
        ("fd", c_int32),
    )


class Buffer(ctypes.Structure):
    """``struct v4l2_buffer``."""

    _fields_ = (
        ("index", c_uint32),
        ("type", c_uint32),
        ("bytesused", c_uint32),
        ("flags", c_uint32),
        ("field", c_uint32),
        ("timestamp", Timeval),
        ("timecode", Timecode),
        ("sequence", c_uint32),
        ("memory", c_uint32),
        ("m", _BufferMemory),
        ("length", c_uint32),
        ("reserved2", c_uint32),
        ("request_fd", c_int32),
    )


class BufferType(ctypes.Structure):
    """The ``int`` that VIDIOC_STREAMON and VIDIOC_STREAMOFF take."""

    _fields_ = (("value", c_int32),)


class Control(ctypes.Structure):
    """``struct v4l2_control``."""

    _fields_ = (("id", c_uint32), ("value", c_int32))


class QueryControl(ctypes.Structure):
    """``struct v4l2_queryctrl``."""

    _fields_ = (
        ("id", c_uint32),
        ("type", c_uint32),
        ("name", c_char * 32),
        ("minimum", c_int32),
        ("maximum", c_int32),
        ("step", c_int32),
        ("default_value", c_int32),
        ("flags", c_uint32),
        ("reserved", c_uint32 * 2),
    )


class _MenuUnion(ctypes.Union):
    _pack_ = 1
    _fields_ = (("name", c_char * 32), ("value", c_int64))


class QueryMenu(ctypes.Structure):
    """``struct v4l2_querymenu``."""

    _pack_ = 1
    _fields_ = (("id", c_uint32), ("index", c_uint32), ("u", _MenuUnion), ("reserved", c_uint32))


class SizeDiscrete(ctypes.Structure):
    """``struct v4l2_frmsize_discrete``."""

    _fields_ = (("width", c_uint32), ("height", c_uint32))


class SizeStepwise(ctypes.Structure):
    """``struct v4l2_frmsize_stepwise``."""

    _fields_ = (
        ("min_width", c_uint32),
        ("max_width", c_uint32),
        ("step_width", c_uint32),
        ("min_height", c_uint32),
        ("max_height", c_uint32),
        ("step_height", c_uint32),
    )


class _SizeUnion(ctypes.Union):
    _fields_ = (("discrete", SizeDiscrete), ("stepwise", SizeStepwise))


class SizeEnumeration(ctypes.Structure):
    """``struct v4l2_frmsizeenum``."""

    _fields_ = (
        ("index", c_uint32),
        ("pixel_format", c_uint32),
        ("type", c_uint32),
        ("u", _SizeUnion),
        ("reserved", c_uint32 * 2),
    )


class IntervalStepwise(ctypes.Structure):
    """``struct v4l2_frmival_stepwise``."""

    _fields_ = (("min", Fraction), ("max", Fraction), ("step", Fraction))


class _IntervalUnion(ctypes.Union):
    _fields_ = (("discrete", Fraction), ("stepwise", IntervalStepwise))


class IntervalEnumeration(ctypes.Structure):
    """``struct v4l2_frmivalenum``."""

    _fields_ = (
        ("index", c_uint32),
        ("pixel_format", c_uint32),
        ("width", c_uint32),
        ("height", c_uint32),
        ("type", c_uint32),
        ("u", _IntervalUnion),
        ("reserved", c_uint32 * 2),
    )


def _read(number: int, structure: type[ctypes.Structure]) -> int:
    return 0x8000_0000 | ctypes.sizeof(structure) << 16 | ord("V") << 8 | number


def _write(number: int, structure: type[ctypes.Structure]) -> int:
    return 0x4000_0000 | ctypes.sizeof(structure) << 16 | ord("V") << 8 | number


def _both(number: int, structure: type[ctypes.Structure]) -> int:
    return _read(number, structure) | _write(number, structure)


QUERYCAP: Final = _read(0, Capability)
ENUM_FMT: Final = _both(2, FormatDescription)
G_FMT: Final = _both(4, Format)
S_FMT: Final = _both(5, Format)
REQBUFS: Final = _both(8, RequestBuffers)
QUERYBUF: Final = _both(9, Buffer)
QBUF: Final = _both(15, Buffer)
DQBUF: Final = _both(17, Buffer)
STREAMON: Final = _write(18, BufferType)
STREAMOFF: Final = _write(19, BufferType)
G_PARM: Final = _both(21, StreamParameters)
S_PARM: Final = _both(22, StreamParameters)
G_CTRL: Final = _both(27, Control)
S_CTRL: Final = _both(28, Control)
QUERYCTRL: Final = _both(36, QueryControl)
QUERYMENU: Final = _both(37, QueryMenu)
ENUM_FRAMESIZES: Final = _both(74, SizeEnumeration)
ENUM_FRAMEINTERVALS: Final = _both(75, IntervalEnumeration)


def fourcc(name: str) -> int:
    """Return the number of a pixel format's four letters."""
    return int.from_bytes(name.encode("ascii").ljust(4), "little")


def fourcc_name(number: int) -> str:
    """Return the four letters of a pixel format's number."""
    return (number & 0x7FFF_FFFF).to_bytes(4, "little").decode("ascii", "backslashreplace").rstrip()


def text(field: bytes) -> str:
    """Return a name from the kernel as text."""
    return field.decode("utf-8", "replace").strip()

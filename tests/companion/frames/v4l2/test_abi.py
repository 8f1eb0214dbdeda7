"""The numbers and sizes that a C program gets from linux/videodev2.h on a 64-bit machine."""

import ctypes
import struct

import pytest

from companion.frames.v4l2 import abi

pytestmark = pytest.mark.skipif(
    struct.calcsize("P") != 8, reason="pointers and time values are 64 bits wide here"
)


@pytest.mark.parametrize(
    ("name", "number"),
    [
        ("QUERYCAP", 0x80685600),
        ("ENUM_FMT", 0xC0405602),
        ("G_FMT", 0xC0D05604),
        ("S_FMT", 0xC0D05605),
        ("REQBUFS", 0xC0145608),
        ("QUERYBUF", 0xC0585609),
        ("QBUF", 0xC058560F),
        ("DQBUF", 0xC0585611),
        ("STREAMON", 0x40045612),
        ("STREAMOFF", 0x40045613),
        ("G_PARM", 0xC0CC5615),
        ("S_PARM", 0xC0CC5616),
        ("G_CTRL", 0xC008561B),
        ("S_CTRL", 0xC008561C),
        ("QUERYCTRL", 0xC0445624),
        ("QUERYMENU", 0xC02C5625),
        ("ENUM_FRAMESIZES", 0xC02C564A),
        ("ENUM_FRAMEINTERVALS", 0xC034564B),
    ],
)
def test_a_request_has_the_kernels_number_which_holds_its_structures_size(name, number):
    assert getattr(abi, name) == number


@pytest.mark.parametrize(
    ("structure", "member", "offset"),
    [
        (abi.Format, "fmt", 8),
        (abi.Buffer, "timestamp", 24),
        (abi.Buffer, "m", 64),
        (abi.Buffer, "length", 72),
        (abi.Plane, "data_offset", 16),
        (abi.PixFormatMplane, "num_planes", 180),
        (abi.QueryMenu, "u", 8),
    ],
)
def test_members_lie_where_the_kernel_looks_for_them(structure, member, offset):
    assert getattr(structure, member).offset == offset


def test_plane_descriptions_have_the_kernels_size():
    assert ctypes.sizeof(abi.Plane) == 64
    assert ctypes.sizeof(abi.PixFormatMplane) == 192


def test_four_letters_are_a_number_and_back():
    assert abi.fourcc("GREY") == 0x59455247
    assert abi.fourcc_name(abi.fourcc("YU12")) == "YU12"
    assert abi.fourcc_name(abi.fourcc("Y16") | 0x8000_0000) == "Y16"  # big-endian variants have this bit

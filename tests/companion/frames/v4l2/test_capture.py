import time

import numpy as np
import pytest

from companion.errors import SourceError
from companion.frames.capture import CaptureError, DamagedImageError
from companion.frames.v4l2 import abi
from companion.frames.v4l2.capture import V4l2Opener, V4l2Wish
from tests.fakes.video_kernel import FakeCamera, FakeControl, FakeKernel

SIZES = {(64, 48): (30.0,), (320, 240): (30.0, 15.0)}
NODE = "/dev/video0"


def controls() -> list[FakeControl]:
    return [
        FakeControl(0x980913, "Gain", abi.CTRL_TYPE_INTEGER, 0, 100, 4),
        FakeControl(
            0x9A0901,
            "Auto Exposure",
            abi.CTRL_TYPE_MENU,
            0,
            3,
            3,
            menu={1: "Manual Mode", 3: "Aperture Priority Mode"},
        ),
        FakeControl(0x9A0902, "Exposure Time, Absolute", abi.CTRL_TYPE_INTEGER, 1, 5000, 157),
        FakeControl(0x9A0903, "Exposure, Dynamic Framerate", abi.CTRL_TYPE_BOOLEAN, 0, 1, 0),
        FakeControl(0x9A0999, "Serial", abi.CTRL_TYPE_INTEGER, 0, 9, 7, flags=abi.CTRL_FLAG_READ_ONLY),
    ]


def opener(camera: FakeCamera, **wish) -> V4l2Opener:
    return V4l2Opener(V4l2Wish(NODE, **wish), FakeKernel({NODE: camera}))


def expected(width_px: int, height_px: int) -> np.ndarray:
    y, x = np.mgrid[:height_px, :width_px]
    return ((x * 3 + y * 5) % 256).astype(np.uint8)


@pytest.mark.parametrize("multiplanar", [False, True])
@pytest.mark.parametrize("padding_bytes", [0, 16])
@pytest.mark.parametrize("name", ["GREY", "YUYV", "UYVY", "NV12"])
def test_each_format_gives_the_same_grey_values_without_a_copy(name, padding_bytes, multiplanar):
    camera = FakeCamera(formats={name: SIZES}, padding_bytes=padding_bytes, multiplanar=multiplanar)
    capture = opener(camera, format_name=name, width_px=320, height_px=240)()
    before_ns = time.monotonic_ns()
    captured = capture.read(5.0)
    assert captured is not None
    np.testing.assert_array_equal(captured.image[1:], expected(320, 240)[1:])
    assert any(np.shares_memory(captured.image, memory) for memory in capture._device.node.memory)
    assert before_ns - 1000 <= captured.time_ns <= time.monotonic_ns()
    capture.close()


def test_mjpeg_is_decoded_and_its_buffer_goes_back_at_once():
    camera = FakeCamera(formats={"MJPG": SIZES}, image=np.full((48, 64), 90, np.uint8))
    capture = opener(camera)()
    for _ in range(10):
        captured = capture.read(5.0)
        assert captured is not None
        assert abs(int(captured.image[30, 40]) - 90) <= 2
    capture.close()


def test_a_buffer_that_is_looked_at_is_not_filled_again_until_it_is_given_back():
    capture = opener(FakeCamera())()
    held = capture.read(5.0)
    assert held is not None
    seen = held.image.copy()
    numbers = set()
    for _ in range(20):
        captured = capture.read(5.0)
        assert captured is not None
        numbers.add(bytes(captured.image[0, :4]))
        captured.give_back()
        np.testing.assert_array_equal(held.image, seen)
    assert len(numbers) == 20
    held.give_back()
    capture.close()


def test_a_slow_reader_gets_the_newest_image_and_is_told_what_was_lost():
    camera = FakeCamera(period_s=0.01)
    capture = opener(camera)()
    first = capture.read(5.0)
    assert first is not None
    first.give_back()
    time.sleep(0.1)
    second = capture.read(5.0)
    assert second is not None
    assert int.from_bytes(second.image[0, :4].tobytes(), "little") == camera.pictures
    capture.close()


@pytest.mark.parametrize(
    ("fault", "message"), [("damaged", "the driver says so"), ("truncated", "of 3072 bytes")]
)
def test_damage_is_said_and_does_not_cost_a_buffer(fault, message):
    camera = FakeCamera()
    capture = opener(camera)()
    setattr(camera, fault, True)
    for _ in range(10):
        with pytest.raises(DamagedImageError, match=message):
            capture.read(5.0)
    setattr(camera, fault, False)
    assert capture.read(5.0) is not None
    capture.close()


def test_half_a_jpeg_is_damaged():
    camera = FakeCamera(formats={"MJPG": SIZES}, truncated=True)
    capture = opener(camera)()
    with pytest.raises(DamagedImageError, match="JPEG without its end"):
        capture.read(5.0)
    capture.close()


def test_an_unplugged_camera_is_said_at_once_and_nothing_is_not_waited_out():
    camera = FakeCamera()
    capture = opener(camera)()
    camera.stalled = True
    assert capture.read(0.01) is None
    camera.gone = True
    with pytest.raises(CaptureError, match="unplugged"):
        capture.read(5.0)
    capture.close()


def test_a_time_stamp_of_another_clock_is_none():
    capture = opener(FakeCamera(timestamp_flag=0))()
    captured = capture.read(5.0)
    assert captured is not None
    assert captured.time_ns is None
    capture.close()


def test_controls_are_set_by_name_in_their_order():
    camera = FakeCamera(controls=controls())
    wish = (
        ("auto_exposure", "manual"),
        ("exposure_time_absolute", "80"),
        ("gain", "0x10"),
        ("exposure_dynamic_framerate", "true"),
    )
    capture = opener(camera, controls=wish)()
    assert [control.value for control in camera.controls] == [16, 1, 80, 1, 7]
    assert capture.facts["controls"] == {
        "auto_exposure": 1,
        "exposure_time_absolute": 80,
        "gain": 16,
        "exposure_dynamic_framerate": 1,
    }
    capture.close()


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("exposure", "3", "no control 'exposure'; this camera has gain, auto_exposure"),
        ("gain", "101", "control gain: found '101'; allowed: 0 to 100"),
        ("gain", "high", "control gain: found 'high'; allowed: 0 to 100"),
        ("auto_exposure", "2", r"allowed: 1 \(manual_mode\), 3 \(aperture_priority_mode\)"),
        ("serial", "3", "control serial can only be read"),
    ],
)
def test_a_control_that_cannot_be_set_is_said_with_what_is_allowed(name, value, message):
    camera = FakeCamera(controls=controls())
    with pytest.raises(SourceError, match=message):
        opener(camera, controls=((name, value),))()
    assert not camera.in_use


@pytest.mark.parametrize(
    ("camera", "wish", "message"),
    [
        (FakeCamera(formats={"BGR3": SIZES}), {}, "no pixel format that is understood: found BGR3"),
        (FakeCamera(), {"format_name": "NV12"}, "no pixel format NV12; this camera has GREY"),
        (
            FakeCamera(formats={"GREY": SIZES}),
            {"width_px": 640, "height_px": 480},
            "no size of 640 x 480 px in GREY; this camera has 64 x 48, 320 x 240",
        ),
        (FakeCamera(in_use=True), {}, "another program is using this camera"),
        (FakeCamera(capabilities=abi.CAP_STREAMING), {}, "captures no video"),
        (FakeCamera(gone=True), {}, "no such camera"),
    ],
)
def test_what_a_camera_cannot_do_is_said_with_what_it_can(camera, wish, message):
    with pytest.raises(SourceError, match=message):
        opener(camera, **wish)()


@pytest.mark.parametrize(
    ("formats", "wish", "chosen"),
    [
        ({"MJPG": {(640, 480): (30.0,)}, "YUYV": {(640, 480): (30.0,)}}, {}, "YUYV"),
        ({"MJPG": {(640, 480): (30.0,)}, "YUYV": {(640, 480): (5.0,)}}, {}, "MJPG"),
        ({"YUYV": {(640, 480): (30.0, 15.0)}, "MJPG": {(640, 480): (60.0,)}}, {"rate_hz": 60.0}, "MJPG"),
        ({"YUYV": {(640, 480): (29.97,)}, "MJPG": {(640, 480): (60.0,)}}, {"rate_hz": 30.0}, "YUYV"),
        ({"YUYV": {(640, 480): (5.0,)}, "MJPG": {(640, 480): (10.0,)}}, {"rate_hz": 60.0}, "MJPG"),
        ({"YUYV": {(640, 480): ()}, "MJPG": {(640, 480): ()}}, {"rate_hz": 60.0}, "YUYV"),
    ],
)
def test_the_cheapest_format_that_is_fast_enough_is_chosen(formats, wish, chosen):
    capture = opener(FakeCamera(formats=formats), width_px=640, height_px=480, **wish)()
    assert capture.format.name == chosen
    assert capture.facts["rate_hz"] == wish.get("rate_hz", 30.0)
    capture.close()


def test_a_camera_is_found_again_under_another_name():
    camera, other = FakeCamera(), FakeCamera(card="Other", bus_info="usb-2")
    kernel = FakeKernel({"/dev/video0": camera, "/dev/video2": other})
    again = V4l2Opener(V4l2Wish("/dev/video0"), kernel)
    again().close()
    kernel.cameras = {"/dev/video0": other, "/dev/video2": camera}
    capture = again()
    assert capture.facts["node"] == "/dev/video2"
    capture.close()
    camera.bus_info = "usb-7"  # plugged into another socket: still the only one of its kind
    capture = again()
    assert capture.facts["node"] == "/dev/video2"
    capture.close()
    kernel.cameras = {"/dev/video0": other}
    with pytest.raises(SourceError, match="is now Other, not Fake Camera"):
        again()
    assert not other.in_use
    del kernel.cameras["/dev/video0"]
    with pytest.raises(SourceError, match="no such camera"):
        again()
    kernel.cameras = {"/dev/video0": FakeCamera(capabilities=abi.CAP_STREAMING)}
    with pytest.raises(SourceError, match="captures no video"):
        again()
    assert all(node.closed.is_set() for node in kernel.opened)

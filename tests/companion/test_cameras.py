import io
import json

import cv2
import numpy as np
import pytest

from companion.cameras import answer, cameras_parser, grabbed, measure
from companion.cli import main
from companion.clock import RealClock
from companion.config import LogConfig
from companion.frames.camera import CameraSource
from companion.frames.v4l2 import abi
from companion.frames.v4l2.capture import V4l2Opener, V4l2Wish
from companion.log import open_log
from tests.fakes.video_kernel import FakeCamera, FakeControl, FakeKernel

NODE = "/dev/video0"
LINK = "/dev/v4l/by-id/usb-Fake-video-index0"


def kernel() -> FakeKernel:
    camera = FakeCamera(
        formats={"YUYV": {(640, 480): (30.0, 15.0)}, "MJPG": {(1280, 720): (30.0,)}},
        controls=[
            FakeControl(1, "Gain", abi.CTRL_TYPE_INTEGER, 0, 100, 4),
            FakeControl(2, "Power Line Frequency", abi.CTRL_TYPE_MENU, 0, 2, 1, menu={0: "Disabled", 1: "50 Hz"}),
            FakeControl(3, "Sizes", abi.CTRL_TYPE_INTEGER_MENU, 0, 1, 0, flags=abi.CTRL_FLAG_INACTIVE, menu={0: 7, 1: 9}),
        ],
    )  # fmt: skip
    metadata = FakeCamera(capabilities=abi.CAP_STREAMING)
    return FakeKernel({NODE: camera, "/dev/video1": metadata}, {LINK: NODE})


def test_the_list_says_what_to_write_into_the_configuration():
    text = answer(cameras_parser().parse_args([]), kernel())
    assert text == "\n".join(
        [
            "Fake Camera: Fake Camera (uvcvideo, usb-0000:00:14.0-1)",
            f'  url = "v4l2:{LINK}"',
            f'  url = "v4l2:{NODE}"',
            "  YUYV (format YUYV)",
            "    640 x 480 px at 30, 15 Hz",
            "  MJPG (format MJPG)",
            "    1280 x 720 px at 30 Hz",
            "  controls",
            "    gain = 4   # 0 to 100; default 0",
            "    power_line_frequency = 1   # 0 (disabled), 1 (50_hz); default 0",
            "    sizes = 0   # 0 (7), 1 (9); default 0, without effect now",
        ]
    )


def test_the_list_as_json_has_everything():
    (camera,) = json.loads(answer(cameras_parser().parse_args(["--json"]), kernel()))
    assert camera["identity"] == {"driver": "uvcvideo", "card": "Fake Camera: Fake Camera", "bus_info": "usb-0000:00:14.0-1"}  # fmt: skip
    assert camera["formats"][0]["sizes"][0]["rates_hz"] == [30.0, 15.0]
    assert [control["name"] for control in camera["controls"]] == ["gain", "power_line_frequency", "sizes"]


def test_a_node_that_does_not_answer_is_listed_with_its_reason():
    cameras = kernel()
    cameras.cameras[NODE].gone = True
    assert answer(cameras_parser().parse_args([]), cameras) == (
        "/dev/video0: cannot be asked: No such file or directory"
    )
    assert answer(cameras_parser().parse_args([]), FakeKernel({})).startswith("no camera found")


def source(camera: FakeCamera, log) -> CameraSource:
    opener = V4l2Opener(V4l2Wish(NODE), FakeKernel({NODE: camera}))
    return CameraSource(opener, name="v4l2:" + NODE, clock=RealClock(), log=log)


async def test_a_grabbed_picture_is_one_after_the_first_ones_and_stays_as_it_is():
    with open_log(LogConfig(), io.StringIO()) as log:
        async with source(FakeCamera(), log) as camera:
            frame = await grabbed(camera, RealClock())
            seen = frame.image.copy()
            await grabbed(camera, RealClock())
    assert frame.seq >= 7
    np.testing.assert_array_equal(frame.image, seen)


async def test_a_measurement_counts_what_came():
    with open_log(LogConfig(), io.StringIO()) as log:
        async with source(FakeCamera(period_s=0.02), log) as camera:
            found = await measure(camera, RealClock(), 0.5)
    assert (found.width_px, found.height_px, found.time_of) == (64, 48, "exposure")
    assert 2 <= found.frames <= 27
    assert found.interval_ms_longest >= found.interval_ms_median >= 15
    assert found.age_ms_longest >= found.age_ms_median > 0


def test_a_picture_of_a_recording_through_the_command_line(tmp_path, capsys):
    cv2.imwrite(str(tmp_path / "0.png"), np.full((24, 32), 77, np.uint8))
    out = tmp_path / "out.png"
    assert main(["cameras", "--grab", f"file:{tmp_path}", "-o", str(out)]) == 0
    assert capsys.readouterr().out == f"{out}: 32 x 24 px, mean grey 77\n"
    assert cv2.imread(str(out), cv2.IMREAD_GRAYSCALE).shape == (24, 32)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--grab", "/dev/no-such-camera"], "/dev/no-such-camera: no such camera; `companion cameras` lists"),
        (["--grab", "/dev/null"], "/dev/null: not a video device"),
        (["--grab", "here"], "url: found 'here'; allowed: SCHEME:WHERE"),
        (["--grab", "file:x", "--size", "4"], "--size: found '4'; allowed: WIDTHxHEIGHT"),
        (
            ["--grab", "file:x", "--format", "H264"],
            "pixel_format: found 'H264'; allowed: Input should be 'auto'",
        ),
        (["--measure", "file:x", "--seconds", "nan"], "--seconds: found nan"),
    ],
)
def test_what_cannot_be_done_is_one_clear_line(words, message, capsys):
    assert main(["cameras", *words]) == 1
    said = capsys.readouterr().err
    assert message in said
    assert said.count("\n") == 1

"""The Raspberry Pi camera, with a stand-in for its library, which only exists on that board."""

import sys
import time
from concurrent.futures import TimeoutError as FutureTimeoutError
from types import SimpleNamespace

import numpy as np
import pytest

from companion.config import SourceConfig
from companion.errors import SourceError
from companion.frames.capture import CaptureError, DamagedImageError
from companion.frames.open import capture_opener


class FakeRequest:
    def __init__(self, camera) -> None:
        self.camera = camera

    def make_buffer(self, name: str) -> np.ndarray:
        assert name == "main"
        width_px, height_px = self.camera.main["size"]
        data = np.full((height_px * 3 // 2, self.camera.main["stride"]), 255, np.uint8)
        data[:height_px, :width_px] = 99
        return data.ravel()[: self.camera.deliver_bytes]

    def get_metadata(self) -> dict:
        return {"SensorTimestamp": time.clock_gettime_ns(time.CLOCK_BOOTTIME), "ExposureTime": 8000}

    def release(self) -> None:
        self.camera.released += 1


class FakePicamera2:
    last: "FakePicamera2"
    failure: BaseException | None = None

    @staticmethod
    def global_camera_info() -> list[dict]:
        return [{"Model": "imx708", "Num": 0}]

    def __init__(self, number: int) -> None:
        FakePicamera2.last = self
        self.released = 0
        self.state = "open"
        self.deliver_bytes: int | None = None
        if isinstance(self.failure, RuntimeError) and "use" in str(self.failure):
            raise self.failure

    def create_video_configuration(self, main, controls, buffer_count, queue) -> dict:
        assert (main["format"], queue) == ("YUV420", False)
        self.controls = controls
        return {"main": {**main, "stride": -(-main["size"][0] // 64) * 64}}

    def configure(self, configuration) -> None:
        self.main = configuration["main"]

    def camera_configuration(self) -> dict:
        return {"main": self.main}

    def start(self) -> None:
        self.state = "started"

    def capture_request(self, wait: float):
        if self.failure is not None:
            raise self.failure
        return FakeRequest(self)

    def stop(self) -> None:
        self.state = "stopped"

    def close(self) -> None:
        assert self.state == "stopped"
        self.state = "closed"


@pytest.fixture
def library(monkeypatch):
    monkeypatch.setitem(sys.modules, "picamera2", SimpleNamespace(Picamera2=FakePicamera2))
    monkeypatch.setattr(FakePicamera2, "failure", None)
    return FakePicamera2


def test_the_grey_plane_and_the_sensors_time_in_our_clock(library):
    config = SourceConfig(
        url="picamera2:0", width_px=320, height_px=240, rate_hz=50.0, controls="ExposureTime=8000, AnalogueGain=2.5, AeEnable=false"
    )  # fmt: skip
    capture = capture_opener(config)()
    before_ns = time.monotonic_ns()
    captured = capture.read(1.0)
    assert captured is not None
    np.testing.assert_array_equal(captured.image, np.full((240, 320), 99, np.uint8))
    assert before_ns - 1_000_000 <= captured.time_ns <= time.monotonic_ns() + 1_000_000
    assert library.last.controls == {
        "ExposureTime": 8000,
        "AnalogueGain": 2.5,
        "AeEnable": False,
        "FrameDurationLimits": (20000, 20000),
    }
    assert library.last.released == 1
    capture.close()
    assert library.last.state == "closed"


@pytest.mark.parametrize("error", [FutureTimeoutError(), TimeoutError()])
def test_no_frame_within_the_time_is_none(library, monkeypatch, error):
    capture = capture_opener(SourceConfig(url="picamera2:0"))()
    monkeypatch.setattr(FakePicamera2, "failure", error)
    assert capture.read(0.01) is None


def test_failures_are_told_apart(library, monkeypatch):
    capture = capture_opener(SourceConfig(url="picamera2:0"))()
    library.last.deliver_bytes = 1000
    with pytest.raises(DamagedImageError, match="1000 of 307200 bytes"):
        capture.read(1.0)
    assert library.last.released == 1
    monkeypatch.setattr(FakePicamera2, "failure", RuntimeError("camera frontend has timed out"))
    with pytest.raises(CaptureError, match="frontend has timed out"):
        capture.read(1.0)
    monkeypatch.setattr(FakePicamera2, "failure", RuntimeError("in use"))
    with pytest.raises(SourceError, match="cannot be opened: in use"):
        capture_opener(SourceConfig(url="picamera2:0"))()


def test_what_is_missing_is_said(library, monkeypatch):
    with pytest.raises(SourceError, match="picamera2:3: no such camera; found 1: imx708"):
        capture_opener(SourceConfig(url="picamera2:3"))()
    with pytest.raises(
        SourceError, match="control ExposureTime: found 'long'; allowed: a number, true or false"
    ):
        capture_opener(SourceConfig(url="picamera2:0", controls="ExposureTime=long"))()
    monkeypatch.setitem(sys.modules, "picamera2", None)
    with pytest.raises(SourceError, match="apt install python3-picamera2"):
        capture_opener(SourceConfig(url="picamera2:0"))

import os
import sys
from pathlib import Path

import numpy as np
import pytest

from companion.config import SourceConfig
from companion.errors import SourceError
from companion.frames.capture import CaptureError
from companion.frames.gstreamer import gstreamer_command
from companion.frames.open import capture_opener

STAND_IN = f"""#!{sys.executable}
import sys, time
words = sys.argv[1:]
caps = dict(part.split("=") for word in words for part in word.split(",") if "=" in part and word.startswith("video/x-raw"))
width, height = int(caps["width"]), int(caps["height"])
line = -(-width // 4) * 4
if "broken" in words:
    print("WARNING: a beginning", file=sys.stderr)
    print("ERROR: from element /GstPipeline: no such device", file=sys.stderr)
    sys.exit(1)
for number in range(10_000):
    row = bytes([number % 256]) * width + bytes([255]) * (line - width)
    sys.stdout.buffer.write(row * height)
    sys.stdout.buffer.flush()
    if "once" in words:
        time.sleep(30)
"""


@pytest.fixture
def stand_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A program called gst-launch-1.0 that writes frames as GStreamer does."""
    program = tmp_path / "gst-launch-1.0"
    program.write_text(STAND_IN)
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    return program


def opened(pipeline: str, width_px: int = 62, height_px: int = 48):
    return capture_opener(SourceConfig(url=f"gst:{pipeline}", width_px=width_px, height_px=height_px))()


def test_frames_come_without_the_padding_of_their_rows(stand_in):
    capture = opened("videotestsrc")
    try:
        for number in range(5):
            captured = capture.read(20.0)
            assert captured is not None
            assert captured.time_ns is None
            np.testing.assert_array_equal(captured.image, np.full((48, 62), number, np.uint8))
    finally:
        capture.close()


def test_nothing_within_the_time_is_none_and_an_unfinished_frame_is_kept(stand_in):
    capture = opened("once")
    try:
        assert capture.read(20.0) is not None
        assert capture.read(0.05) is None
    finally:
        capture.close()


def test_a_pipeline_that_fails_says_why(stand_in):
    capture = opened("broken")
    try:
        with pytest.raises(CaptureError, match="has ended: ERROR: from element /GstPipeline: no such device"):
            capture.read(20.0)
    finally:
        capture.close()


def test_the_command_keeps_one_frame_and_lets_a_newer_one_replace_it(stand_in):
    command = gstreamer_command("v4l2src device='/dev/a b' ! x", 640, 480)
    assert command[0] == str(stand_in)
    assert command[2:5] == ["v4l2src", "device=/dev/a b", "!"]
    assert "video/x-raw,format=GRAY8,width=640,height=480" in command
    assert command[command.index("queue") + 1 : command.index("queue") + 3] == [
        "leaky=downstream",
        "max-size-buffers=1",
    ]


def test_what_is_missing_is_said(tmp_path, monkeypatch, stand_in):
    with pytest.raises(SourceError, match=r"needs source\.width_px"):
        gstreamer_command("videotestsrc", 0, 0)
    with pytest.raises(SourceError, match="cannot be read: No closing quotation"):
        gstreamer_command("videotestsrc 'a", 64, 48)
    monkeypatch.setenv("PATH", str(tmp_path / "empty"))
    with pytest.raises(SourceError, match=r"not installed: apt install gstreamer1\.0-tools"):
        gstreamer_command("videotestsrc", 64, 48)

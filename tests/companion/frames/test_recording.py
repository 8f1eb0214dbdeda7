import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from companion.errors import SourceError
from companion.frames.recording import natural_key, open_recording

MS = 1_000_000


def write_image(path: Path, value: int, shape=(24, 32)) -> None:
    assert cv2.imwrite(str(path), np.full(shape, value, np.uint8))


def write_video(path: Path, frames: int = 10, codec: str = "MJPG", size=(64, 48)) -> None:
    video = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*codec), 20, size)
    for i in range(frames):
        video.write(np.full((size[1], size[0], 3), 20 * i, np.uint8))
    video.release()


def played(recording) -> list[tuple[int, int]]:
    """(offset in ms, mean grey) of each image."""
    images = []
    while (item := recording.read()) is not None:
        assert item.image.dtype == np.uint8
        assert item.image.ndim == 2
        images.append((round(item.offset_ns / MS), round(float(item.image.mean()))))
    return images


def test_images_come_in_natural_order_at_the_given_rate(tmp_path: Path):
    for value, name in ((30, "f10.png"), (10, "f1.png"), (20, "f2.PGM")):
        write_image(tmp_path / name, value)
    (tmp_path / "notes.txt").write_text("not an image")
    recording = open_recording(tmp_path, fps_hz=10)
    assert played(recording) == [(0, 10), (100, 20), (200, 30)]
    recording.rewind()
    assert played(recording)[0] == (0, 10)


def test_natural_order_mixes_numbers_and_words():
    names = ["a", "a10", "a2", "2", "10", "b1", "1a"]
    assert sorted(names, key=natural_key) == ["1a", "2", "10", "a", "a2", "a10", "b1"]


def test_timestamps_decide_which_images_and_when(tmp_path: Path):
    for value, name in ((10, "a.png"), (20, "b.png"), (30, "c.png")):
        write_image(tmp_path / name, value)
    (tmp_path / "timestamps.csv").write_text("time_s,file\n1700000000.5,c.png\n1700000000.75,a.png\n")
    recording = open_recording(tmp_path, fps_hz=10)
    assert played(recording) == [(0, 30), (250, 10)]
    assert recording.interval_ns == 250 * MS


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ("", "line 1: found columns nothing; needed: file, time_s"),
        ("name,time\n", "line 1: found columns name, time; needed: file, time_s"),
        ("file,time_s\n", "lists no images"),
        ("file,time_s\na.png,soon\n", "line 2: found time_s 'soon'; allowed: a number"),
        ("file,time_s\na.png,nan\n", "line 2: found time_s 'nan'; allowed: a number"),
        ("file,time_s\na.png\n", "line 2: found time_s None; allowed: a number"),
        ("file,time_s\na.png,2\nb.png,2\n", "line 3: time_s 2.0 does not come after 2.0"),
        ("file,time_s\n../a.png,2\n", "allowed: a name inside this folder"),
        ("file,time_s\nzzz.png,2\n", "none of the 1 listed images exists"),
        ('file,time_s\n"a.png,2\n', "cannot be read"),
    ],
)
def test_a_table_of_times_that_cannot_be_used_is_explained(tmp_path: Path, table: str, message: str):
    write_image(tmp_path / "a.png", 1)
    write_image(tmp_path / "b.png", 1)
    (tmp_path / "timestamps.csv").write_text(table)
    with pytest.raises(SourceError) as caught:
        open_recording(tmp_path, fps_hz=10)
    assert message in str(caught.value)
    assert str(tmp_path / "timestamps.csv") in str(caught.value)


def test_an_image_that_cannot_be_decoded_is_there_without_pixels(tmp_path: Path):
    write_image(tmp_path / "1.png", 1)
    (tmp_path / "2.png").write_bytes(b"not a png")
    (tmp_path / "3.png").write_bytes(b"")
    recording = open_recording(tmp_path, fps_hz=10)
    assert [item.image is None for item in (recording.read(), recording.read(), recording.read())] == [
        False,
        True,
        True,
    ]
    assert recording.read() is None


def test_skipping_stops_at_the_newest_image_that_is_due(tmp_path: Path):
    for i in range(5):
        write_image(tmp_path / f"{i}.png", i)
    recording = open_recording(tmp_path, fps_hz=10)
    assert recording.skip_until(250 * MS) == 2
    assert recording.next_offset_ns() == 200 * MS
    assert recording.skip_until(250 * MS) == 0
    assert recording.skip_until(10_000 * MS) == 2
    assert [offset for offset, _ in played(recording)] == [400]


@pytest.mark.parametrize(("name", "codec"), [("a.avi", "MJPG"), ("a.mp4", "mp4v")])
def test_a_video_plays_at_its_own_rate_in_grey(tmp_path: Path, name: str, codec: str):
    write_video(tmp_path / name, codec=codec)
    recording = open_recording(tmp_path / name, fps_hz=1)
    images = played(recording)
    assert [offset for offset, _ in images] == [50 * i for i in range(10)]
    assert [grey for _, grey in images] == pytest.approx([20 * i for i in range(10)], abs=3)
    assert recording.missing == 0
    recording.rewind()
    assert recording.skip_until(420 * MS) == 8
    assert recording.read().offset_ns == pytest.approx(400 * MS)
    recording.close()


def test_a_video_cut_off_reports_what_is_missing(tmp_path: Path):
    whole, cut = tmp_path / "a.avi", tmp_path / "cut.avi"
    rng = np.random.default_rng(1)
    video = cv2.VideoWriter(str(whole), cv2.VideoWriter_fourcc(*"MJPG"), 20, (320, 240))
    for _ in range(40):
        video.write(rng.integers(0, 255, (240, 320, 3), dtype=np.uint8))
    video.release()
    cut.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    recording = open_recording(cut, fps_hz=1)
    images = played(recording)
    assert 5 <= len(images) < 30
    assert recording.missing == 40 - len(images)
    recording.close()


@pytest.mark.parametrize("content", [b"", b"garbage" * 1000, b"RIFF\x00\x01\x00\x00AVI LIST"])
def test_a_file_that_is_no_video_is_a_clear_error(tmp_path: Path, content: bytes):
    (tmp_path / "x.avi").write_bytes(content)
    with pytest.raises(SourceError, match=r"x\.avi: not a video that OpenCV can decode"):
        open_recording(tmp_path / "x.avi", fps_hz=10)


def test_paths_that_hold_nothing_are_clear_errors(tmp_path: Path):
    with pytest.raises(SourceError, match=r"gone: no such file or folder"):
        open_recording(tmp_path / "gone", fps_hz=10)
    with pytest.raises(SourceError, match="no images in this folder"):
        open_recording(tmp_path, fps_hz=10)
    with pytest.raises(SourceError, match="neither a video file nor a folder"):
        open_recording(Path("/dev/null"), fps_hz=10)
    with pytest.raises(SourceError, match=r"cannot be read|no such file"):
        open_recording(Path("a\0b"), fps_hz=10)


def test_a_pipe_where_an_image_should_be_is_an_image_that_cannot_be_read(tmp_path):
    os.mkfifo(tmp_path / "pipe.png")
    cv2.imwrite(str(tmp_path / "real.png"), np.full((24, 32), 9, np.uint8))
    (tmp_path / "timestamps.csv").write_text("file,time_s\npipe.png,0\nreal.png,1\n")
    recording = open_recording(tmp_path, 10.0)
    first, second = recording.read(), recording.read()
    assert first is not None
    assert first.image is None
    assert second is not None
    assert second.image is not None

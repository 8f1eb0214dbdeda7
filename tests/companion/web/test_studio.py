from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from companion.config import Config
from companion.errors import CompanionError, SourceError
from companion.sim.footage import OFFICE_WALK
from companion.web.clips import open_clip
from companion.web.studio import MOST_COMPARED, Studio, list_recordings
from tests.companion.web.showcase import FIRST

RECORDED_FLIGHT = Path(__file__).parents[2] / "data" / "recordings" / "detections.mcap"


def noise(number: int, size: tuple[int, int] = (64, 48)) -> np.ndarray:
    return np.random.default_rng(number).integers(0, 255, (size[1], size[0]), np.uint8)


def make_folder(folder: Path, count: int = 4) -> Path:
    folder.mkdir(parents=True)
    for number in range(count):
        cv2.imwrite(str(folder / f"{number}.png"), noise(number))
    return folder


def make_video(path: Path, count: int = 12) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 20.0, (64, 48), isColor=False)
    for number in range(count):
        writer.write(np.full((48, 64), 10 * number, np.uint8))
    writer.release()
    return path


@asynccontextmanager
async def studio_on(root: Path | None, why_not: Callable[[], str] = lambda: "") -> AsyncIterator[Studio]:
    tables: dict[str, Any] = json.loads(Config().model_dump_json())
    studio = Studio(root, lambda: tables, why_not)
    try:
        yield studio
    finally:
        await studio.close()


async def finished(studio: Studio, number: int) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    async with asyncio.timeout(90.0):
        while True:
            answer = studio.comparison(number, len(rows))
            assert not answer["error"], answer["error"]
            rows += answer["rows"]
            if answer["done"]:
                return rows
            await asyncio.sleep(0.05)


def test_recordings_are_found_two_folders_deep_and_none_outside(tmp_path: Path) -> None:
    root = tmp_path / "recordings"
    make_folder(root / "walk")
    make_folder(root / "monday" / "hall")
    make_video(root / "monday" / "door.avi")
    secret = make_folder(tmp_path / "secret")
    (root / "link").symlink_to(secret)
    (root / "monday" / "up").symlink_to(tmp_path)
    (root / ".hidden.avi").write_bytes(b"x")
    (root / "notes.txt").write_text("x")
    found = {one.name: one.kind for one in list_recordings(root)}
    assert found == {"walk": "images", "monday/hall": "images", "monday/door.avi": "video"}
    assert [one.name for one in list_recordings(root / "walk")] == ["walk"]
    assert list_recordings(tmp_path / "nothing") == []
    assert list_recordings(None) == []


def test_any_picture_of_a_video_can_be_asked_for_in_any_order(tmp_path: Path) -> None:
    clip = open_clip(make_video(tmp_path / "door.avi"))
    assert len(clip.times_ns) == 12
    assert clip.times_ns[1] == 50_000_000
    for number in (0, 5, 4, 11, 11, 0, 7):
        image = clip.picture(number)
        assert image is not None
        assert abs(float(image.mean()) - 10 * number) < 3
    clip.close()


def test_a_recorded_flight_has_pictures_and_poses(tmp_path: Path) -> None:
    clip = open_clip(RECORDED_FLIGHT)
    assert len(clip.times_ns) > 5
    assert clip.times_ns == sorted(clip.times_ns)
    assert clip.has_poses
    last = len(clip.times_ns) - 1
    images = [clip.picture(number) for number in (last, 0, last)]
    assert all(image is not None and image.ndim == 2 for image in images)
    assert np.array_equal(images[0], images[2])
    assert not np.array_equal(images[0], images[1])
    pose = clip.pose(last)
    assert pose is not None
    assert np.linalg.norm(pose.q_ned_from_body) == pytest.approx(1.0)
    cut = tmp_path / "cut.mcap"
    data = RECORDED_FLIGHT.read_bytes()
    cut.write_bytes(data[:-60])  # no footer, and so no index
    rest = open_clip(cut)
    assert rest.times_ns == clip.times_ns
    assert np.array_equal(rest.picture(last), images[0])
    cut.write_bytes(data[:2000])
    with pytest.raises(SourceError, match=r"cut\.mcap: there are no pictures"):
        open_clip(cut)
    other = tmp_path / "other.mcap"
    other.write_bytes(b"no recording")
    with pytest.raises(SourceError, match=r"other\.mcap"):
        open_clip(other)


async def test_a_recording_is_opened_and_scrubbed() -> None:
    async with studio_on(OFFICE_WALK) as studio:
        (one,) = await studio.recordings()
        about = await studio.about(one["id"])
        assert (about["pictures"], about["width_px"], about["has_poses"]) == (220, 540, True)
        for number in (100, 3, 219):
            jpeg = await studio.picture(one["id"], number)
            assert cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_GRAYSCALE).shape == (360, 540)
        with pytest.raises(SourceError, match="allowed: 0 to 219"):
            await studio.picture(one["id"], 220)
        for wrong in ("office_walk", "../office_walk", "", "/etc"):
            with pytest.raises(SourceError, match="no such recording"):
                await studio.about(wrong)


async def test_two_settings_look_at_the_same_pictures() -> None:
    async with studio_on(OFFICE_WALK) as studio:
        (one,) = await studio.recordings()
        settings: list[dict[str, Any]] = [{"detector.method": "parallax"}, {"detector.method": "paper"}]
        begun = await studio.compare(one["id"], FIRST, FIRST + 5, settings)
        rows = await finished(studio, begun["number"])
        assert [row["number"] for row in rows] == list(range(FIRST, FIRST + 6))
        methods = {tuple(lane["details"]["method"] for lane in row["lanes"]) for row in rows}
        assert methods == {("parallax", "paper")}
        assert rows[0]["lanes"][0]["detection"]["reason"] == "no_earlier_frame"
        last = rows[-1]["lanes"]
        assert last[0]["details"]["samples"]
        assert last[1]["details"]["flow"]
        assert all(lane["detection"]["detector_s"] > 0 for lane in last)
        # A picture can be asked for meanwhile, and another comparison takes this one's place.
        again = await studio.compare(one["id"], 0, 200, settings)
        assert len(await studio.picture(one["id"], 7)) > 1000
        await studio.end_comparison(again["number"])
        with pytest.raises(SourceError, match="no such comparison"):
            studio.comparison(again["number"], 0)


async def test_nothing_is_compared_while_setpoints_are_protected() -> None:
    state = ["not while setpoints are protected (STEER)"]
    async with studio_on(OFFICE_WALK, lambda: state[0]) as studio:
        (one,) = await studio.recordings()
        with pytest.raises(SourceError, match=r"protected \(STEER\)"):
            await studio.compare(one["id"], 0, 9, [{}, {"detector.method": "paper"}])
        state[0] = ""
        begun = await studio.compare(one["id"], 0, 150, [{}, {"detector.method": "paper"}])
        state[0] = "not while setpoints are protected (HOLD)"
        with pytest.raises(AssertionError, match="HOLD"):
            await finished(studio, begun["number"])


async def test_what_cannot_be_compared_is_said() -> None:
    async with studio_on(OFFICE_WALK) as studio:
        (one,) = await studio.recordings()
        for settings, words in (
            ({"guidance.agree_deg": 9.0}, "only settings of the detector and the camera"),
            ({"detector.baseline_m": -1.0}, "detector.baseline_m: found -1"),
            ({"camera.file": "/nothing/there.toml"}, "camera.file"),
        ):
            with pytest.raises(CompanionError, match=words):
                await studio.compare(one["id"], 0, 9, [{}, settings])
        with pytest.raises(SourceError, match="600 in one comparison"):
            await studio.compare(one["id"], 0, MOST_COMPARED, [{}, {}])
        with pytest.raises(SourceError, match="allowed: within 0 to 219"):
            await studio.compare(one["id"], 200, 230, [{}, {"detector.method": "paper"}])


async def test_a_damaged_recording_is_said_and_the_next_one_opens(tmp_path: Path) -> None:
    (tmp_path / "broken.mp4").write_bytes(b"not a video" * 100)
    make_folder(tmp_path / "good")
    async with studio_on(tmp_path) as studio:
        ids = {one["name"]: one["id"] for one in await studio.recordings()}
        with pytest.raises(SourceError, match=r"broken\.mp4: not a video"):
            await studio.about(ids["broken.mp4"])
        assert (await studio.about(ids["good"]))["pictures"] == 4

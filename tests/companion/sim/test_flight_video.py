from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from companion.errors import CompanionError
from companion.sim.camera_feed import render_at
from companion.sim.flight_record import FlightRecord
from companion.sim.flight_video import _FlightPictures, story_of, write_flight_animation, write_flight_video
from companion.sim.panda_camera import PandaCamera
from companion.sim.world.file import load_world
from companion.sim.world.model import World
from detector.camera_model import CameraModel

CAMERA = CameraModel.from_hfov(160, 120, 75.0)
NAN = math.nan


@pytest.fixture(scope="module")
def world() -> World:
    return load_world("corridor")


def a_flight(world: World, *, samples: int = 21, service: bool = True) -> FlightRecord:
    """Two seconds straight on from the start at 10 Hz, an answer in the middle."""
    start = np.array([world.start.north_m, world.start.east_m, -world.start.height_m])
    yaw = math.radians(world.start.yaw_deg)
    ahead = np.array([math.cos(yaw), math.sin(yaw), 0.0])
    time_s = 0.1 * np.arange(samples)
    position = start + 0.5 * time_s[:, None] * ahead
    planned = np.tile(start + 8.0 * ahead, (samples, 1))
    sent = planned.copy()
    sent[samples // 2 :] = position[samples // 2 :] + 1.0 * ahead
    planned[:2] = NAN
    return FlightRecord(
        time_s=time_s,
        position_ned_m=position,
        q_ned_from_body=np.tile([math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)], (samples, 1)),
        clearance_m=np.full(samples, 0.7),
        planned_ned_m=planned,
        sent_ned_m=sent,
        sent_yaw_rad=np.full(samples, NAN),
        answer_time_s=np.array([1.1, 1.6]),
        answer_frame_time_s=np.array([1.0, 1.5]),
        answer_kind=np.array(["lowest_flow", "none"]),
        answer_reason=np.array(["", "little texture"]),
        answer_px=np.array([[40.0, 60.0], [NAN, NAN]]),
        answer_distance_m=np.array([3.5, NAN]),
        state_time_s=np.array([0.0, 1.2]) if service else np.empty(0),
        state=np.array(["FOLLOW", "STEER"]) if service else np.array([], dtype=np.str_),
        state_reason=np.array(["clear", "void elsewhere"]) if service else np.array([], dtype=np.str_),
        setpoint_time_s=np.empty(0),
        setpoint_bytes=np.empty(0, np.uint8),
    )


def test_the_story_is_told_by_the_time_of_its_frames(world: World) -> None:
    story = story_of(a_flight(world))
    detection, state, setpoint = story.at(1_050_000_000)
    assert detection is not None
    assert detection[0] == 1_000_000_000
    assert detection[1] == {
        "kind": "lowest_flow", "reason": "", "x_px": 40.0, "y_px": 60.0, "distance_m": 3.5,
    }  # fmt: skip
    assert state == {"state": "FOLLOW", "reason": "clear"}
    assert setpoint is not None
    assert setpoint["action"] == "sent"
    assert setpoint["yaw_deg"] is None
    assert story.at(500_000_000)[2]["action"] == "forwarded"  # type: ignore[index]
    assert story.at(50_000_000)[2] is None  # nothing planned yet
    later = story.at(1_700_000_000)
    assert later[0] is not None
    assert "distance_m" not in later[0][1]
    assert later[1] == {"state": "STEER", "reason": "void elsewhere"}


def test_a_flight_without_the_service_says_so(world: World) -> None:
    assert story_of(a_flight(world, service=False)).at(0)[1] == {
        "state": "NO SERVICE",
        "reason": "the planner speaks to the autopilot",
    }


def test_a_video_shows_the_view_and_the_plan_at_each_time(world: World, tmp_path: Path) -> None:
    record = a_flight(world)
    path = tmp_path / "flight.mp4"
    assert write_flight_video(record, world, CAMERA, path) == str(path)
    video = cv2.VideoCapture(str(path))
    pictures = []
    while (read := video.read())[0]:
        pictures.append(read[1])
    assert len(pictures) == 21
    assert video.get(cv2.CAP_PROP_FPS) == 10.0
    assert pictures[0].shape[1] % 2 == 0
    # The camera's view, twice as high as 58 px from the top, is what was rendered at that pose.
    pictures_of = _FlightPictures(record, world, CAMERA)
    pose = pictures_of._pose(20)
    pictures_of.close()
    with PandaCamera(world) as eye:
        seen = cv2.resize(render_at(eye, CAMERA, pose), (640, 480)).astype(float)
    shown = cv2.cvtColor(pictures[20][58:538, :640], cv2.COLOR_BGR2GRAY).astype(float)
    assert np.median(np.abs(shown - seen)) < 4.0
    first = cv2.cvtColor(pictures[0][58:538, :640], cv2.COLOR_BGR2GRAY).astype(float)
    assert np.abs(first - shown).mean() > 2.0 * np.abs(shown - seen).mean()


def test_the_plan_has_the_way_so_far(world: World) -> None:
    record = a_flight(world)
    pictures = _FlightPictures(record, world, CAMERA)
    try:
        begin, end = (pictures.at(time_s)[:, 640:].astype(int) for time_s in (0.1, 2.0))
    finally:
        pictures.close()
    green = [(np.abs(image - (40, 130, 30)).max(axis=-1) < 12).sum() for image in (begin, end)]
    assert green[1] > green[0] + 20


@pytest.mark.parametrize("suffix", [".webp", ".gif", ".png"])
def test_an_animation_is_no_larger_than_asked_for(world: World, tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"flight{suffix}"
    size = write_flight_animation(
        a_flight(world), world, CAMERA, path, width_px=400, pictures=6, max_bytes=160_000
    )
    assert size == path.stat().st_size <= 160_000
    done, animation = cv2.imreadanimation(str(path))
    assert done
    assert len(animation.frames) == 6
    assert animation.frames[0].shape[1] <= 400
    assert np.abs(animation.frames[0].astype(int) - animation.frames[-1]).max() > 40


def test_what_cannot_be_written_is_one_clear_error(world: World, tmp_path: Path) -> None:
    record = a_flight(world, samples=3)
    with pytest.raises(CompanionError, match=r"allowed: \.webp, \.gif, \.png"):
        write_flight_animation(record, world, CAMERA, tmp_path / "flight.bmp")
    with pytest.raises(CompanionError, match="do not fit"):
        write_flight_animation(record, world, CAMERA, tmp_path / "flight.webp", width_px=260, max_bytes=100)
    with pytest.raises(CompanionError, match="cannot be written"):
        write_flight_animation(record, world, CAMERA, tmp_path / "none" / "flight.webp", width_px=260)
    with pytest.raises(CompanionError, match="cannot write the video"):
        write_flight_video(record, world, CAMERA, tmp_path / "none" / "flight.mp4")
    with pytest.raises(CompanionError, match="without samples"):
        write_flight_video(a_flight(world, samples=0), world, CAMERA, tmp_path / "flight.mp4")

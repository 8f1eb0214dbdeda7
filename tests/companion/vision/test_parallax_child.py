"""The worker's pipeline with the parallax method, on rendered scenes in which every distance is known."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.config import CameraConfig, DetectorConfig
from companion.frames.source import Frame
from companion.guidance.coordinates import quaternion_from_euler, r_body_from_camera, r_ned_from_body
from companion.guidance.observation import DetectionReport, Pose
from companion.sim.scene import Scene, corridor, square_wall
from companion.vision.child import build_pipeline
from companion.vision.messages import MAX_PACKET_BYTES, Answer, pack_from_worker, unpack_from_worker
from companion.vision.parallax_child import ParallaxPipeline, bearings_of
from detector.camera_model import CameraModel
from detector.parallax.void_map import VoidMap

HFOV_DEG = 70.0
CAMERA = CameraModel.from_hfov(640, 480, HFOV_DEG)
STEP_M, HEIGHT_M = 0.2, 1.3


def flown(scene: Scene, steps: int, *, turn_deg: float = 0.0) -> list[tuple[Frame, Pose]]:
    """What a vehicle sees that flies north, and turns by so much with each step."""
    frames = []
    for index in range(steps):
        level = quaternion_from_euler(0.0, 0.0, math.radians(index * turn_deg))
        looking = r_ned_from_body(level) @ r_body_from_camera(0.0, 0.0, 0.0)
        time_ns = 1_000_000_000 + index * 200_000_000
        image = scene.render(CAMERA, (index * STEP_M, 0.0, -HEIGHT_M), looking)
        frames.append((Frame(image, time_ns, index), Pose(time_ns, index * STEP_M, 0.0, -HEIGHT_M, level)))
    return frames


def reports_on(frames: list[tuple[Frame, Pose]], *, with_pose: bool = True) -> list[DetectionReport]:
    pipeline = build_pipeline(DetectorConfig(method="parallax"), CameraConfig(hfov_deg=HFOV_DEG))
    assert isinstance(pipeline, ParallaxPipeline)
    return [pipeline.detect(frame, pose if with_pose else None) for frame, pose in frames]


@pytest.fixture(scope="module")
def wall_reports() -> list[DetectionReport]:
    return reports_on(flown(square_wall(2.7), 5))


@pytest.fixture(scope="module")
def corridor_reports() -> list[DetectionReport]:
    return reports_on(flown(corridor(), 5))


def test_a_wall_ahead_is_a_single_plane_with_its_distance(wall_reports: list[DetectionReport]) -> None:
    assert (wall_reports[0].kind, wall_reports[0].reason) == ("none", "no_earlier_frame")
    planes = [report for report in wall_reports[1:] if report.kind == "single_plane"]
    assert len(planes) >= 3
    for report in planes:
        assert report.pose is not None
        assert report.distance_m == pytest.approx(2.7 - report.pose.north_m, rel=0.15)
        if report.time_to_contact_frames is None:
            continue
        # Frames are 0.2 s and steps 0.2 m apart: a metre a second.
        assert report.time_to_contact_s == pytest.approx(2.7 - report.pose.north_m, rel=0.2)
        assert report.time_to_contact_spread_s is not None
        assert 0.0 < report.time_to_contact_spread_s < 1.0
    assert any(report.time_to_contact_s is not None for report in planes)


def test_bearings_measure_what_is_there(wall_reports: list[DetectionReport]) -> None:
    report = wall_reports[-1]
    assert report.pose is not None
    scene = square_wall(2.7)
    position = (report.pose.north_m, report.pose.east_m, report.pose.down_m)
    shares = [
        bearing.distance_m
        / scene.range_along(position, (math.cos(bearing.azimuth_rad), math.sin(bearing.azimuth_rad), 0.0))
        for bearing in report.bearings
    ]
    assert len(shares) >= 10
    assert max(shares) < 1.15
    assert (
        np.median(shares) > 0.75
    )  # about the focus of expansion noise reads near; the surest, at the edges, are not looked through to 2 m
    assert report.obstacles, "the wall is near"
    for north_m, _ in report.obstacles:
        assert north_m == pytest.approx(2.7, abs=0.5)


def test_the_way_along_a_corridor_is_a_gap_and_grows_surer(corridor_reports: list[DetectionReport]) -> None:
    gaps = [report for report in corridor_reports if report.kind == "gap"]
    assert len(gaps) >= 3
    for report in gaps:
        assert report.ray_body is not None
        assert report.ray_body[0] > math.cos(math.radians(8.0))
        assert report.confidence is not None
        assert 0.0 <= report.confidence <= 1.0
        assert report.distance_m is not None
        assert report.distance_m > 3.0
    first, last = gaps[0].confidence, gaps[-1].confidence
    assert first is not None
    assert last is not None
    assert last > first


def test_what_has_left_the_view_is_remembered() -> None:
    last = reports_on(flown(corridor(), 5, turn_deg=8.0))[-1]
    seen = {bearing.azimuth_rad for bearing in last.bearings}
    remembered = {bearing.azimuth_rad for bearing in last.remembered}
    assert seen
    assert remembered
    assert not seen & remembered
    assert min(remembered) < min(seen), "the left side has left the view of a vehicle that turned right"


def test_without_poses_nothing_is_known_in_metres() -> None:
    for report in reports_on(flown(corridor(), 4), with_pose=False):
        assert report.bearings == ()
        assert report.remembered == ()
        assert report.distance_m is None


def test_a_report_with_its_map_crosses_the_socket(corridor_reports: list[DetectionReport]) -> None:
    packet = pack_from_worker(Answer(7, corridor_reports[-1]))
    assert len(packet) < MAX_PACKET_BYTES
    answer = unpack_from_worker(packet)
    assert isinstance(answer, Answer)
    assert answer.report == corridor_reports[-1]


def test_a_bearing_tells_the_least_of_its_three_degrees_and_nothing_where_one_is_unknown() -> None:
    empty = VoidMap.unknown()
    known, free = empty.known.copy(), empty.free_m.copy()
    known[:10] = True
    free[:10] = 5.0
    free[7] = 2.0
    found = VoidMap(empty.azimuth_rad, free, np.where(known, 9, 0), np.where(known, 0.1, np.inf), known)
    told = {round(math.degrees(b.azimuth_rad)): b for b in bearings_of(found, known, 0.4)}
    assert sorted(told) == [3, 6], "about 0 and 9 a bin is unknown"
    assert told[3].distance_m == pytest.approx(5.4)
    assert told[6].distance_m == pytest.approx(2.4)

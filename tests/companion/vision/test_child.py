"""The worker's pipeline with the real detector, on rendered scenes in which every distance is known."""

import asyncio
import io
import math
import time
from pathlib import Path

import numpy as np
import pytest

from companion.clock import RealClock
from companion.config import CameraConfig, DetectorConfig, LogConfig
from companion.errors import ConfigError
from companion.frames.source import Frame
from companion.guidance.coordinates import quaternion_from_euler, r_body_from_camera, r_ned_from_body
from companion.guidance.observation import DetectionReport, Pose
from companion.log import open_log
from companion.sim.scene import Scene, corridor, square_wall
from companion.vision.child import build_pipeline, level_rays, obstacles_seen, plane_range_m
from companion.vision.supervisor import VisionSupervisor
from detector.camera_model import CameraModel
from detector.observer import Observation
from detector.results import Diagnostics, SinglePlane, TimeToContact

HFOV_DEG = 70.0
CAMERA = CameraModel.from_hfov(640, 480, HFOV_DEG)
STEP_M = 0.25
HEIGHT_M = 1.3


def looking(yaw_deg: float = 0.0, pitch_deg: float = 0.0, roll_deg: float = 0.0) -> np.ndarray:
    """r_ned_from_camera of a camera turned like this."""
    q = quaternion_from_euler(*(math.radians(angle) for angle in (roll_deg, pitch_deg, yaw_deg)))
    return r_ned_from_body(q) @ r_body_from_camera(0.0, 0.0, 0.0)


def flight_north(scene: Scene, steps: int, *, heading_deg: float = 0.0) -> list[tuple[Frame, Pose]]:
    """What a camera that looks north sees on a vehicle that flies north with the given heading."""
    q = quaternion_from_euler(0.0, 0.0, math.radians(heading_deg))
    flown = []
    for i in range(steps):
        time_ns = 1_000_000_000 + i * 200_000_000
        image = scene.render(CAMERA, (i * STEP_M, 0.0, -HEIGHT_M), looking())
        flown.append((Frame(image, time_ns, i), Pose(time_ns, i * STEP_M, 0.0, -HEIGHT_M, q)))
    return flown


def reports_on(
    flown: list[tuple[Frame, Pose]], camera: CameraConfig, *, with_pose: bool = True
) -> list[DetectionReport]:
    pipeline = build_pipeline(DetectorConfig(method="paper"), camera)
    return [pipeline.detect(frame, pose if with_pose else None) for frame, pose in flown]


@pytest.fixture(scope="module")
def wall_flight():
    return flight_north(square_wall(4.0), 5)


@pytest.fixture(scope="module")
def corridor_flight():
    return flight_north(corridor(), 4)


@pytest.fixture(scope="module")
def wall_reports(wall_flight):
    return reports_on(wall_flight, CameraConfig(hfov_deg=HFOV_DEG))


@pytest.fixture(scope="module")
def corridor_reports(corridor_flight):
    return reports_on(corridor_flight, CameraConfig(hfov_deg=HFOV_DEG))


def azimuths_deg(r_ned_from_camera: np.ndarray) -> list[float]:
    return [math.degrees(azimuth_rad) for azimuth_rad, _ in level_rays(CAMERA, r_ned_from_camera)]


def test_level_rays_cover_the_field_of_view_every_three_degrees():
    assert azimuths_deg(looking()) == pytest.approx(range(-33, 34, 3))
    assert azimuths_deg(looking(yaw_deg=100)) == pytest.approx(range(67, 134, 3))


def test_level_rays_wrap_at_south():
    found = azimuths_deg(looking(yaw_deg=180))
    assert all(-180 < azimuth_deg <= 180 for azimuth_deg in found)
    assert len(found) == 23


@pytest.mark.parametrize("pitch_deg", [-20.0, 15.0])
@pytest.mark.parametrize("roll_deg", [0.0, 25.0])
def test_level_rays_are_level_and_in_the_image_however_it_is_tilted(pitch_deg: float, roll_deg: float):
    r_ned_from_camera = looking(30.0, pitch_deg, roll_deg)
    found = level_rays(CAMERA, r_ned_from_camera)
    assert len(found) > 10
    for azimuth_rad, ray in found:
        north, east, down = r_ned_from_camera @ ray
        assert down == pytest.approx(0.0, abs=1e-12)
        assert math.atan2(east, north) == pytest.approx(azimuth_rad)
        x_px, y_px = CAMERA.ray_to_pixel([ray])[0]
        assert 0 <= x_px <= 639
        assert 0 <= y_px <= 479


def test_a_camera_that_does_not_see_the_horizon_has_no_level_rays():
    assert level_rays(CAMERA, looking(pitch_deg=-60)) == []
    assert level_rays(CAMERA, looking(pitch_deg=-90)) == []


def test_a_wall_ahead_is_a_single_plane_with_its_distance(wall_reports):
    assert (wall_reports[0].kind, wall_reports[0].reason) == ("none", "no_earlier_frame")
    planes = [report for report in wall_reports[1:] if report.kind == "single_plane"]
    assert len(planes) >= 3
    for report in planes:
        assert report.baseline_m >= STEP_M * 0.99
        assert report.distance_m == pytest.approx(4.0 - report.pose.north_m, rel=0.1)
        assert report.distance_spread_m < 1.0
        assert report.ray_body is None


def test_a_planes_distance_counts_the_step_along_the_axis_only():
    contact = TimeToContact(frames=10.0, spread_frames=0.5, samples=99)
    plane = SinglePlane(contact, Diagnostics())
    ahead_px = (CAMERA.cx_px, CAMERA.cy_px)
    aside_px = tuple(CAMERA.ray_to_pixel([(math.tan(math.radians(30)), 0.0, 1.0)])[0])
    for focus_px, expected_m in ((ahead_px, 2.0), (None, 2.0), (aside_px, 2.0 * math.cos(math.radians(30)))):
        seen = Observation(plane, 5, 4, baseline_m=0.2, focus_px=focus_px)
        distance_m, spread_m = plane_range_m(seen, contact, CAMERA)
        assert distance_m == pytest.approx(expected_m)
        assert spread_m == pytest.approx(expected_m / 20)
    assert plane_range_m(Observation(plane, 5, 4), contact, CAMERA) == (None, None)
    assert plane_range_m(Observation(plane, 5, 4, baseline_m=0.2), None, CAMERA) == (None, None)
    receding = TimeToContact(frames=-10.0, spread_frames=0.5, samples=99)
    assert plane_range_m(Observation(plane, 5, 4, baseline_m=0.2), receding, CAMERA) == (None, None)


def test_bearings_measure_what_is_there(wall_reports):
    report = wall_reports[-1]
    scene = square_wall(4.0)
    position = (report.pose.north_m, report.pose.east_m, report.pose.down_m)
    shares = [
        bearing.distance_m
        / scene.range_along(position, (math.cos(bearing.azimuth_rad), math.sin(bearing.azimuth_rad), 0.0))
        for bearing in report.bearings
    ]
    assert len(shares) >= 10
    assert max(shares) < 1.1  # never further than it is: what is said to be free is flown through
    assert np.median(shares) > 0.7
    assert all(bearing.samples > 0 for bearing in report.bearings)


def test_the_way_along_a_corridor_is_found_in_the_bodys_terms(corridor_reports):
    directions = [report for report in corridor_reports if report.kind in ("vanishing_point", "lowest_flow")]
    assert len(directions) >= 3
    for report in directions:
        assert np.linalg.norm(report.ray_body) == pytest.approx(1.0)
        assert report.ray_body[0] > math.cos(math.radians(25))  # as rough as a cluster of vectors is wide
        expected = CAMERA.pixel_to_ray([(report.x_px, report.y_px)])[0]
        np.testing.assert_allclose(report.ray_body, (expected[2], expected[0], expected[1]), atol=1e-9)


def test_the_mounting_turns_the_ray_and_not_the_bearings(corridor_reports):
    # The same view from a vehicle that heads west, its camera mounted to look to the right.
    sideways = reports_on(
        flight_north(corridor(), 4, heading_deg=-90.0), CameraConfig(hfov_deg=HFOV_DEG, mount_yaw_deg=90.0)
    )
    for one, other in zip(corridor_reports, sideways, strict=True):
        assert one.kind == other.kind
        if one.ray_body is not None:
            forward, right, down = one.ray_body
            np.testing.assert_allclose(other.ray_body, (-right, forward, down), atol=1e-6)
        assert [b.azimuth_rad for b in one.bearings] == pytest.approx([b.azimuth_rad for b in other.bearings])
        assert [b.distance_m for b in one.bearings] == pytest.approx(
            [b.distance_m for b in other.bearings], rel=1e-3
        )


def test_without_poses_nothing_is_known_in_metres(wall_flight):
    for report in reports_on(wall_flight[:3], CameraConfig(hfov_deg=HFOV_DEG), with_pose=False):
        assert report.pose is None
        assert report.baseline_m is None
        assert report.distance_m is None
        assert report.bearings == ()


def test_the_same_frames_give_the_same_reports(corridor_flight, corridor_reports):
    def told(reports):
        return [(r.kind, r.x_px, r.y_px, r.distance_m, r.bearings) for r in reports]

    config = CameraConfig(hfov_deg=HFOV_DEG)
    assert told(reports_on(corridor_flight, config)) == told(corridor_reports)


def write_camera_file(path: Path) -> Path:
    path.write_text("width_px = 640\nheight_px = 480\nhfov_deg = 70.0\n")
    return path


@pytest.mark.parametrize("shape", [(1, 1), (300, 300), (480, 320)])
def test_frames_that_are_not_the_calibrated_cameras_are_no_detection(tmp_path: Path, shape):
    pipeline = build_pipeline(
        DetectorConfig(method="paper"), CameraConfig(file=str(write_camera_file(tmp_path / "camera.toml")))
    )
    report = pipeline.detect(Frame(np.zeros(shape, np.uint8), 5, 3), None)
    assert (report.kind, report.reason) == ("none", "wrong_size")
    assert (report.frame_seq, report.frame_ns) == (3, 5)


def test_a_resized_image_of_the_calibrated_camera_is_used(tmp_path: Path, wall_flight):
    config = CameraConfig(file=str(write_camera_file(tmp_path / "camera.toml")))
    assert [r.reason for r in reports_on(wall_flight[:1], config)] == ["no_earlier_frame"]
    half = Frame(np.ascontiguousarray(wall_flight[0][0].image[::2, ::2]), 1, 0)
    assert (
        build_pipeline(DetectorConfig(method="paper"), config).detect(half, None).reason == "no_earlier_frame"
    )


def test_a_frame_of_another_size_starts_anew(wall_flight):
    pipeline = build_pipeline(DetectorConfig(method="paper"), CameraConfig(hfov_deg=HFOV_DEG))
    (first, first_pose), (second, second_pose) = wall_flight[:2]
    pipeline.detect(first, first_pose)
    smaller = Frame(np.ascontiguousarray(second.image[::2, ::2]), second.time_ns, second.seq)
    assert pipeline.detect(smaller, second_pose).reason == "no_earlier_frame"


@pytest.mark.parametrize(
    ("detector", "camera", "named"),
    [
        ({}, {"file": "gone.toml"}, r"camera\.file: .*gone\.toml"),
        ({"params_file": "gone.toml"}, {}, r"detector\.params_file: .*gone\.toml"),
    ],
)
async def test_files_that_cannot_be_used_stop_the_service_at_its_start(detector, camera, named):
    with open_log(LogConfig(), io.StringIO()) as log:
        supervisor = VisionSupervisor(
            DetectorConfig(**detector),
            CameraConfig(**camera),
            clock=RealClock(),
            on_report=lambda report: None,
            log=log,
        )
        with pytest.raises(ConfigError, match=named):
            await supervisor.validate()


def test_a_parameter_that_cannot_be_is_a_configuration_error(tmp_path: Path):
    (tmp_path / "params.toml").write_text("clusters_min = -3\n")
    with pytest.raises(ConfigError, match="clusters_min"):
        build_pipeline(DetectorConfig(params_file=str(tmp_path / "params.toml")), CameraConfig())


def test_the_void_map_takes_parameters_from_a_file(tmp_path: Path):
    file = tmp_path / "params.toml"
    file.write_text("round_trip_px = 0.9\n")
    config = DetectorConfig(method="parallax", params_file=str(file))
    assert build_pipeline(config, CameraConfig())._parallax_params.round_trip_px == 0.9
    file.write_text("clusters_min = 3\n")  # the paper's
    with pytest.raises(ConfigError, match=r"params_file: .*clusters_min: unknown key"):
        build_pipeline(config, CameraConfig())


async def test_the_real_worker_reports_the_wall(wall_flight, wall_reports):
    reports: asyncio.Queue[DetectionReport] = asyncio.Queue()
    with open_log(LogConfig(), io.StringIO()) as log:
        supervisor = VisionSupervisor(
            DetectorConfig(method="paper", deadline_s=60.0),
            CameraConfig(hfov_deg=HFOV_DEG),
            clock=RealClock(),
            on_report=reports.put_nowait,
            log=log,
        )
        await supervisor.validate()
        async with asyncio.TaskGroup() as group:
            task = group.create_task(supervisor.run())
            await asyncio.sleep(0)
            found = []
            for frame, pose in wall_flight:
                supervisor.offer(frame, pose)
                async with asyncio.timeout(60):
                    found.append(await reports.get())
                assert (found[-1].frame_ns, found[-1].pose) == (frame.time_ns, pose)
            task.cancel()
    assert [(r.kind, r.distance_m, r.bearings) for r in found] == [
        (r.kind, r.distance_m, r.bearings) for r in wall_reports
    ]
    assert "single_plane" in {report.kind for report in found}
    assert supervisor.status.restarts == 0
    assert time.monotonic_ns() > supervisor.status.last_report_ns


def test_obstacles_are_places_at_the_vehicles_height_seen_more_than_once_nearest_first():
    points = np.array(
        [
            (1.0, 0.0, 2.0), (1.02, 0.02, 2.05),  # right of the axis, at the vehicle's height: two points
            (-0.5, 0.1, 1.0), (-0.52, 0.12, 1.02),  # nearer, to the left
            (0.0, 1.0, 1.5), (0.0, 1.01, 1.52),  # the floor
            (0.9, 0.0, 0.9),  # alone
        ]
    )  # fmt: skip
    facing_north = r_body_from_camera(0.0, 0.0, 0.0)
    pose = Pose(0, 10.0, 20.0, -1.0, (1.0, 0.0, 0.0, 0.0))
    found = obstacles_seen(points, facing_north, pose, 0.4)
    assert found == (pytest.approx((11.01, 19.49)), pytest.approx((12.025, 21.01)))
    assert obstacles_seen(np.zeros((0, 3)), facing_north, pose, 0.4) == ()

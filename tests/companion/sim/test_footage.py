from __future__ import annotations

import csv

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.guidance.coordinates import r_body_from_camera, r_ned_from_body
from companion.sim.footage import OFFICE_WALK, OFFICE_WALK_CAMERA, OFFICE_WALK_POSES
from companion.sim.recorded_poses import RecordedPoses
from detector.camera_model import CameraModel

MIB = 1 << 20


def frame_times() -> list[tuple[str, float]]:
    with (OFFICE_WALK / "timestamps.csv").open(newline="") as file:
        return [(row["file"], float(row["time_s"])) for row in csv.DictReader(file)]


def image(index: int) -> NDArray[np.uint8]:
    grey = cv2.imread(str(OFFICE_WALK / frame_times()[index][0]), cv2.IMREAD_GRAYSCALE)
    assert grey is not None
    return np.asarray(grey, np.uint8)


def tracks(
    first: NDArray[np.uint8], second: NDArray[np.uint8]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    corners = cv2.goodFeaturesToTrack(first, 400, 0.01, 7)
    ends, found, _ = cv2.calcOpticalFlowPyrLK(first, second, corners, None)
    back, _, _ = cv2.calcOpticalFlowPyrLK(second, first, ends, None)
    good = (found.ravel() == 1) & (np.abs(back - corners).reshape(-1, 2).max(axis=1) < 0.3)
    return corners.reshape(-1, 2)[good].astype(np.float64), ends.reshape(-1, 2)[good].astype(np.float64)


def test_the_clip_is_small_has_its_licence_and_all_its_images() -> None:
    files = [path for path in OFFICE_WALK.rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) < 3.8 * MIB
    assert "MIT License" in (OFFICE_WALK / "LICENSE").read_text()
    assert "nominal" in (OFFICE_WALK / "README.md").read_text()
    times = frame_times()
    assert len(times) == 220
    assert np.allclose(np.diff([time_s for _, time_s in times]), 0.1)
    assert {OFFICE_WALK / name for name, _ in times} == set(OFFICE_WALK.rglob("*.webp"))


def test_there_is_a_pose_for_each_frame_and_the_camera_fits_the_images() -> None:
    poses = RecordedPoses.load(OFFICE_WALK_POSES)
    assert poses.times_s.tolist() == [time_s for _, time_s in frame_times()]
    camera = CameraModel.from_file(OFFICE_WALK_CAMERA)
    assert image(0).shape == (camera.height_px, camera.width_px)


def test_the_walk_is_level_and_goes_mostly_forward() -> None:
    poses = RecordedPoses.load(OFFICE_WALK_POSES)
    assert np.ptp(poses.positions_ned_m[:, 2]) < 0.3
    steps = np.diff(poses.positions_ned_m, axis=0)[:, :2]
    attitudes = [r_ned_from_body((q[0], q[1], q[2], q[3])) for q in poses.q_ned_from_body]
    forward = np.array([r[:2, 0] for r in attitudes])[:-1]
    forward /= np.linalg.norm(forward, axis=1)[:, None]
    moving = np.linalg.norm(steps, axis=1) > 0.03
    assert np.mean((steps * forward).sum(axis=1)[moving] > 0) > 0.8
    # The head nods and turns, but stays upright: the body's down axis is never far from down.
    assert min(r[2, 2] for r in attitudes) > np.cos(np.radians(45.0))


def test_the_images_move_as_the_poses_say() -> None:
    """Tracks must lie on the epipolar lines of the recorded motion, and on no mirrored or reversed motion's."""
    poses = RecordedPoses.load(OFFICE_WALK_POSES)
    camera = CameraModel.from_file(OFFICE_WALK_CAMERA)
    k = np.array([[camera.fx_px, 0, camera.cx_px], [0, camera.fy_px, camera.cy_px], [0, 0, 1.0]])
    body_from_camera = r_body_from_camera(0.0, 0.0, 0.0)

    def camera_pose(index: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        w, x, y, z = poses.q_ned_from_body[index]
        return r_ned_from_body((w, x, y, z)) @ body_from_camera, poses.positions_ned_m[index]

    def epipolar_px(a: NDArray[np.float64], b: NDArray[np.float64], turn: NDArray, move: NDArray) -> float:
        cross = np.array([[0, -move[2], move[1]], [move[2], 0, -move[0]], [-move[1], move[0], 0]])
        fundamental = np.linalg.inv(k).T @ cross @ turn @ np.linalg.inv(k)
        lines = np.column_stack([a, np.ones(len(a))]) @ fundamental.T
        off = np.abs((lines * np.column_stack([b, np.ones(len(b))])).sum(axis=1))
        return float(np.median(off / np.hypot(lines[:, 0], lines[:, 1])))

    right, wrong = [], []
    for first in range(10, 210, 25):
        (r1, p1), (r2, p2) = camera_pose(first), camera_pose(first + 1)
        a, b = tracks(image(first), image(first + 1))
        assert len(a) > 25
        turn = r2.T @ r1
        move = r2.T @ (p1 - p2)
        right.append(epipolar_px(a, b, turn, move))
        wrong.append(epipolar_px(a, b, turn.T, move))
    assert np.median(right) < 0.6
    assert np.median(wrong) > 10 * np.median(right)

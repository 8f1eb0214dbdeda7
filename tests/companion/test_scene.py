from __future__ import annotations

import math

import cv2
import numpy as np
import pytest

from companion.guidance.coordinates import r_body_from_camera, r_from_euler
from companion.sim.scene import (
    Rectangle,
    Scene,
    Texture,
    corridor,
    empty_room,
    room_with_wall,
    square_wall,
)
from detector.camera_model import CameraModel

CAMERA = CameraModel.from_hfov(320, 240, 80.0)
DISTORTED = CameraModel(320, 240, 200.0, 200.0, 160.0, 118.0, (-0.28, 0.07, 0.0002, 0.0))
LEVEL = r_body_from_camera(0.0, 0.0, 0.0)
EYE = np.array([0.0, 0.0, -1.3])


def _turned(yaw_deg: float, pitch_deg: float = 0.0, roll_deg: float = 0.0) -> np.ndarray:
    return r_from_euler(math.radians(roll_deg), math.radians(pitch_deg), math.radians(yaw_deg)) @ LEVEL


@pytest.fixture(scope="module")
def room() -> Scene:
    return room_with_wall(seed=3)


def test_same_seed_same_image_other_seed_other_image() -> None:
    first, second, other = (empty_room(6, 4, seed=seed).render(CAMERA, EYE, LEVEL) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, second)
    assert first.shape == (240, 320)
    assert first.dtype == np.uint8
    assert np.mean(first != other) > 0.5


@pytest.mark.parametrize("camera", [CAMERA, DISTORTED], ids=["pinhole", "distorted"])
def test_depth_is_what_the_rays_measure(room: Scene, camera: CameraModel) -> None:
    rotation = _turned(25.0, 5.0, -10.0)
    depth_m = room.depth(camera, EYE, rotation)
    pixels = np.array([[x, y] for x in (7, 80, 161, 240, 311) for y in (5, 60, 119, 180, 236)])
    rays = camera.pixel_to_ray(pixels)
    for (x, y), ray in zip(pixels, rays, strict=True):
        assert depth_m[y, x] == pytest.approx(room.range_along(EYE, rotation @ ray) * ray[2], rel=1e-4)


def test_known_distances(room: Scene) -> None:
    assert room.range_along(EYE, (1, 0, 0)) == pytest.approx(5.0)
    assert room.range_along(EYE, (-3, 0, 0)) == pytest.approx(2.0)
    assert room.range_along(EYE, (0, 1, 0)) == pytest.approx(4.0)
    assert room.range_along(EYE, (0, 0, 1)) == pytest.approx(1.3)
    assert room.range_along((0, 3.0, -1.3), (1, 0, 0)) == pytest.approx(10.0)  # beside the wall
    assert square_wall(3.0, 30.0).range_along((0, 0, 0), (1, 0, 0)) == pytest.approx(3.0)
    assert (
        square_wall(3.0, 30.0).range_along((0, 0, 0), (1, 0.2, 0)) > 3.06
    )  # its right-hand side is further away
    assert square_wall(3.0).range_along((0, 0, 0), (-1, 0, 0)) == math.inf


def test_clearance(room: Scene) -> None:
    assert room.clearance(EYE) == pytest.approx(2.0)
    assert room.clearance((4.6, 0, -1.3)) == pytest.approx(0.4)
    assert room.clearance((5.1, 1.7, -1.3)) == pytest.approx(0.2)  # beside the end of the wall
    assert room.clearance((5.1, 2.75, -1.3)) == pytest.approx(1.25)  # the middle of the gap
    assert room.clearance((4.6, 0, -9.0)) == math.inf  # above the room


@pytest.mark.parametrize(
    ("scene", "depth_m"),
    [(square_wall(1.0), 1.0), (square_wall(6.0), 6.0), (corridor(), None), (empty_room(), None)],
)
@pytest.mark.parametrize("width_px", [320, 640])
def test_there_is_enough_to_see(scene: Scene, depth_m: float | None, width_px: int) -> None:
    camera = CameraModel.from_hfov(width_px, width_px * 3 // 4, 80.0)
    eye = EYE if depth_m is None else np.zeros(3)
    image = scene.render(camera, eye, LEVEL)
    assert len(cv2.SIFT_create().detect(image, None)) > 200
    assert 60 < image.mean() < 190
    assert np.mean((image <= 4) | (image >= 250)) < 0.02
    if depth_m is not None:
        np.testing.assert_allclose(scene.depth(camera, eye, LEVEL), depth_m, rtol=1e-4)


@pytest.mark.parametrize("supersample", [1, 2])
@pytest.mark.parametrize("camera", [CAMERA, DISTORTED], ids=["pinhole", "distorted"])
def test_tracked_flow_is_the_true_flow(room: Scene, camera: CameraModel, supersample: int) -> None:
    r_earlier, r_later = _turned(0.0), _turned(2.0, -1.0)
    earlier_m, later_m = EYE, EYE + np.array([0.2, 0.05, -0.02])
    first = room.render(camera, earlier_m, r_earlier, supersample=supersample)
    second = room.render(camera, later_m, r_later, supersample=supersample)
    start = cv2.goodFeaturesToTrack(first, 300, 0.01, 5).reshape(-1, 1, 2)
    end, status, _ = cv2.calcOpticalFlowPyrLK(first, second, start, None, winSize=(15, 15), maxLevel=4)
    back, _, _ = cv2.calcOpticalFlowPyrLK(second, first, end, None, winSize=(15, 15), maxLevel=4)
    kept = (status.ravel() == 1) & (np.abs(back - start).max(axis=(1, 2)) < 0.5)
    start, end = start.reshape(-1, 2)[kept].astype(float), end.reshape(-1, 2)[kept]

    rays = camera.pixel_to_ray(start) @ r_earlier.T
    ranges_m = np.array([room.range_along(earlier_m, ray) for ray in rays])
    expected = camera.ray_to_pixel((earlier_m + rays * ranges_m[:, None] - later_m) @ r_later)
    error_px = np.linalg.norm(end - expected, axis=1)
    assert len(error_px) > 100
    assert np.median(np.linalg.norm(expected - start, axis=1)) > 2.0
    assert np.median(error_px) < 0.15
    assert np.percentile(error_px, 80) < 0.4


def test_straight_edges_run_to_the_vanishing_point() -> None:
    image = corridor(seed=5).render(CAMERA, EYE, LEVEL)
    lines = cv2.HoughLinesP(
        cv2.Canny(image, 80, 160), 1, math.pi / 180, 60, minLineLength=50, maxLineGap=6
    ).reshape(-1, 4)
    slanted = [
        line
        for line in lines.astype(float)
        if 20 < abs(math.degrees(math.atan2(line[3] - line[1], line[2] - line[0]))) < 70
    ]
    miss_px = [
        abs((x2 - x1) * (y1 - CAMERA.cy_px) - (x1 - CAMERA.cx_px) * (y2 - y1)) / math.hypot(x2 - x1, y2 - y1)
        for x1, y1, x2, y2 in slanted
    ]
    # Bricks and patches give lines of their own; a chance line comes this near to the point in one case of fifty.
    assert np.sum(np.array(miss_px) < 2.0) >= 4


def test_a_nearer_surface_hides_a_farther_one_and_nothing_behind_is_seen() -> None:
    far = Rectangle((4, -9, 9), (0, 18, 0), (0, 0, -18), Texture.PLASTER, 1)
    near = Rectangle((2, -0.5, 0.5), (0, 1, 0), (0, 0, -1), Texture.TILE, 2)
    behind = Rectangle((-1, -9, 9), (0, 18, 0), (0, 0, -18), Texture.TILE, 3)
    for order in ((far, near, behind), (behind, near, far)):
        depth_m = Scene(order).depth(CAMERA, (0, 0, 0), LEVEL)
        assert depth_m[120, 160] == pytest.approx(2.0, rel=1e-5)
        assert depth_m[10, 10] == pytest.approx(4.0, rel=1e-5)
    assert not np.isfinite(Scene((behind,)).depth(CAMERA, (0, 0, 0), LEVEL)).any()
    assert (Scene((behind,)).render(CAMERA, (0, 0, 0), LEVEL) == 96).all()


def test_misuse_is_named() -> None:
    with pytest.raises(ValueError, match="perpendicular"):
        Rectangle((0, 0, 0), (1, 0, 0), (1, 1, 0))
    with pytest.raises(ValueError, match="at least 1 mm"):
        Rectangle((0, 0, 0), (0, 0, 0), (0, 1, 0))
    with pytest.raises(ValueError, match="at least one"):
        Scene(())
    with pytest.raises(ValueError, match="inside the room"):
        room_with_wall(gap_m=9.0)
    with pytest.raises(ValueError, match="supersample"):
        square_wall(2.0).render(CAMERA, (0, 0, 0), LEVEL, supersample=0)
    with pytest.raises(ValueError, match="expected a position"):
        square_wall(2.0).render(CAMERA, (0, 0), LEVEL)

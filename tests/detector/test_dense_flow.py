"""Flow on a grid against scenes whose depth is known, and what must not be believed of it."""

import math

import numpy as np
import pytest

from companion.guidance.coordinates import r_body_from_camera, r_from_euler
from companion.sim.scene import Scene, corridor
from detector.camera_model import CameraModel
from detector.dense_flow import DenseFlowParams, grid_tracks
from detector.expansion import RangeSamples, free_range_along, ranges_m

CAMERA = CameraModel.from_hfov(320, 240, 75.0)
LENS = CameraModel(320, 240, 210.0, 210.0, 161.0, 118.0, (-0.20, 0.03, 0.0, 0.0))
STEP_M = np.array([0.25, 0.0, 0.0])


def attitude(yaw_deg: float = 0.0, pitch_deg: float = 0.0, roll_deg: float = 0.0) -> np.ndarray:
    euler = math.radians(roll_deg), math.radians(pitch_deg), math.radians(yaw_deg)
    return r_from_euler(*euler) @ r_body_from_camera(0.0, 0.0, 0.0)


def noisy(image: np.ndarray, seed: int, sigma: float = 2.0) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(0.0, sigma, image.shape)
    return np.clip(image + noise, 0, 255).astype(np.uint8)


def samples_of(
    scene: Scene, camera: CameraModel, turn_deg: tuple[float, float, float]
) -> tuple[RangeSamples, np.ndarray]:
    """Return the ranges measured on one step forward, and the true ones."""
    start, end = np.array([0.0, 0.2, -1.3]), np.array([0.0, 0.2, -1.3]) + STEP_M
    before, after = attitude(), attitude(*turn_deg)
    tracks, sigma_px = grid_tracks(
        noisy(scene.render(camera, start, before), 1),
        noisy(scene.render(camera, end, after), 2),
        camera,
        after.T @ before,
        after.T @ STEP_M,
        DenseFlowParams(),
    )
    samples = ranges_m(camera, tracks.start_px, tracks.end_px, after.T @ STEP_M, flow_sigma_px=sigma_px)
    column, row = np.rint(camera.ray_to_pixel(samples.rays)).astype(int).T
    depth_m = scene.depth(camera, end, after)[np.clip(row, 0, 239), np.clip(column, 0, 319)]
    return samples, depth_m / samples.rays[:, 2]


@pytest.mark.parametrize("camera", [CAMERA, LENS], ids=["pinhole", "lens"])
@pytest.mark.parametrize("turn_deg", [(0.0, 0.0, 0.0), (4.0, -2.0, 3.0)], ids=["straight", "turned"])
def test_ranges_of_a_corridor(camera: CameraModel, turn_deg: tuple[float, float, float]) -> None:
    samples, true_m = samples_of(corridor(seed=4), camera, turn_deg)
    assert len(samples) > 300
    away = (samples.inverse_per_m - 1.0 / true_m) / samples.sigma_per_m
    assert abs(np.median(away)) < 0.5  # nothing systematic, whatever the turn and the lens
    assert 1.4826 * np.median(np.abs(away)) < 2.0
    wrong = (
        np.abs(1.0 / samples.inverse_per_m[samples.is_resolved] / true_m[samples.is_resolved] - 1.0) > 0.25
    )
    assert wrong.mean() < 0.25


def test_a_surface_without_texture_gives_no_samples() -> None:
    plain = np.full((240, 320), 120, np.uint8)
    tracks, _ = grid_tracks(
        noisy(plain, 1), noisy(plain, 2), CAMERA, np.eye(3), np.array([0.0, 0.0, 1.0]), DenseFlowParams()
    )
    assert len(tracks) < 10


def test_stripes_along_the_motion_give_no_samples_and_stripes_across_do() -> None:
    stripes = np.tile((128 + 80 * np.sin(np.arange(320) / 4.0)).astype(np.uint8), (240, 1))
    upright = noisy(stripes, 1), noisy(np.roll(stripes, 2, axis=1), 2)
    level = tuple(
        noisy(np.ascontiguousarray(np.resize(stripes[0], (240, 1)).repeat(320, axis=1)), k) for k in (1, 2)
    )
    sideways = np.array([-1.0, 0.0, 0.0])
    across, _ = grid_tracks(*upright, CAMERA, np.eye(3), sideways, DenseFlowParams())
    along, _ = grid_tracks(*level, CAMERA, np.eye(3), sideways, DenseFlowParams())
    assert len(across) > 500
    assert len(along) < 0.05 * len(across)


def test_a_larger_frame_is_reduced_and_answers_in_its_own_pixels() -> None:
    large = CameraModel.from_hfov(640, 480, 75.0)
    scene, position = corridor(seed=4), np.array([0.0, 0.2, -1.3])
    images = [scene.render(large, position + step * STEP_M, attitude()) for step in (0, 1)]
    tracks, sigma_px = grid_tracks(
        images[0], images[1], large, np.eye(3), attitude().T @ STEP_M, DenseFlowParams()
    )
    assert sigma_px == pytest.approx(2 * DenseFlowParams().sigma_px)
    assert tracks.end_px[:, 0].max() > 560
    middle = np.array([large.cx_px, large.cy_px])
    outward = np.einsum("ij,ij->i", tracks.end_px - tracks.start_px, tracks.start_px - middle)
    assert np.mean(outward > 0.0) > 0.9  # flying ahead, everything expands


def test_settings_without_sense_are_refused() -> None:
    with pytest.raises(ValueError, match="step_px must be above 0, found 0"):
        DenseFlowParams(step_px=0)


# ---------------------------------------------------------------------- what could hide between the samples


def wall_samples(azimuths_deg: np.ndarray, distance_m: float) -> RangeSamples:
    """Return samples of a wall across the view, at these azimuths and three heights."""
    azimuth, up = np.meshgrid(np.radians(azimuths_deg), np.radians([-4.0, 0.0, 4.0]))
    rays = np.column_stack(
        [
            (np.sin(azimuth) * np.cos(up)).ravel(),
            -np.sin(up).ravel(),
            (np.cos(azimuth) * np.cos(up)).ravel(),
        ]
    )
    inverse = rays[:, 2] / distance_m
    return RangeSamples(rays, inverse, np.full(len(rays), 0.01))


def free_m(samples: RangeSamples, azimuth_deg: float, hidden_width_m: float) -> float:
    ray = (math.sin(math.radians(azimuth_deg)), 0.0, math.cos(math.radians(azimuth_deg)))
    found = free_range_along(
        samples, ray, half_width_m=0.45, half_height_m=0.2, hidden_width_m=hidden_width_m
    )
    assert found is not None
    return found.distance_m


def test_a_gap_in_what_is_seen_limits_the_way_to_where_something_could_stand_in_it() -> None:
    everywhere = wall_samples(np.arange(-30.0, 30.1, 1.0), 6.0)
    assert free_m(everywhere, 0.0, 0.3) == pytest.approx(6.0, rel=0.1)
    # Nothing seen over 11 degrees, as a plain pillar of 0.5 m leaves it at 2.6 m: something 0.3 m wide fits in at 1.56 m.
    azimuths = np.arange(-30.0, 30.1, 1.0)
    gap = wall_samples(azimuths[(azimuths < -3.0) | (azimuths > 6.0)], 6.0)
    limited = free_m(gap, 5.0, 0.3)
    assert 1.1 < limited <= 0.3 / math.radians(10.0)
    assert free_m(gap, 5.0, math.inf) == pytest.approx(6.0, rel=0.1)
    # Its edge counts for a way beside it, into which it reaches ...
    assert free_m(gap, -5.0, 0.3) < 2.0
    # ... and a way far from it is as free as before.
    assert free_m(gap, -20.0, 0.3) == pytest.approx(6.0 / math.cos(math.radians(20.0)), rel=0.1)


def test_samples_that_cannot_tell_far_from_near_cover_nothing() -> None:
    sure = wall_samples(np.arange(-30.0, 30.1, 1.0), 6.0)
    unsure = RangeSamples(
        sure.rays, sure.inverse_per_m, np.where(np.abs(sure.rays[:, 0]) < 0.12, 0.6, sure.sigma_per_m)
    )
    assert free_m(unsure, 8.0, 0.3) < 2.0

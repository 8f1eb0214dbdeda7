from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from detector.camera_model import CameraModel
from detector.expansion import (
    RangeSamples,
    fit_focus_of_expansion,
    focus_of_expansion_from_translation,
    free_range_along,
    ideal_px,
    plane_share,
    ranges_m,
    refine_rotation,
    time_to_contact_along,
)

CAMERA = CameraModel.from_hfov(640, 480, 80.0)
DISTORTED = CameraModel(640, 480, 400.0, 400.0, 320.0, 240.0, (-0.28, 0.07, 0.0, 0.0))


def _cloud(
    rng: np.random.Generator, n: int = 400, nearest_m: float = 2.0, farthest_m: float = 8.0
) -> np.ndarray:
    depth = rng.uniform(nearest_m, farthest_m, n)
    pixels = np.column_stack((rng.uniform(20, 620, n), rng.uniform(20, 460, n)))
    rays = CAMERA.pixel_to_ray(pixels)
    return rays / rays[:, 2:] * depth[:, None]


def _tracks(
    points: np.ndarray,
    translation: tuple[float, float, float],
    noise_px: float = 0.0,
    camera: CameraModel = CAMERA,
    rotation: np.ndarray | None = None,
    seed: int = 1,
) -> tuple[np.ndarray, np.ndarray]:
    """Points in the later camera frame; ``rotation`` turns the start rays (an error of attitude)."""
    rng = np.random.default_rng(seed)
    before = points + np.array(translation)
    if rotation is not None:
        before = before @ rotation.T
    start = camera.ray_to_pixel(before) + rng.normal(0, noise_px, (len(points), 2))
    end = camera.ray_to_pixel(points) + rng.normal(0, noise_px, (len(points), 2))
    return start, end


def _small_rotation(x_deg: float, y_deg: float, z_deg: float) -> np.ndarray:
    x, y, z = np.radians((x_deg, y_deg, z_deg))
    u, _, vt = np.linalg.svd(np.array([[1, -z, y], [z, 1, -x], [-y, x, 1]]))
    return u @ vt


@settings(max_examples=40, deadline=None)
@given(x=st.floats(-0.12, 0.12), y=st.floats(-0.08, 0.08), seed=st.integers(0, 50))
def test_focus_is_found_with_noise_and_bad_tracks(x: float, y: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    translation = (x, y, 0.25)
    start, end = _tracks(_cloud(rng), translation, 0.2, seed=seed)
    end[:60] = start[:60] + rng.normal(0, 8, (60, 2))
    expected = focus_of_expansion_from_translation(CAMERA, translation)
    assert expected is not None
    found = fit_focus_of_expansion(start, end)
    assert found is not None
    assert np.linalg.norm(found - expected) < 12.0


def test_focus_of_known_motion_is_where_the_motion_points() -> None:
    translation = np.array([0.1, -0.05, 0.3])
    expected = CAMERA.ray_to_pixel(translation[None])[0]
    np.testing.assert_allclose(focus_of_expansion_from_translation(CAMERA, translation), expected)
    np.testing.assert_allclose(focus_of_expansion_from_translation(CAMERA, -translation), expected)
    assert focus_of_expansion_from_translation(CAMERA, (1, 0, 0)) is None
    assert focus_of_expansion_from_translation(CAMERA, (0, 0, 0)) is None


@pytest.mark.parametrize(
    ("translation", "noise_px"),
    [
        ((0.25, 0.0, 0.0), 0.2),
        ((0.0, 0.2, 0.001), 0.2),
        ((0.0, 0.0, 0.0), 0.2),
        ((0.0, 0.0, -0.25), 0.2),
        ((0.0, 0.0, 0.002), 0.3),
    ],
    ids=["sideways", "upwards", "still", "backwards", "hardly moved"],
)
def test_no_focus_where_the_tracks_do_not_determine_one(
    translation: tuple[float, float, float], noise_px: float
) -> None:
    start, end = _tracks(_cloud(np.random.default_rng(0)), translation, noise_px)
    assert fit_focus_of_expansion(start, end) is None


def test_no_focus_from_few_tracks_or_a_turn_left_in() -> None:
    cloud = _cloud(np.random.default_rng(0))
    start, end = _tracks(cloud, (0, 0, 0.25))
    assert fit_focus_of_expansion(start[:8], end[:8]) is None
    assert fit_focus_of_expansion(start[:0], end[:0]) is None
    start, end = _tracks(cloud, (0, 0, 0.0), 0.2, rotation=_small_rotation(0, 4, 0))
    assert fit_focus_of_expansion(start, end) is None


@pytest.mark.parametrize("distance_m", [0.8, 1.5, 3.0, 5.0])
@pytest.mark.parametrize("towards_px", [(319.5, 239.5), (480.0, 200.0)])
def test_time_to_contact_of_a_wall_from_the_later_frame(
    distance_m: float, towards_px: tuple[float, float]
) -> None:
    points = _cloud(np.random.default_rng(3), nearest_m=distance_m, farthest_m=distance_m)
    start, end = _tracks(points, (0, 0, 0.25))
    exact = time_to_contact_along(start, end, (319.5, 239.5), towards_px, 80.0)
    assert exact is not None
    assert exact.frames == pytest.approx(distance_m / 0.25, rel=1e-6)
    start, end = _tracks(points, (0, 0, 0.25), 0.2)
    noisy = time_to_contact_along(start, end, (319.5, 239.5), towards_px, 80.0)
    assert noisy is not None
    assert noisy.frames == pytest.approx(distance_m / 0.25, rel=0.2)
    assert noisy.samples > 10
    assert noisy.spread_frames > 0


def test_time_to_contact_takes_the_nearer_of_two_things() -> None:
    rng = np.random.default_rng(5)
    points = np.vstack((_cloud(rng, 200, 2.0, 2.0), _cloud(rng, 200, 8.0, 8.0)))
    start, end = _tracks(points, (0, 0, 0.25), 0.2)
    found = time_to_contact_along(start, end, (319.5, 239.5), (400, 240), 100.0)
    assert found is not None
    assert found.frames < 10.0


def test_no_time_to_contact_without_samples_or_with_a_wrong_focus() -> None:
    start, end = _tracks(_cloud(np.random.default_rng(3)), (0, 0, 0.25), 0.2)
    assert time_to_contact_along(start, end, (319.5, 239.5), (3000, 240), 80.0) is None
    assert time_to_contact_along(start, end, (320, -5000), (320, 240), 80.0) is None
    start, end = _tracks(_cloud(np.random.default_rng(3)), (0, 0, -0.25), 0.2)  # going away from it
    assert time_to_contact_along(start, end, (319.5, 239.5), (450, 240), 80.0) is None


def test_time_to_contact_never_exceeds_what_the_noise_lets_one_tell() -> None:
    start, end = _tracks(_cloud(np.random.default_rng(3), 600, 500.0, 900.0), (0, 0, 0.1), 0.2)
    found = time_to_contact_along(start, end, (319.5, 239.5), (450, 240), 80.0)
    assert found is not None
    assert found.frames < 800.0


@pytest.mark.parametrize("camera", [CAMERA, DISTORTED], ids=["pinhole", "distorted"])
@settings(max_examples=30, deadline=None)
@given(x=st.floats(-0.3, 0.3), y=st.floats(-0.1, 0.1), z=st.floats(-0.3, 0.3))
def test_exact_tracks_give_exact_points(camera: CameraModel, x: float, y: float, z: float) -> None:
    if math.hypot(x, y, z) < 0.1:
        return
    points = _cloud(np.random.default_rng(2), 120)
    start, end = _tracks(points, (x, y, z), camera=camera)
    samples = ranges_m(camera, start, end, (x, y, z), flow_sigma_px=1e-4)
    assert len(samples) > 115
    assert samples.is_resolved.mean() > 0.8
    rays = points / np.linalg.norm(points, axis=1, keepdims=True)
    order = np.argmax(samples.rays @ rays.T, axis=1)
    found = samples.points_m
    kept = samples.is_resolved
    np.testing.assert_allclose(found[kept], points[order][kept], rtol=1e-3, atol=1e-3)


def test_stated_uncertainty_is_the_real_one() -> None:
    points = _cloud(np.random.default_rng(4), 3000, 2.0, 4.0)
    start, end = _tracks(points, (0.2, 0.0, 0.15), 0.3 / math.sqrt(2.0))  # on either end
    samples = ranges_m(CAMERA, start, end, (0.2, 0.0, 0.15), flow_sigma_px=0.3)
    exact = ranges_m(CAMERA, *_tracks(points, (0.2, 0.0, 0.15)), (0.2, 0.0, 0.15), flow_sigma_px=0.3)
    assert len(exact) > 2950
    assert len(samples) > 2900
    rays = points / np.linalg.norm(points, axis=1, keepdims=True)
    order = np.argmax(samples.rays @ rays.T, axis=1)
    error = (samples.inverse_per_m - 1.0 / np.linalg.norm(points[order], axis=1)) / samples.sigma_per_m
    assert 0.75 < 1.4826 * np.median(np.abs(error - np.median(error))) < 1.3
    assert abs(np.median(error)) < 0.15


def test_a_point_without_parallax_has_no_place() -> None:
    start, end = _tracks(_cloud(np.random.default_rng(4), 100, 400.0, 900.0), (0, 0, 0.2))
    samples = ranges_m(CAMERA, start, end, (0, 0, 0.2))
    assert len(samples) > 90
    assert not samples.is_resolved.any()
    assert np.isnan(samples.points_m).all()


def test_tracks_that_do_not_fit_the_motion_are_left_out() -> None:
    points = _cloud(np.random.default_rng(4), 100)
    start, end = _tracks(points, (0, 0, 0.2))
    whole = len(ranges_m(CAMERA, start, end, (0, 0, 0.2)))
    end[:10] += (12.0, 25.0)
    flow = np.linalg.norm(end - start, axis=1)
    contracting = np.flatnonzero(flow[10:] > 4)[:20] + 10  # impossible when moving forward
    start[contracting], end[contracting] = end[contracting].copy(), start[contracting].copy()
    assert len(contracting) == 20
    assert len(ranges_m(CAMERA, start, end, (0, 0, 0.2))) <= whole - 26


@pytest.mark.parametrize("translation", [(0.0, 0.0, 0.25), (0.2, 0.0, 0.1), (0.25, 0.02, 0.0)])
def test_an_error_of_the_attitude_is_found(translation: tuple[float, float, float]) -> None:
    points = _cloud(np.random.default_rng(8), 500)
    error = _small_rotation(0.2, -0.25, 0.15)
    start, end = _tracks(points, translation, 0.2, rotation=error)
    correction = refine_rotation(CAMERA, start, end, translation, prior_sigma_rad=math.radians(0.3))
    left = correction @ error
    left_deg = math.degrees(math.acos(min(1.0, (np.trace(left) - 1) / 2)))
    assert left_deg < 0.12  # of 0.35
    exact = refine_rotation(
        CAMERA, *_tracks(points, translation), translation, prior_sigma_rad=math.radians(0.3)
    )
    np.testing.assert_allclose(exact, np.eye(3), atol=1e-5)


@pytest.mark.parametrize("slope", [0.0, 0.5])
def test_one_plane_explains_a_wall_and_not_a_room(slope: float) -> None:
    rng = np.random.default_rng(6)
    rays = _cloud(rng, 400, 1.0, 1.0)  # z = 1
    wall = rays * (3.0 / (1.0 - slope * rays[:, :1]))
    start, end = _tracks(wall, (0, 0, 0.25), 0.2)
    share = plane_share(start, end, (319.5, 239.5))
    assert share is not None
    assert share > 0.93
    floor = np.where(rays[:, 1:2] > 0.2, 1.0 / np.maximum(rays[:, 1:2], 0.2), 5.0)  # one metre below, to 5 m
    side = np.where(np.abs(rays[:, :1]) > 0.25, 1.2 / np.maximum(np.abs(rays[:, :1]), 0.25), 5.0)
    start, end = _tracks(rays * np.minimum(floor, side), (0, 0, 0.25), 0.2)
    share = plane_share(start, end, (319.5, 239.5))
    assert share is not None
    assert share < 0.7
    assert plane_share(start[:5], end[:5], (319.5, 239.5)) is None


def _wall(
    distance_m: float, east_m: tuple[float, float], down_m: tuple[float, float], n: int = 150
) -> np.ndarray:
    rng = np.random.default_rng(9)
    return np.column_stack((rng.uniform(*east_m, n), rng.uniform(*down_m, n), np.full(n, distance_m)))


def _samples(points: np.ndarray, share: float = 0.05, noise: float = 0.0) -> RangeSamples:
    """Points with a standard deviation of inverse range that is this share of the mean one."""
    inverse = 1.0 / np.linalg.norm(points, axis=1)
    sigma = np.full(len(points), share * inverse.mean() if len(points) else 0.0)
    noisy = inverse + np.random.default_rng(3).normal(0, 1, len(points)) * sigma * noise
    return RangeSamples(points * inverse[:, None], noisy, sigma)


def _free(points: np.ndarray, ray: tuple[float, float, float] = (0, 0, 1), **changes: float) -> float | None:
    found = free_range_along(_samples(points, **changes), ray, half_width_m=0.35, half_height_m=0.2)
    return None if found is None else found.distance_m


def test_the_swept_vehicle_meets_what_its_width_meets() -> None:
    far = _wall(6.0, (-3, 3), (-1, 1), 600)
    assert _free(far) == pytest.approx(6.0, rel=0.03)
    beside = _wall(2.0, (0.2, 0.33), (-0.1, 0.1))  # within the half width, outside 4 degrees
    assert _free(np.vstack((far, beside))) == pytest.approx(2.0)
    clear = _wall(2.0, (0.4, 0.6), (-0.1, 0.1))
    assert _free(np.vstack((far, clear))) == pytest.approx(6.0, rel=0.03)
    below = _wall(2.0, (-0.3, 0.3), (0.25, 0.5))
    assert _free(np.vstack((far, below))) == pytest.approx(6.0, rel=0.03)


def test_unknown_is_not_free() -> None:
    assert _free(np.empty((0, 3))) is None
    assert _free(_wall(6.0, (1.5, 3), (-1, 1))) is None


def test_unsure_samples_vouch_for_what_they_know_together() -> None:
    few = _wall(10.0, (-0.3, 0.3), (-0.3, 0.3), 4)
    found = _free(few, share=1.0)
    assert found == pytest.approx(10.0 / (1 + 2 / math.sqrt(4)), rel=0.02)
    many = _free(_wall(10.0, (-0.3, 0.3), (-0.3, 0.3), 100), share=1.0, noise=1.0)
    assert many is not None
    assert 5.5 < many < 10.5
    # One wrong near sample is no obstacle.
    far = _wall(10.0, (-5, 5), (-1, 1), 600)
    assert _free(np.vstack((far, [[0.0, 0.0, 1.0]]))) == pytest.approx(10.0, rel=0.05)


def test_two_depths_about_a_ray_give_the_nearer() -> None:
    points = np.vstack(
        (_wall(8.0, (-0.5, 0.5), (0.3, 0.5), 30), _wall(3.5, (-0.1, 0.1), (-0.215, -0.205), 30))
    )
    found = _free(points, share=0.05)
    assert found is not None
    assert found < 4.0


def test_nothing_is_free_beyond_what_the_parallax_resolves() -> None:
    found = _free(_wall(1000.0, (-50, 50), (-50, 50), 50), share=20.0)
    assert found is not None
    assert found < 1000.0 / (2 * 20.0 / math.sqrt(50))


def test_up_turns_with_the_camera() -> None:
    far = _wall(6.0, (-3, 3), (-3, 3), 2000)
    post = _wall(2.0, (-0.02, 0.02), (0.25, 0.33))
    samples = _samples(np.vstack((far, post)))
    level = free_range_along(samples, (0, 0, 1), half_width_m=0.35, half_height_m=0.2)
    rolled = free_range_along(samples, (0, 0, 1), half_width_m=0.35, half_height_m=0.2, up_camera=(1, 0, 0))
    assert level is not None
    assert rolled is not None
    assert level.distance_m == pytest.approx(6.0, rel=0.05)
    assert rolled.distance_m == pytest.approx(2.0)
    with pytest.raises(ValueError, match="vertical"):
        free_range_along(samples, (0, 1, 0), half_width_m=0.35, half_height_m=0.2)


def test_ideal_pixels_lie_where_a_lens_without_distortion_puts_them() -> None:
    pixels = np.array([[30.0, 40.0], [320.0, 240.0], [600.0, 400.0]])
    rays = DISTORTED.pixel_to_ray(pixels)
    ideal = CameraModel(640, 480, 400.0, 400.0, 320.0, 240.0)
    np.testing.assert_allclose(ideal_px(DISTORTED, pixels), ideal.ray_to_pixel(rays))
    np.testing.assert_array_equal(ideal_px(CAMERA, pixels), pixels)


def test_shapes_are_checked() -> None:
    with pytest.raises(ValueError, match=r"expected two arrays \(N, 2\)"):
        fit_focus_of_expansion(np.zeros((3, 2)), np.zeros((4, 2)))
    with pytest.raises(ValueError, match=r"expected \(3,\)"):
        focus_of_expansion_from_translation(CAMERA, (1, 2))
    with pytest.raises(ValueError, match=r"expected \(N, 3\), \(N,\) and \(N,\)"):
        RangeSamples(np.zeros((3, 3)), np.zeros(2), np.zeros(3))

"""Flow on a grid against known motion, and what the picture is said to tell."""

from __future__ import annotations

import numpy as np
import pytest

from detector.camera_model import CameraModel
from detector.parallax.flow_field import FlowField, coarse_rotation, grey_noise, measure_flow
from detector.parallax.params import ParallaxParams
from detector.rotation import rotation_vector
from tests.fakes.pair_views import CAMERA, View, corridor_view, noisy, view

PARAMS = ParallaxParams()


def measured(seen: View) -> FlowField:
    return measure_flow(seen.earlier, seen.later, seen.camera, seen.later_from_earlier, PARAMS)


def true_earlier_px(seen: View, field: FlowField) -> np.ndarray:
    """Where the samples were in the earlier frame, turned into the later orientation."""
    column, row = np.rint(field.later_px).astype(int).T
    rays = seen.camera.pixel_to_ray(field.later_px)
    points_m = rays / rays[:, 2:] * seen.depth_m[row, column][:, None]
    return seen.camera.ray_to_pixel(points_m + seen.translation_later_m)


def test_flow_is_right_to_the_noise_that_it_claims() -> None:
    seen = corridor_view()
    field = measured(seen)
    assert field.believed.sum() > 300
    used = field.where(field.believed)
    missed = used.earlier_px - true_earlier_px(seen, used)
    whitened = np.sqrt(np.einsum("ni,nij,nj->n", missed, used.information, missed))
    # Of a two-dimensional normal error the median is 1.18; depth edges and repeated bricks are the tail.
    assert 0.3 < np.median(whitened) < 1.6
    assert np.mean(whitened > 6.0) < 0.12


def test_an_edge_tells_flow_across_itself_only() -> None:
    stripes = np.tile((128 + 80 * np.sin(np.arange(320) / 4.0)).astype(np.uint8), (240, 1))
    field = measure_flow(noisy(stripes, 1), noisy(stripes, 2), CAMERA, np.eye(3), PARAMS)
    middle = field.where((np.abs(field.later_px - (160, 120)) < 80).all(axis=1))
    sigma_px = np.sqrt(np.linalg.inv(middle.information)[:, [0, 1], [0, 1]])
    assert np.median(sigma_px[:, 0]) < 0.4
    assert np.median(sigma_px[:, 1]) > 1.5


def test_noise_alone_is_no_texture() -> None:
    plain = np.full((240, 320), 120, np.uint8)
    for sigma in (1.0, 3.0, 6.0):
        field = measure_flow(noisy(plain, 1, sigma), noisy(plain, 2, sigma), CAMERA, np.eye(3), PARAMS)
        assert field.textured.mean() < 0.02, sigma


@pytest.mark.parametrize("sigma", [1.0, 3.0, 8.0])
def test_the_noise_of_a_picture_is_measured(sigma: float) -> None:
    ramp = np.tile(np.linspace(40, 200, 320), (240, 1)).astype(np.uint8)
    assert grey_noise(noisy(ramp, 3, sigma)) == pytest.approx(sigma, rel=0.25)


@pytest.mark.parametrize("turn_deg", [(0.0, 0.0, 12.0), (0.0, 5.0, -6.0), (3.0, -2.0, 4.0)])
def test_without_an_attitude_the_turn_is_found_roughly(turn_deg: tuple[float, float, float]) -> None:
    from companion.sim.scene import empty_room

    seen = view(empty_room(seed=5), turn_deg=turn_deg, step_m=(0.1, 0.0, 0.0))
    found = coarse_rotation(seen.earlier, seen.later, seen.camera)
    assert np.degrees(np.linalg.norm(rotation_vector(found @ seen.later_from_earlier.T))) < 3.0


def test_a_larger_frame_is_reduced_and_answers_in_its_own_pixels() -> None:
    from companion.sim.scene import corridor

    large = CameraModel.from_hfov(640, 480, 75.0)
    seen = view(corridor(seed=4), camera=large)
    field = measure_flow(seen.earlier, seen.later, large, np.eye(3), ParallaxParams(width_px=320))
    used = field.where(field.believed)
    assert used.later_px[:, 0].max() > 600
    missed_px = np.abs(used.earlier_px - true_earlier_px(seen, used))
    assert np.median(missed_px) < 0.5

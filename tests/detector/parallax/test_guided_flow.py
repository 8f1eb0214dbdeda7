"""Flow that starts from a swept depth, against known motion."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from detector.camera_model import CameraModel
from detector.parallax.depth_sweep import sweep_depth
from detector.parallax.egomotion import Egomotion, estimate_egomotion
from detector.parallax.flow_field import FlowField, measure_flow
from detector.parallax.guided_flow import measure_guided_flow
from detector.parallax.params import ParallaxParams
from tests.detector.parallax.test_flow_field import true_earlier_px
from tests.fakes.pair_views import CAMERA, View, corridor_view, rotation_deg, wall_view

PARAMS = ParallaxParams()


def first_look(seen: View) -> Egomotion:
    coarse = measure_flow(seen.earlier, seen.later, seen.camera, seen.later_from_earlier, PARAMS)
    found = estimate_egomotion(coarse, PARAMS, attitude_given=True, direction_prior=seen.translation_later_m)
    assert found is not None
    return found


def guided(seen: View, *, turn: np.ndarray | None = None) -> FlowField:
    motion = first_look(seen)
    swept = sweep_depth(
        seen.earlier, seen.later, seen.camera, motion.later_from_earlier, motion.direction_later, PARAMS
    )
    given = seen.later_from_earlier if turn is None else turn
    return measure_guided_flow(seen.earlier, seen.later, seen.camera, given, motion, swept, PARAMS)


def whitened_error(seen: View, field: FlowField) -> np.ndarray:
    used = field.where(field.believed)
    missed = used.earlier_px - true_earlier_px(seen, used)
    return np.sqrt(np.einsum("ni,nij,nj->n", missed, used.information, missed))


def test_flow_is_right_to_the_noise_that_it_claims() -> None:
    seen = corridor_view()
    error = whitened_error(seen, guided(seen))
    assert len(error) > 400
    assert 0.2 < np.median(error) < 1.6
    assert np.mean(error > 6.0) < 0.1


def test_a_wall_at_two_baselines_is_followed_which_plain_flow_is_not() -> None:
    seen = wall_view(0.5)
    plain = measure_flow(seen.earlier, seen.later, seen.camera, seen.later_from_earlier, PARAMS)
    found = guided(seen)
    assert found.believed.sum() > 1.5 * plain.believed.sum()
    assert np.median(whitened_error(seen, found)) < 1.6


def test_the_turn_that_is_taken_out_is_the_one_given_not_the_one_found() -> None:
    seen = corridor_view()
    off = rotation_deg(0.3, 0.0, -0.2) @ seen.later_from_earlier
    field = guided(replace(seen, later_from_earlier=off), turn=off)
    assert np.array_equal(field.later_from_earlier, off)
    used = field.where(field.believed)
    # The same points, seen from the earlier camera turned by what was given.
    rays = seen.camera.pixel_to_ray(used.earlier_px) @ (seen.later_from_earlier @ off.T).T
    back = replace(used, earlier_px=seen.camera.ray_to_pixel(rays))
    missed = back.earlier_px - true_earlier_px(seen, used)
    assert np.median(np.linalg.norm(missed, axis=1)) < 0.7


@pytest.mark.parametrize(("gain", "offset"), [(0.8, 0.0), (1.0, 30.0)])
def test_exposure_that_changes_is_no_motion(gain: float, offset: float) -> None:
    seen = corridor_view()
    earlier = np.clip(gain * seen.earlier.astype(np.float32) + offset, 0, 255).astype(np.uint8)
    changed = replace(seen, earlier=earlier)
    field = guided(changed)
    assert field.believed.sum() > 0.75 * guided(seen).believed.sum()
    assert np.median(whitened_error(changed, field)) < 1.8


def test_fine_even_texture_that_is_matched_at_a_wrong_place_is_not_believed() -> None:
    noise = np.random.default_rng(4).normal(128.0, 60.0, (240, 400)).astype(np.float32)
    wall = np.clip(cv2.GaussianBlur(noise, (0, 0), 1.2) * 3.0 - 256.0, 0, 255).astype(np.uint8)
    # The wall moved by 30 px; whoever looks for it where it would be if it were far finds some texture, and finds his way back.
    earlier, later = np.ascontiguousarray(wall[:, :320]), np.ascontiguousarray(wall[:, 30:350])
    forwards = first_look(corridor_view())
    still = replace(forwards, later_from_earlier=np.eye(3), correction=np.eye(3))
    far = sweep_depth(earlier, later, CAMERA, np.eye(3), forwards.direction_later, PARAMS)
    far = replace(far, inverse_depth=np.zeros_like(far.inverse_depth))
    lax = PARAMS.model_copy(update={"unlike_share": 10.0})
    believed = measure_guided_flow(earlier, later, CAMERA, np.eye(3), still, far, PARAMS).believed.mean()
    without = measure_guided_flow(earlier, later, CAMERA, np.eye(3), still, far, lax).believed.mean()
    assert without > 0.05
    assert believed < 0.5 * without


def tiled_wall(camera: CameraModel, position_m: np.ndarray, wall_from_camera: np.ndarray) -> np.ndarray:
    """A wall of square tiles 4 m ahead of the origin, each like the other, in a picture."""
    x, y = np.meshgrid(np.arange(camera.width_px, dtype=float), np.arange(camera.height_px, dtype=float))
    rays = camera.pixel_to_ray(np.stack([x.ravel(), y.ravel()], axis=1)) @ wall_from_camera.T
    at = position_m + rays * ((4.0 - position_m[2]) / rays[:, 2])[:, None]
    tile = np.random.default_rng(8).uniform(0.0, 255.0, (40, 40)).astype(np.float32)
    tile = cv2.GaussianBlur(np.tile(tile, (3, 3)), (0, 0), 1.5)[40:80, 40:80] * 2.0 - 128.0
    size = camera.height_px, camera.width_px
    column, row = (np.mod(at[:, i] / 0.5, 1.0).reshape(size).astype(np.float32) * 39.0 for i in (0, 1))
    return np.clip(cv2.remap(tile, column, row, cv2.INTER_LINEAR), 0, 255).astype(np.uint8)


def test_a_tile_that_was_out_of_the_earlier_picture_is_not_taken_for_a_nearer_one_that_was_in_it() -> None:
    turned = rotation_deg(0.0, -25.0, 0.0)  # later axes in those of the wall: the strip on the left is new
    step_m = np.array([0.25, 0.0, 0.0])  # to the right: the nearer, the further to the right it was
    earlier, later = tiled_wall(CAMERA, np.zeros(3), np.eye(3)), tiled_wall(CAMERA, step_m, turned)
    turn, direction = turned.T, turned.T @ step_m / 0.25
    motion = replace(
        first_look(corridor_view()),
        later_from_earlier=turn,
        direction_later=direction,
        correction=np.eye(3),
    )
    swept = sweep_depth(earlier, later, CAMERA, turn, direction, PARAMS)
    field = measure_guided_flow(earlier, later, CAMERA, turn, motion, swept, PARAMS)
    rays = CAMERA.pixel_to_ray(field.later_px) @ turned.T
    at = step_m + rays * ((4.0 - step_m[2]) / rays[:, 2])[:, None]
    was_out = CAMERA.ray_to_pixel(at)[:, 0] < -4.0
    assert was_out.sum() > 50
    blind = replace(swept, further_unseen=np.zeros_like(swept.further_unseen))
    trusting = measure_guided_flow(earlier, later, CAMERA, turn, motion, blind, PARAMS)
    assert trusting.believed[was_out].sum() >= 3
    assert field.believed[was_out].sum() == 0
    assert field.believed[~was_out].sum() > 0.5 * trusting.believed[~was_out].sum()

"""Depth from a sweep of planes against scenes in which every depth is known."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from companion.sim.scene import corridor
from detector.camera_model import CameraModel
from detector.parallax.depth_sweep import SweptDepth, sweep_depth
from detector.parallax.params import ParallaxParams
from tests.fakes.pair_views import CAMERA, View, corridor_view, noisy, rotation_deg, view, wall_view

PARAMS = ParallaxParams()
CLEAR = PARAMS.swept_margin


def swept(seen: View, **changed: np.ndarray) -> SweptDepth:
    turn = changed.get("turn", seen.later_from_earlier)
    direction = changed.get("direction", seen.translation_later_m)
    return sweep_depth(
        seen.earlier, seen.later, seen.camera, turn, direction / np.linalg.norm(direction), PARAMS
    )


def share_right(seen: View, found: SweptDepth, *, least_m: float = 0.0) -> tuple[float, float]:
    """Share of the clear places within a fifth of their true depth, and how many of all places are clear."""
    height, width = seen.depth_m.shape
    column, row = np.meshgrid(np.arange(4, width, 8), np.arange(4, height, 8))
    rays = seen.camera.pixel_to_ray(np.column_stack([column.ravel(), row.ravel()]))
    inverse, margin = found.at(rays)
    depth_m = seen.depth_m[row, column].ravel()
    ratio = inverse / np.linalg.norm(seen.translation_later_m) * depth_m
    clear = (margin >= CLEAR) & (depth_m >= least_m)
    return float(np.mean((ratio[clear] > 0.8) & (ratio[clear] < 1.25))), float(clear.mean())


def test_a_corridor_s_depth_is_found_and_what_is_not_clear_says_so() -> None:
    right, clear = share_right(corridor_view(), swept(corridor_view()))
    assert right > 0.9
    assert clear > 0.5


def test_a_wall_within_reach_is_found_where_it_moves_by_a_third_of_the_picture() -> None:
    seen = wall_view(0.4)  # less than two baselines away
    right, clear = share_right(seen, swept(seen))
    assert right > 0.9
    assert clear > 0.6


@pytest.mark.parametrize("step_m", [(0.0, 0.25, 0.0), (-0.25, 0.0, 0.0)])
def test_sideways_and_backwards_are_as_good_where_the_earlier_picture_saw_the_place(
    step_m: tuple[float, float, float],
) -> None:
    seen = view(corridor(seed=4), step_m=step_m)
    right, clear = share_right(seen, swept(seen))
    assert right > 0.85
    assert clear > 0.3


def test_a_direction_and_a_turn_that_are_a_little_wrong_do_little_harm() -> None:
    seen = corridor_view()
    turn = rotation_deg(0.15, -0.15, 0.1) @ seen.later_from_earlier
    direction = rotation_deg(2.0, 2.0, 0.0) @ seen.translation_later_m
    right, clear = share_right(seen, swept(seen, turn=turn, direction=direction))
    assert right > 0.8
    assert clear > 0.3


def test_exposure_that_changes_is_no_depth() -> None:
    seen = corridor_view()
    darker = replace(seen, earlier=np.asarray(0.7 * seen.earlier.astype(np.float32), np.uint8))
    assert share_right(darker, swept(darker))[0] > 0.9


def test_noise_without_texture_is_not_clear() -> None:
    plain = np.full((240, 320), 120, np.uint8)
    found = sweep_depth(
        noisy(plain, 1), noisy(plain, 2), CAMERA, np.eye(3), np.array([0.0, 0.0, 1.0]), PARAMS
    )
    assert np.mean(found.margin >= CLEAR) < 0.02


def test_outside_the_picture_nothing_is_clear() -> None:
    found = swept(corridor_view())
    inverse, margin = found.at(np.array([[-2.0, 0.0, 1.0], [0.0, 0.0, -1.0], [0.0, 3.0, 1.0]]))
    assert not margin.any()
    assert not inverse.any()
    assert np.isfinite(found.smooth_at(np.array([[-2.0, 0.0, 1.0], [0.0, 0.0, -1.0]]))).all()


def test_a_lens_that_bends_is_taken_out() -> None:
    bent = CameraModel(
        320, 240, CAMERA.fx_px, CAMERA.fy_px, CAMERA.cx_px, CAMERA.cy_px, (-0.15, 0.02, 0.0, 0.0)
    )
    column, row = np.meshgrid(np.arange(320.0), np.arange(240.0))
    source = CAMERA.ray_to_pixel(bent.pixel_to_ray(np.column_stack([column.ravel(), row.ravel()])))
    at = source.astype(np.float32).reshape(240, 320, 2)

    def through(image: np.ndarray) -> np.ndarray:
        return cv2.remap(image, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)

    seen = corridor_view()
    distorted = replace(
        seen,
        earlier=through(seen.earlier),
        later=through(seen.later),
        camera=bent,
        depth_m=through(seen.depth_m),
    )
    right, clear = share_right(distorted, swept(distorted))
    assert right > 0.9
    assert clear > 0.4


def test_the_same_pair_gives_the_same_depth() -> None:
    first, second = swept(corridor_view()), swept(corridor_view())
    assert np.array_equal(first.inverse_depth, second.inverse_depth)
    assert np.array_equal(first.margin, second.margin)

"""Rotation and direction of travel against known motion."""

from __future__ import annotations

import math

import numpy as np
import pytest

from detector.parallax.egomotion import (
    Egomotion,
    RotationSource,
    estimate_egomotion,
    focus_of_expansion,
    parallax_left_rad,
)
from detector.parallax.flow_field import measure_flow
from detector.parallax.params import ParallaxParams
from detector.rotation import rotation_vector
from tests.fakes.pair_views import CAMERA, View, corridor_view, large_room_view, noisy, rotation_deg, view

PARAMS = ParallaxParams()


def estimated(
    seen: View, *, attitude_error_deg: tuple[float, float, float] | None = (0.0, 0.0, 0.0), told_motion: bool
) -> Egomotion:
    given = (
        None if attitude_error_deg is None else rotation_deg(*attitude_error_deg) @ seen.later_from_earlier
    )
    field = measure_flow(seen.earlier, seen.later, seen.camera, given, PARAMS)
    motion = estimate_egomotion(
        field,
        PARAMS,
        attitude_given=given is not None,
        direction_prior=seen.translation_later_m if told_motion else None,
    )
    assert motion is not None
    return motion


def direction_error_deg(motion: Egomotion, seen: View) -> float:
    true = seen.translation_later_m / np.linalg.norm(seen.translation_later_m)
    return math.degrees(math.acos(min(1.0, float(true @ motion.direction_later))))


def rotation_error_deg(motion: Egomotion, seen: View) -> float:
    off = motion.later_from_earlier @ seen.later_from_earlier.T
    return math.degrees(float(np.linalg.norm(rotation_vector(off))))


@pytest.mark.parametrize("seen", [corridor_view(), large_room_view()], ids=["corridor", "room"])
def test_a_wrong_attitude_is_put_right(seen: View) -> None:
    wrong = (0.25, -0.2, 0.15)
    motion = estimated(seen, attitude_error_deg=wrong, told_motion=True)
    assert motion.source is RotationSource.ATTITUDE_REFINED
    assert rotation_error_deg(motion, seen) < 0.5 * math.hypot(*wrong)
    assert direction_error_deg(motion, seen) < 2.0


@pytest.mark.parametrize("seen", [corridor_view(), large_room_view()], ids=["corridor", "room"])
def test_rotation_and_direction_from_the_flow_alone(seen: View) -> None:
    motion = estimated(seen, attitude_error_deg=None, told_motion=False)
    assert motion.source is RotationSource.FLOW
    assert rotation_error_deg(motion, seen) < 0.6
    assert direction_error_deg(motion, seen) < 5.0


@pytest.mark.parametrize(
    "step_m", [(0.2, 0.12, 0.0), (0.05, 0.2, 0.0), (0.2, 0.0, -0.08)], ids=["oblique", "sideways", "climbing"]
)
def test_directions_off_the_axis(step_m: tuple[float, float, float]) -> None:
    from companion.sim.scene import corridor

    seen = view(corridor(seed=4), step_m=step_m)
    motion = estimated(seen, told_motion=False)
    assert direction_error_deg(motion, seen) < 4.0
    # What it claims covers what it misses.
    assert math.radians(direction_error_deg(motion, seen)) < 4.0 * motion.direction_sigma_rad


def test_going_backwards_is_not_taken_for_going_forwards() -> None:
    from companion.sim.scene import corridor

    seen = view(corridor(seed=4), step_m=(-0.25, 0.0, 0.0))
    motion = estimated(seen, told_motion=False)
    assert motion.direction_later[2] < -0.9
    assert focus_of_expansion(motion, CAMERA) is None


def test_the_focus_of_expansion_lies_where_the_motion_points() -> None:
    seen = corridor_view()
    motion = estimated(seen, told_motion=True)
    focus = focus_of_expansion(motion, CAMERA)
    assert focus is not None
    x, y, z = seen.translation_later_m
    true_px = (CAMERA.cx_px + CAMERA.fx_px * x / z, CAMERA.cy_px + CAMERA.fy_px * y / z)
    missed_px = math.dist(true_px, (focus.x_px, focus.y_px))
    assert missed_px < 8.0
    assert missed_px < 4.0 * focus.sigma_px


def test_a_turn_alone_leaves_no_parallax_and_a_step_does() -> None:
    from companion.sim.scene import corridor

    turned = view(corridor(seed=4), step_m=(0.0, 0.0, 0.0), turn_deg=(1.0, -2.0, 4.0))
    for seen, still in ((turned, True), (corridor_view(), False)):
        for given in (seen.later_from_earlier, None):
            field = measure_flow(seen.earlier, seen.later, seen.camera, given, PARAMS)
            assert (parallax_left_rad(field) < PARAMS.still_rad) is still


def test_without_texture_what_was_given_stands_and_says_so() -> None:
    plain = noisy(np.full((240, 320), 120, np.uint8), 1)
    field = measure_flow(plain, plain, CAMERA, np.eye(3), PARAMS)
    ahead = np.array([0.0, 0.0, 0.3])
    motion = estimate_egomotion(field, PARAMS, attitude_given=True, direction_prior=ahead)
    assert motion is not None
    assert motion.source is RotationSource.ATTITUDE
    assert motion.direction_later == pytest.approx([0.0, 0.0, 1.0])
    assert motion.direction_sigma_rad == pytest.approx(math.radians(PARAMS.velocity_sigma_deg))
    assert estimate_egomotion(field, PARAMS, attitude_given=True) is None

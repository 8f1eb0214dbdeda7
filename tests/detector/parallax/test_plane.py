"""Plane or scene with depth, and the time to contact of a plane."""

from __future__ import annotations

import math

import numpy as np
import pytest

from detector.parallax.egomotion import Egomotion, estimate_egomotion
from detector.parallax.flow_field import measure_flow
from detector.parallax.params import ParallaxParams
from detector.parallax.plane import PlaneFit, distance_along_axis_m, fit_plane, plane_is_wall
from tests.fakes.pair_views import View, corridor_view, large_room_view, wall_view

PARAMS = ParallaxParams()
STEP_M = 0.25


def fitted(seen: View, *, told: bool = True) -> tuple[PlaneFit, Egomotion]:
    given = seen.later_from_earlier if told else None
    field = measure_flow(seen.earlier, seen.later, seen.camera, given, PARAMS)
    motion = estimate_egomotion(
        field, PARAMS, attitude_given=told, direction_prior=seen.translation_later_m if told else None
    )
    assert motion is not None
    fit = fit_plane(field, PARAMS, motion=motion)
    assert fit is not None
    return fit, motion


@pytest.mark.parametrize("told", [True, False], ids=["poses", "no poses"])
@pytest.mark.parametrize(("distance_m", "angle_deg"), [(1.5, 0.0), (2.0, 0.0), (4.0, 0.0), (2.5, 25.0)])
def test_a_wall_is_one_plane_and_its_contact_is_known(
    distance_m: float, angle_deg: float, told: bool
) -> None:
    fit, _ = fitted(wall_view(distance_m, angle_deg), told=told)
    assert plane_is_wall(fit, PARAMS)
    assert fit.contact is not None
    # Straight ahead, the wall's distance over the step, whatever its slant.
    assert fit.contact.frames == pytest.approx(distance_m / STEP_M, rel=0.1)
    assert abs(fit.contact.frames - distance_m / STEP_M) < 4.0 * fit.contact.spread_frames


def test_the_normal_and_the_distance_along_the_axis() -> None:
    seen = wall_view(2.5, 25.0)
    fit, motion = fitted(seen)
    assert fit.normal_later is not None
    assert math.degrees(math.acos(float(fit.normal_later[2]))) == pytest.approx(25.0, abs=6.0)
    distance_m = distance_along_axis_m(fit, motion, STEP_M)
    assert distance_m == pytest.approx(2.5, rel=0.12)


@pytest.mark.parametrize("seen", [corridor_view(), large_room_view()], ids=["corridor", "room"])
def test_a_scene_with_depth_is_not_a_plane(seen: View) -> None:
    fit, _ = fitted(seen)
    assert not plane_is_wall(fit, PARAMS)


def test_a_wall_that_does_not_come_nearer_has_no_contact() -> None:
    from companion.sim.scene import square_wall
    from tests.fakes.pair_views import view

    seen = view(square_wall(2.5, seed=3), step_m=(-0.25, 0.0, 0.0), start_m=np.array([0.0, 0.0, -1.3]))
    fit, _ = fitted(seen)
    assert fit.preferred
    assert fit.contact is None
    assert not plane_is_wall(fit, PARAMS)

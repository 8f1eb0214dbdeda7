"""Inverse ranges against known depth, and what must not be read as far."""

from __future__ import annotations

import numpy as np
import pytest

from detector.parallax.egomotion import Egomotion, RotationSource, estimate_egomotion
from detector.parallax.flow_field import FlowField, measure_flow
from detector.parallax.params import ParallaxParams
from detector.parallax.ranges import (
    InverseDepths,
    contact_about,
    flight_frame,
    inverse_depths,
    ranged_samples,
)
from tests.fakes.pair_views import CAMERA, View, attitude, corridor_view, wall_view

PARAMS = ParallaxParams()


def measured(seen: View) -> InverseDepths:
    field = measure_flow(seen.earlier, seen.later, seen.camera, seen.later_from_earlier, PARAMS)
    motion = estimate_egomotion(field, PARAMS, attitude_given=True, direction_prior=seen.translation_later_m)
    assert motion is not None
    return inverse_depths(field, motion, PARAMS)


def test_ranges_in_metres_are_right_to_what_they_claim() -> None:
    seen = corridor_view()
    depths = measured(seen)
    samples = ranged_samples(depths, baseline_m=0.25, frame_from_later=seen.level_from_later)
    assert samples.metric
    told = samples.informative
    assert told.sum() > 300
    column, row = np.rint(samples.pixels_px[told]).astype(int).T
    true_m = seen.depth_m[row, column] / depths.rays[told, 2]
    away = (samples.inverse_range[told] - 1.0 / true_m) / samples.sigma[told]
    assert abs(np.median(away)) < 0.6
    assert 1.4826 * np.median(np.abs(away)) < 1.8
    wrong = np.abs(samples.inverse_range[told] * true_m - 1.0) > 0.25
    assert wrong.mean() < 0.2
    # The rays are those of the level frame: what lies above the horizon has a negative down.
    level = depths.rays @ seen.level_from_later.T
    assert samples.rays_level == pytest.approx(level)


def test_without_the_scale_ranges_are_in_baselines() -> None:
    seen = corridor_view()
    depths = measured(seen)
    frame = seen.level_from_later
    metres = ranged_samples(depths, baseline_m=0.25, frame_from_later=frame)
    baselines = ranged_samples(depths, baseline_m=None, frame_from_later=frame)
    assert not baselines.metric
    told = metres.informative
    assert baselines.inverse_range[told] == pytest.approx(0.25 * metres.inverse_range[told])


def test_flow_along_an_edge_says_nothing_of_the_range() -> None:
    column, row = np.meshgrid(np.arange(8.0, 320.0, 16.0), np.arange(8.0, 240.0, 16.0))
    later_px = np.column_stack([column.ravel(), row.ravel()])
    count = len(later_px)
    # Upright edges two pixels away: known across, hardly along.
    information = np.tile(np.diag([1.0 / 0.3**2, 1.0 / 4.0**2]), (count, 1, 1))
    everywhere = np.ones(count, np.bool_)
    field = FlowField(
        later_px, later_px + np.array([2.0, 0.0]), information, np.eye(3), everywhere, everywhere, CAMERA
    )
    for direction, tangent, told in (
        ((1.0, 0.0, 0.0), [[0, 0], [1, 0], [0, 1]], 1.0),
        ((0.0, 1.0, 0.0), [[1, 0], [0, 0], [0, 1]], 0.0),
    ):
        motion = Egomotion(
            np.eye(3),
            np.eye(3),
            np.array(direction),
            1e-8 * np.eye(5),
            np.array(tangent, np.float64),
            RotationSource.ATTITUDE,
            1.0,
            1.0,
        )
        depths = inverse_depths(field, motion, PARAMS)
        assert depths.informative.mean() == told
        if told:
            depth_to_range = CAMERA.pixel_to_ray(later_px)[:, 2]
            assert depths.inverse_range == pytest.approx(2.0 / CAMERA.fx_px * depth_to_range)
        else:
            assert (depths.inverse_range == 0.0).all()
            assert (depths.sigma > 100.0).all()


def test_time_to_contact_of_a_wall_from_its_samples() -> None:
    seen = wall_view(2.0)
    field = measure_flow(seen.earlier, seen.later, seen.camera, seen.later_from_earlier, PARAMS)
    motion = estimate_egomotion(field, PARAMS, attitude_given=True, direction_prior=seen.translation_later_m)
    assert motion is not None
    depths = inverse_depths(field, motion, PARAMS)
    contact = contact_about(depths, motion, np.array([0.17, 0.0, 0.985]), 0.1)
    assert contact is not None
    assert contact.frames == pytest.approx(8.0, rel=0.15)
    assert contact_about(depths, motion, np.array([0.0, 0.0, -1.0]), 0.1) is None


def test_the_sweep_is_level_while_the_horizon_is_seen_and_follows_the_axis_else() -> None:
    level, is_level = flight_frame(attitude(0.0, -10.0, 30.0), CAMERA)
    assert is_level
    assert level == pytest.approx(attitude(0.0, -10.0, 30.0))
    for pitch_deg in (-45.0, 50.0):
        tipped, is_level = flight_frame(attitude(8.0, pitch_deg, 30.0), CAMERA)
        assert not is_level
        assert tipped @ tipped.T == pytest.approx(np.eye(3), abs=1e-9)
        axis = tipped[:, 2]
        assert axis[2] == pytest.approx(0.0, abs=1e-9)  # the optical axis lies in the plane that is swept
        assert np.degrees(np.arctan2(axis[1], axis[0])) == pytest.approx(30.0)  # and keeps its azimuth
    assert not flight_frame(None, CAMERA)[1]

"""What no sample shows near by is not known free, and what is seen near may go on to the next sample."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from detector.parallax.coverage import reach_in_rad
from detector.parallax.samples import RangedSamples
from detector.parallax.sure_map import looked_through_m
from detector.parallax.void_map import VoidMapParams, void_map

PARAMS = VoidMapParams()
FAR_M = 6.0


def looking(
    keep: NDArray[np.bool_] | None = None, range_m: NDArray[np.float64] | float = FAR_M, sigma: float = 0.004
) -> RangedSamples:
    """A grid of rays about north, a degree apart; all of them belong to the picture, those kept say something."""
    azimuth, elevation = grid()
    n = len(azimuth)
    rays = np.column_stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )
    told = np.ones(n, np.bool_) if keep is None else np.asarray(keep, np.bool_)
    return RangedSamples(
        rays, np.broadcast_to(1.0 / np.asarray(range_m), n), np.full(n, sigma), np.zeros((n, 2)), True, told
    )


def grid() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    azimuth, elevation = np.meshgrid(np.radians(np.arange(-38, 38.5)), np.radians(np.arange(-12, 12.5, 2)))
    return azimuth.ravel(), elevation.ravel()


def azimuth_deg() -> NDArray[np.float64]:
    return np.degrees(grid()[0])


def free_m(samples: RangedSamples, degrees: float) -> float | None:
    """What is free along an azimuth; None where it was not looked through so far."""
    found = void_map(samples, PARAMS)
    index = found.at(math.radians(degrees))
    is_looked_through = found.free_m[index] <= looked_through_m(samples, PARAMS)[index]
    return float(found.free_m[index]) if found.known[index] and is_looked_through else None


def test_what_is_looked_through_everywhere_is_free() -> None:
    assert free_m(looking(), 0.0) == pytest.approx(FAR_M - PARAMS.radius_m, rel=0.1)


@pytest.mark.parametrize(("width_deg", "is_known"), [(6.0, True), (14.0, False)])
def test_a_way_past_a_gap_that_could_hide_a_pillar_is_unknown(width_deg: float, is_known: bool) -> None:
    # The same gap is bridged by the map of far things: a degree at 2 m is 3.5 cm, and 0.3 m are 8.6 degrees.
    samples = looking(np.abs(azimuth_deg() - 8.0) > width_deg / 2.0)
    found = void_map(samples, PARAMS)
    assert found.known[found.at(0.0)]
    assert (free_m(samples, 0.0) is not None) is is_known
    assert free_m(samples, -30.0) is not None  # its swept width does not come near the gap


def test_a_corner_at_the_edge_of_the_picture_that_has_no_samples_hides_what_is_there() -> None:
    samples = looking(azimuth_deg() < 29.0)
    assert free_m(samples, 20.0) is None
    assert free_m(samples, 0.0) is not None


def test_a_wall_that_is_met_needs_no_look_behind_it() -> None:
    assert free_m(looking(range_m=1.5), 0.0) == pytest.approx(1.5 - PARAMS.radius_m, rel=0.15)


def test_samples_that_cannot_tell_near_from_far_look_through_nothing() -> None:
    assert free_m(looking(sigma=1.0), 0.0) is None


def test_what_is_near_may_go_on_to_the_next_sample_but_not_past_it() -> None:
    azimuth = azimuth_deg()
    near = (azimuth >= 10.0) & (azimuth <= 12.0)
    range_m = np.where(near, 1.0, FAR_M)
    bearing, away = np.radians([10.0]), np.array([1.0])
    told = looking(range_m=range_m)
    closed = reach_in_rad(told, bearing, away, 0.3, 2.0, math.radians(10.0))
    assert closed[0][0] == 0.0
    plain = looking((azimuth >= 10.0) | (azimuth <= 0.0), range_m).where((azimuth >= 10.0) | (azimuth <= 0.0))
    left, right = reach_in_rad(plain, bearing, away, 0.3, 2.0, math.radians(10.0))
    assert math.degrees(left[0]) == pytest.approx(10.0 - 3.4, abs=1.1)  # less the blur of its edge
    assert right[0] == 0.0
    far_left, _ = reach_in_rad(plain, bearing, np.array([5.0]), 0.3, 2.0, math.radians(10.0))
    assert far_left[0] == 0.0


def test_a_smooth_pillar_seen_at_one_side_blocks_the_way_beside_its_texture() -> None:
    azimuth = azimuth_deg()
    textured = (azimuth >= 25.0) & (azimuth <= 31.0)
    plain = (azimuth > 10.0) & (azimuth < 25.0)
    samples = looking(~plain, np.where(textured, 1.0, FAR_M))
    seen_whole = looking(None, np.where(textured, 1.0, FAR_M))
    beside = math.radians(2.0)
    open_way = void_map(seen_whole, PARAMS)
    assert open_way.free_m[open_way.at(beside)] > 3.0
    blocked = void_map(samples, PARAMS)
    assert blocked.free_m[blocked.at(beside)] < 1.0

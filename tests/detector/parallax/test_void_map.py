"""The void map against rooms whose free distances are known in closed form."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from detector.parallax.samples import RangedSamples
from detector.parallax.void_map import BINS, VoidMap, VoidMapParams, choose_gap, void_map

PARAMS = VoidMapParams()
FLOOR_M, CEILING_M = 1.2, 1.5


def rays(half_width_deg: float = 38.0, half_height_deg: float = 30.0) -> NDArray[np.float64]:
    """A grid of unit rays about north, one degree apart."""
    azimuth, elevation = np.meshgrid(
        np.radians(np.arange(-half_width_deg, half_width_deg + 0.5)),
        np.radians(np.arange(-half_height_deg, half_height_deg + 0.5)),
    )
    return np.column_stack(
        [
            (np.cos(elevation) * np.cos(azimuth)).ravel(),
            (np.cos(elevation) * np.sin(azimuth)).ravel(),
            np.sin(elevation).ravel(),
        ]
    )


def room(
    ahead_m: float, side_m: float, pillar: tuple[float, float, float] | None = None, *, sigma: float = 0.004
) -> RangedSamples:
    """Samples of a corridor with a wall at its end, floor, ceiling, and perhaps an upright pillar (north, east, radius)."""
    seen = rays()
    with np.errstate(divide="ignore"):
        inverse = np.maximum.reduce(
            [
                seen[:, 0] / ahead_m,
                np.abs(seen[:, 1]) / side_m,
                seen[:, 2] / FLOOR_M,
                -seen[:, 2] / CEILING_M,
            ]
        )
    if pillar is not None:
        north, east, radius = pillar
        level = np.hypot(seen[:, 0], seen[:, 1])
        along = (seen[:, 0] * north + seen[:, 1] * east) / level
        beside = (seen[:, 0] * east - seen[:, 1] * north) / level
        meets = (np.abs(beside) < radius) & (along > 0)
        away = (along - np.sqrt(np.maximum(radius**2 - beside**2, 0.0))) / level
        inverse = np.where(meets, np.maximum(inverse, 1.0 / np.maximum(away, 1e-3)), inverse)
    n = len(seen)
    return RangedSamples(seen, inverse, np.full(n, sigma), np.zeros((n, 2)), True, np.ones(n, np.bool_))


def with_only(samples: RangedSamples, keep: NDArray[np.bool_]) -> RangedSamples:
    return RangedSamples(
        samples.rays_level,
        samples.inverse_range,
        samples.sigma,
        samples.pixels_px,
        samples.metric,
        np.asarray(keep, np.bool_),
    )


def azimuth_deg(samples: RangedSamples) -> NDArray[np.float64]:
    return np.degrees(np.arctan2(samples.rays_level[:, 1], samples.rays_level[:, 0]))


def test_the_vehicle_stops_its_radius_before_a_wall() -> None:
    found = void_map(room(5.0, 3.0), PARAMS)
    assert found.free_m[found.at(0.0)] == pytest.approx(5.0 - PARAMS.radius_m, abs=0.15)
    assert found.metric
    assert found.count[found.at(0.0)] >= 3


@pytest.mark.parametrize("degrees", [-30.0, -20.0, 20.0, 30.0])
def test_beside_it_touches_the_wall_that_it_comes_nearest_to(degrees: float) -> None:
    found = void_map(room(9.0, 1.0), PARAMS)
    expected_m = (1.0 - PARAMS.radius_m) / math.sin(math.radians(abs(degrees)))
    assert found.free_m[found.at(math.radians(degrees))] == pytest.approx(expected_m, rel=0.12)


def test_a_pillar_blocks_as_wide_as_the_vehicle_is() -> None:
    pillar = (2.5, 0.0, 0.15)
    found = void_map(room(8.0, 4.0, pillar), PARAMS)
    blocked_rad = math.asin((PARAMS.radius_m + pillar[2]) / pillar[0])
    assert found.free_m[found.at(0.0)] == pytest.approx(2.5 - 0.15 - PARAMS.radius_m, abs=0.15)
    assert found.free_m[found.at(0.8 * blocked_rad)] < 2.6
    assert found.free_m[found.at(-0.8 * blocked_rad)] < 2.6
    assert found.free_m[found.at(blocked_rad + math.radians(3.0))] > 4.0


def test_floor_and_ceiling_are_no_obstacles_but_what_stands_at_flight_height_is() -> None:
    samples = room(9.0, 6.0)
    found = void_map(samples, PARAMS)
    assert found.free_m[found.at(0.0)] == pytest.approx(9.0 - PARAMS.radius_m, rel=0.05)
    tall = void_map(samples, VoidMapParams(half_height_m=FLOOR_M + 0.1))
    assert tall.free_m[tall.at(0.0)] < 3.0, "a vehicle that reaches the floor meets it"


def test_a_tilted_camera_changes_nothing_in_the_level_frame() -> None:
    samples = room(5.0, 3.0)
    level = void_map(samples, PARAMS)
    high = with_only(samples, samples.rays_level[:, 2] < math.sin(math.radians(12.0)))
    found = void_map(high, PARAMS)
    middle = np.abs(np.degrees(level.azimuth_rad)) < 20.0
    np.testing.assert_allclose(found.free_m[middle], level.free_m[middle], rtol=0.05)


def test_unknown_is_not_free() -> None:
    samples = room(5.0, 3.0)
    found = void_map(samples, PARAMS)
    behind = np.abs(np.degrees(found.azimuth_rad)) > 60.0
    assert not found.known[behind].any()
    assert (found.free_m[~found.known] == 0.0).all()
    assert np.isinf(found.sigma_m[~found.known]).all()
    nothing = void_map(with_only(samples, np.zeros(len(samples), np.bool_)), PARAMS)
    assert not nothing.known.any()
    assert choose_gap(nothing, PARAMS) is None
    assert not void_map(RangedSamples.none(metric=True), PARAMS).known.any()


@pytest.mark.parametrize(("width_deg", "is_bridged"), [(13.0, True), (30.0, False)])
def test_narrow_gaps_without_texture_are_bridged_and_wide_ones_are_not(
    width_deg: float, is_bridged: bool
) -> None:
    samples = room(5.0, 4.0)
    # A direction is known 4 degrees beyond its last sample, on both sides.
    found = void_map(with_only(samples, np.abs(azimuth_deg(samples)) >= width_deg / 2.0), PARAMS)
    assert bool(found.known[found.at(0.0)]) is is_bridged
    if is_bridged:
        edges = [found.free_m[found.at(math.radians(sign * width_deg / 2.0))] for sign in (-1, 1)]
        assert found.free_m[found.at(0.0)] <= min(edges) + 0.3
        assert found.count[found.at(0.0)] == 0, "bridged, not measured"


def test_two_samples_are_no_surface_and_three_are() -> None:
    samples = room(8.0, 4.0)
    ahead = np.flatnonzero(
        (np.abs(azimuth_deg(samples)) < 0.5)
        & (np.abs(samples.rays_level[:, 2]) < math.sin(math.radians(1.5)))
    )
    assert len(ahead) == 3
    for count, expected_m in ((2, 8.0), (3, 2.0)):
        inverse = samples.inverse_range.copy()
        inverse[ahead[:count]] = 0.5
        changed = RangedSamples(
            samples.rays_level, inverse, samples.sigma, samples.pixels_px, True, samples.informative
        )
        found = void_map(changed, PARAMS)
        assert found.free_m[found.at(0.0)] == pytest.approx(expected_m - PARAMS.radius_m, abs=0.3), count


def test_an_unresolved_sample_is_no_obstacle_and_lets_nothing_be_free_beyond_its_noise() -> None:
    samples = room(8.0, 4.0, sigma=0.5)
    found = void_map(samples, PARAMS)
    ahead = found.at(0.0)
    assert found.known[ahead]
    pooled = 0.5 / math.sqrt(found.count[ahead])
    assert found.free_m[ahead] <= 1.0 / (2.0 * pooled)


def test_no_scale_gives_the_same_map_in_baselines() -> None:
    samples = room(5.0, 3.0)
    baseline_m = 0.2
    without = RangedSamples(
        samples.rays_level,
        samples.inverse_range * baseline_m,
        samples.sigma * baseline_m,
        samples.pixels_px,
        False,
        samples.informative,
    )
    metric, bare = void_map(samples, PARAMS), void_map(without, PARAMS, baseline_m=baseline_m)
    assert not bare.metric
    np.testing.assert_array_equal(metric.known, bare.known)
    # Whether a sample is still of the same surface may be decided by the last digit.
    np.testing.assert_allclose(metric.free_m, bare.free_m * baseline_m, rtol=0.05)


def test_the_map_turns_with_the_level_frame() -> None:
    samples = room(6.0, 2.0, (3.0, 0.7, 0.2))
    turn = math.radians(170.0)
    rotation = np.array(
        [[math.cos(turn), -math.sin(turn), 0.0], [math.sin(turn), math.cos(turn), 0.0], [0.0, 0.0, 1.0]]
    )
    turned = RangedSamples(
        samples.rays_level @ rotation.T,
        samples.inverse_range,
        samples.sigma,
        samples.pixels_px,
        True,
        samples.informative,
    )
    expected, found = void_map(samples, PARAMS), void_map(turned, PARAMS)
    # Samples that lie exactly on a bin's edge may fall to either side.
    same = np.roll(expected.known, 170) == found.known
    assert np.count_nonzero(~same) <= 2
    np.testing.assert_allclose(np.roll(expected.free_m, 170)[same], found.free_m[same], rtol=0.02)


def profile(free_m: dict[range, float]) -> VoidMap:
    """A map from ranges of azimuths (deg) and their free distances."""
    found = VoidMap.unknown()
    free, known = found.free_m.copy(), found.known.copy()
    for degrees, metres in free_m.items():
        bins = np.array(degrees) % BINS
        free[bins], known[bins] = metres, True
    return VoidMap(
        found.azimuth_rad,
        free,
        np.where(known, 20, 0),
        np.where(known, 0.1, np.inf),
        known,
    )


def test_the_furthest_gap_is_answered_in_its_middle() -> None:
    found = profile({range(-30, -5): 2.0, range(-5, 16): 7.0, range(16, 31): 3.0})
    gap = choose_gap(found, PARAMS)
    assert gap is not None
    assert math.degrees(gap.azimuth_rad) == pytest.approx(5.0, abs=1.0)
    assert gap.free_m == 7.0
    assert 12.0 < math.degrees(gap.width_rad) < 24.0


def test_a_gap_across_the_seam_of_the_circle_has_its_middle_there() -> None:
    gap = choose_gap(profile({range(170, 195): 5.0, range(195, 220): 1.0}), PARAMS)
    assert gap is not None
    assert math.degrees(gap.azimuth_rad) % 360.0 == pytest.approx(182.0, abs=1.5)


def test_one_wild_bin_does_not_make_a_gap() -> None:
    gap = choose_gap(profile({range(-30, 0): 4.0, range(1): 14.0, range(1, 10): 2.0}), PARAMS)
    assert gap is not None
    assert math.degrees(gap.azimuth_rad) == pytest.approx(-15.0, abs=3.0)


def test_the_planners_direction_is_kept_where_it_is_free_far_enough() -> None:
    params = VoidMapParams(preference="least_deviation", free_enough_m=3.0)
    found = profile({range(-30, -10): 3.5, range(-10, 10): 1.0, range(10, 31): 8.0})

    def answered_deg(wanted_deg: float) -> float:
        gap = choose_gap(found, params, wanted_rad=math.radians(wanted_deg))
        assert gap is not None
        return math.degrees(gap.azimuth_rad)

    assert answered_deg(-20.0) == pytest.approx(-20.0)
    assert answered_deg(-2.0) == pytest.approx(-12.0, abs=2.5), "the free direction nearest to it"
    blocked = VoidMapParams(preference="least_deviation", free_enough_m=12.0)
    gap = choose_gap(found, blocked, wanted_rad=0.0)
    assert gap is not None
    assert math.degrees(gap.azimuth_rad) == pytest.approx(20.0, abs=2.0), "none is free enough: the furthest"


def test_shapes_are_checked() -> None:
    found = VoidMap.unknown()
    with pytest.raises(ValueError, match="free_m: expected"):
        VoidMap(found.azimuth_rad, found.free_m[:5], found.count, found.sigma_m, found.known)

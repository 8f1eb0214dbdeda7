"""Locations to start from: no more than is needed, spread as SIFT spreads them, renewed where they were lost."""

import cv2
import numpy as np
import pytest

from detector.features import feature_locations
from detector.params import DetectorParams
from detector.seeds import SeedFinder


def texture(width: int = 640, height: int = 480, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    fine = rng.integers(0, 255, (height, width)).astype(np.float32)
    coarse = cv2.resize(rng.integers(0, 255, (height // 8, width // 8)).astype(np.float32), (width, height))
    return np.clip(0.5 * cv2.GaussianBlur(fine, (0, 0), 1.5) + 0.5 * coarse, 0, 255).astype(np.uint8)


def finder(**settings: int) -> SeedFinder:
    return SeedFinder(DetectorParams.preset("paper", **settings))


def in_quarters(points: np.ndarray, width: int, height: int) -> np.ndarray:
    return np.histogram2d(points[:, 0], points[:, 1], bins=(4, 4), range=((0, width), (0, height)))[0]


def distance_to_nearest(points: np.ndarray, others: np.ndarray) -> np.ndarray:
    return np.min(np.linalg.norm(points[:, None, :] - others[None, :, :], axis=2), axis=1)


def test_a_frame_with_few_key_points_gives_all_of_them() -> None:
    image = texture()
    everything = feature_locations(image)
    found, number = finder(fast_first_points=100_000).find(image)
    assert number == len(found) == len(everything)
    np.testing.assert_array_equal(found, everything)


def test_too_many_are_thinned_and_their_density_stays() -> None:
    image = texture()
    image[:, :320] = cv2.GaussianBlur(image[:, :320], (0, 0), 2.5)  # fewer key points there
    everything = feature_locations(image)
    found, number = finder(fast_first_points=400).find(image)
    assert number == len(everything) > 800
    assert len(found) == 400
    assert distance_to_nearest(found, everything).max() == 0.0
    expected = in_quarters(everything, 640, 480) * 400 / len(everything)
    # Taken from a list that keeps neighbours together: nearer to the exact share than chance, which would miss by 4 on average.
    assert np.abs(in_quarters(found, 640, 480) - expected).mean() < 2.0


def test_a_large_frame_looked_at_in_blocks_gives_nearly_the_same_locations() -> None:
    image = texture(1280, 720)
    everything = feature_locations(image)
    found, _ = finder(fast_first_points=100_000).find(image)
    assert abs(len(found) - len(everything)) < 0.02 * len(everything)
    assert np.mean(distance_to_nearest(found[::20], everything) < 0.5) > 0.97


@pytest.mark.parametrize("least", [100, 400])
def test_counting_stops_as_soon_as_there_are_enough(least: int) -> None:
    assert finder().count(texture(), least) >= least


def test_counting_what_has_too_few_is_counting_all() -> None:
    image = np.full((480, 640), 90, np.uint8)
    cv2.circle(image, (300, 200), 8, 200, cv2.FILLED)
    assert finder().count(image, 100) == len(feature_locations(image)) < 100


def test_what_was_followed_is_carried_and_what_was_lost_is_looked_for_again() -> None:
    image = texture()
    seeds = finder(fast_points=500, fast_tiles=4)
    found, _ = seeds.find(image)
    lost = (found[:, 0] < 160) & (found[:, 1] < 160)  # 2 x 2 tiles of 80 px
    renewed = seeds.renew(image, found[~lost])
    assert renewed is not None
    everything = feature_locations(image)
    assert distance_to_nearest(renewed, everything).max() < 1.0  # carried, or found anew
    there = (renewed[:, 0] < 160) & (renewed[:, 1] < 160)
    assert there.sum() > 0.5 * lost.sum() * 500 / len(found)


def test_renewing_keeps_the_number_and_the_density_over_many_frames() -> None:
    image = texture(seed=3)
    seeds = finder(fast_points=500, fast_tiles=4)
    points, _ = seeds.find(image)
    rng = np.random.default_rng(0)
    for _ in range(60):
        renewed = seeds.renew(image, points[rng.random(len(points)) < 0.95])
        assert renewed is not None
        points = renewed
    assert 400 <= len(points) <= 600
    everything = feature_locations(image)
    expected = in_quarters(everything, 640, 480) * len(points) / len(everything)
    assert np.abs(in_quarters(points, 640, 480) - expected).max() < 0.5 * expected.mean()


def test_each_tile_has_its_turn_even_where_nothing_was_lost() -> None:
    image = texture()
    seeds = finder(fast_points=500, fast_tiles=1)
    points, _ = seeds.find(image)
    old = points[:500] + 0.25  # places that SIFT never gives: they show what has not been renewed
    for _ in range(48):
        renewed = seeds.renew(image, old)
        assert renewed is not None
        old = renewed
    assert not np.any(np.isclose(distance_to_nearest(old, points), np.hypot(0.25, 0.25)))


def test_with_most_of_them_lost_the_whole_frame_is_asked_for() -> None:
    image = texture()
    seeds = finder(fast_points=500, fast_tiles=1)
    found, _ = seeds.find(image)
    assert seeds.renew(image, found[:40]) is None


def test_nothing_found_and_nothing_carried_is_no_error() -> None:
    seeds = finder()
    blank = np.full((480, 640), 90, np.uint8)
    found, number = seeds.find(blank)
    assert found.shape == (0, 2)
    assert number == 0
    assert seeds.renew(blank, found) is None, "it is looked at whole again"


def test_after_the_scene_was_forgotten_few_carried_ones_do_not_stand_for_the_whole_frame() -> None:
    image = texture()
    seeds = finder(fast_points=500, fast_tiles=1)
    found, _ = seeds.find(image)
    seeds.reset()
    assert seeds.renew(image, found[:40]) is None

from __future__ import annotations

import cv2
import numpy as np
import pytest

from detector.features import feature_locations


def spots(places: list[tuple[int, int]], radius: int = 6) -> np.ndarray:
    image = np.full((240, 320), 60, np.uint8)
    for place in places:
        cv2.circle(image, place, radius, 220, cv2.FILLED, cv2.LINE_AA)
    return image


def test_a_spot_is_found_at_its_middle_x_before_y() -> None:
    found = feature_locations(spots([(200, 90)]), unique=True)
    assert found.dtype == np.float32
    assert np.linalg.norm(found - [200.0, 90.0], axis=1).min() < 0.5


def test_the_order_is_that_of_every_call_and_of_the_repeated_locations() -> None:
    image = spots([(40, 40), (160, 90), (250, 180), (90, 200)])
    every, once = feature_locations(image), feature_locations(image, unique=True)
    np.testing.assert_array_equal(every, feature_locations(image))
    first_seen = list(dict.fromkeys(map(tuple, every.tolist())))
    assert list(map(tuple, once.tolist())) == first_seen


def test_a_larger_contrast_threshold_finds_fewer() -> None:
    noisy = cv2.GaussianBlur(
        np.random.default_rng(0).integers(60, 200, (240, 320), dtype=np.uint8), (0, 0), 2.0
    )
    counts = [len(feature_locations(noisy, contrast=contrast)) for contrast in (0.01, 0.04, 0.12)]
    assert counts == sorted(counts, reverse=True)
    assert counts[0] > counts[-1]


@pytest.mark.parametrize("shape", [(1, 1), (1, 64), (5, 5)])
def test_tiny_images_have_none(shape: tuple[int, int]) -> None:
    assert feature_locations(np.full(shape, 80, np.uint8)).shape == (0, 2)

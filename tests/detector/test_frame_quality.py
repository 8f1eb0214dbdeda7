from __future__ import annotations

import cv2
import numpy as np
import pytest

from detector.frame_quality import frame_fault, perceptual_blur
from detector.params import DetectorParams
from detector.results import NoDetectionReason

PARAMS = DetectorParams.preset("paper")


def sharp(height: int = 240, width: int = 320, seed: int = 3) -> np.ndarray:
    """Return squares of all sizes and greys: hard edges at every scale."""
    rng = np.random.default_rng(seed)
    image = np.full((height, width), 120, np.uint8)
    for _ in range(width * height // 150):
        x, y, side = int(rng.integers(width)), int(rng.integers(height)), int(rng.integers(3, 30))
        cv2.rectangle(image, (x, y), (x + side, y + side), int(rng.integers(20, 235)), cv2.FILLED)
    return image


def reason_of(image: np.ndarray, params: DetectorParams = PARAMS) -> NoDetectionReason | None:
    fault = frame_fault(image, params)
    return None if fault is None else fault.reason


def test_a_good_frame_has_no_fault() -> None:
    assert frame_fault(sharp(), PARAMS) is None


def test_the_least_size_is_enough_and_one_less_is_not() -> None:
    assert reason_of(sharp(48, 64)) is None
    assert reason_of(sharp(48, 63)) is NoDetectionReason.WRONG_SIZE
    assert reason_of(sharp(47, 64)) is NoDetectionReason.WRONG_SIZE
    fault = frame_fault(sharp(47, 64), PARAMS)
    assert fault is not None
    assert fault.detail == "64 x 47 px, at least 64 x 48 needed"


def test_black_is_when_hardly_a_pixel_is_bright() -> None:
    image = np.zeros((240, 320), np.uint8)
    assert reason_of(image) is NoDetectionReason.BLACK
    image[:4] = 200  # 1.7 % of the pixels: a lamp in a dark hall
    assert reason_of(image) is NoDetectionReason.BLACK
    image[:12] = sharp(12, 320)
    assert reason_of(image) is not NoDetectionReason.BLACK


def test_dim_but_structured_is_not_black() -> None:
    assert reason_of((sharp() // 5).astype(np.uint8)) is None


def test_saturated_is_when_more_than_half_is() -> None:
    image = sharp()
    image[:119] = 255
    assert reason_of(image) is None
    image[:122] = 255
    assert reason_of(image) is NoDetectionReason.SATURATED
    image[image == 255] = 250  # the limit itself counts
    assert reason_of(image) is NoDetectionReason.SATURATED
    image[image == 250] = 249
    assert reason_of(image) is not NoDetectionReason.SATURATED


@pytest.mark.parametrize("kernel", [(25, 1), (1, 25), (15, 15)], ids=["sideways", "up and down", "focus"])
def test_blur_along_either_axis_or_both_is_seen(kernel: tuple[int, int]) -> None:
    assert reason_of(cv2.blur(sharp(), kernel)) is NoDetectionReason.BLURRED


def test_the_blur_limit_decides_and_1_never_refuses() -> None:
    image = cv2.blur(sharp(), (25, 25))
    blur = perceptual_blur(image)
    assert reason_of(image, DetectorParams(blur_limit=blur + 0.01)) is None
    assert reason_of(image, DetectorParams(blur_limit=blur - 0.01)) is NoDetectionReason.BLURRED
    assert reason_of(image, DetectorParams(blur_limit=1.0)) is None


def test_more_blur_measures_more_and_it_stays_in_0_to_1() -> None:
    values = [perceptual_blur(cv2.GaussianBlur(sharp(), (0, 0), sigma)) for sigma in (0.5, 1, 2, 4, 8)]
    assert values == sorted(values)
    assert values[-1] - values[0] > 0.3
    assert all(0.0 <= value <= 1.0 for value in values)


def test_neither_contrast_nor_brightness_is_blur() -> None:
    flat = (sharp() // 4 + 90).astype(np.uint8)
    assert perceptual_blur(flat) == pytest.approx(perceptual_blur(sharp()), abs=0.02)


def test_a_plain_image_is_not_blurred_but_empty() -> None:
    assert perceptual_blur(np.full((240, 320), 90, np.uint8)) == 0.0


def test_a_large_image_is_judged_at_a_smaller_size() -> None:
    image = sharp(480, 640)
    larger = cv2.resize(image, (1920, 1440), interpolation=cv2.INTER_LINEAR)
    assert perceptual_blur(larger) == pytest.approx(perceptual_blur(image), abs=0.1)
    assert reason_of(larger) is None

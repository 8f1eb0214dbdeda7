"""The vanishing point of drawn lines."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from detector.parallax.line_vp import line_segments, line_vanishing_point, meeting_point


def corridor(vanishing: tuple[float, float], size: tuple[int, int] = (480, 360)) -> NDArray[np.uint8]:
    """A corridor's edges: four and some tiles that run to a point, uprights and levels that do not."""
    width, height = size
    image = np.full((height, width), 110, np.uint8)
    rng = np.random.default_rng(3)
    x, y = vanishing
    edges = [
        (0, 0),
        (width, 0),
        (0, height),
        (width, height),
        (width // 3, height),
        (2 * width // 3, height),
        (0, height // 3),
        (width, height // 4),
    ]
    for edge_x, edge_y in edges:
        start = (round(x + 0.25 * (edge_x - x)), round(y + 0.25 * (edge_y - y)))
        cv2.line(image, start, (edge_x, edge_y), 220, 2, cv2.LINE_AA)
    for at in (0.2, 0.4, 0.8):
        cv2.line(image, (round(at * width), 40), (round(at * width), height - 60), 30, 2, cv2.LINE_AA)
        cv2.line(image, (40, round(at * height)), (width - 40, round(at * height)), 30, 2, cv2.LINE_AA)
    noise = rng.normal(0.0, 3.0, image.shape)
    return np.asarray(np.clip(image + noise, 0, 255), np.uint8)


@pytest.mark.parametrize("at", [(240.0, 150.0), (150.0, 190.0), (400.0, 120.0)])
def test_the_lines_of_a_corridor_meet_where_they_were_drawn_to(at: tuple[float, float]) -> None:
    found = line_vanishing_point(corridor(at))
    assert found is not None
    assert (found.x_px, found.y_px) == pytest.approx(at, abs=4.0)
    assert found.sigma_px < 20.0
    assert len(found.segments_px) >= 5
    assert 0.3 < found.share <= 1.0


def exact_segments(
    at: NDArray[np.float64], angles_deg: list[float], noise_px: float, seed: int
) -> NDArray[np.float64]:
    rng = np.random.default_rng(seed)
    rows = []
    for angle in np.radians(angles_deg):
        along = np.array([np.cos(angle), np.sin(angle)])
        near, far = 60.0, 160.0
        ends = at + np.outer([near, far], along) + rng.normal(0.0, noise_px, (2, 2))
        rows.append(ends.ravel())
    return np.array(rows)


def test_its_covariance_says_how_wrong_it_may_be() -> None:
    at = np.array([300.0, 200.0])
    angles = [20.0, 35.0, 50.0, 140.0, 155.0, 200.0, 220.0, 320.0, 340.0]
    errors = []
    for seed in range(60):
        found = meeting_point(exact_segments(at, angles, 0.8, seed), (640, 480))
        assert found is not None
        error = np.array([found.x_px, found.y_px]) - at
        errors.append(float(error @ np.linalg.solve(found.covariance_px2, error)))
    # Two degrees of freedom: a mean of 2 where the covariance is right.
    assert 0.5 < np.mean(errors) < 5.0


def test_a_bundle_of_nearly_parallel_lines_is_uncertain_along_itself() -> None:
    at = np.array([320.0, 240.0])
    wide = meeting_point(exact_segments(at, [20.0, 60.0, 120.0, 160.0, 220.0, 320.0], 0.3, 1), (640, 480))
    narrow = meeting_point(exact_segments(at, [20.0, 23.0, 26.0, 29.0, 32.0, 35.0], 0.3, 1), (640, 480))
    assert wide is not None
    assert narrow is not None
    assert narrow.sigma_px > 2.0 * wide.sigma_px


def test_no_lines_no_point() -> None:
    plain = np.full((240, 320), 128, np.uint8)
    assert len(line_segments(plain)) == 0
    assert line_vanishing_point(plain) is None


def test_lines_that_meet_nowhere_give_no_point() -> None:
    levels = np.array([[20.0, 40.0 * k, 600.0, 40.0 * k + 1.0] for k in range(1, 10)])
    assert meeting_point(levels, (640, 480)) is None
    uprights = levels[:, [1, 0, 3, 2]]
    assert meeting_point(uprights, (640, 480)) is None

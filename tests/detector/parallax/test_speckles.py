"""What is called near has to fill as much of the picture as something near does."""

from __future__ import annotations

import numpy as np
import pytest

from detector.parallax.speckles import lonely

FOCAL_PX = 417.0
COLUMN, ROW = np.meshgrid(np.arange(4.0, 640.0, 8.0), np.arange(4.0, 480.0, 8.0))
POINTS_PX = np.column_stack([COLUMN.ravel(), ROW.ravel()])
FAR = 0.05


def scene(*, at: tuple[int, int], size: tuple[int, int], inverse: float) -> np.ndarray:
    depth = np.full(COLUMN.shape, FAR)
    depth[at[0] : at[0] + size[0], at[1] : at[1] + size[1]] = inverse
    return depth.ravel()


EVERYWHERE = np.ones(len(POINTS_PX), np.bool_)


def test_three_samples_at_arm_s_length_are_an_error() -> None:
    inverse = scene(at=(20, 30), size=(1, 3), inverse=0.8)
    assert np.array_equal(lonely(POINTS_PX, inverse, EVERYWHERE, FOCAL_PX), inverse > FAR)


def test_a_pole_at_arm_s_length_is_none() -> None:
    inverse = scene(at=(0, 30), size=(60, 2), inverse=0.5)
    assert not lonely(POINTS_PX, inverse, EVERYWHERE, FOCAL_PX).any()


def test_the_same_three_samples_far_off_may_be_there() -> None:
    inverse = scene(at=(20, 30), size=(1, 3), inverse=0.18)
    assert not lonely(POINTS_PX, inverse, EVERYWHERE, FOCAL_PX).any()


def test_a_wall_that_comes_near_at_its_end_is_one_surface() -> None:
    inverse = np.interp(COLUMN, [0.0, 600.0, 640.0], [0.1, 0.5, 0.7]).ravel()
    assert not lonely(POINTS_PX, inverse, EVERYWHERE, FOCAL_PX).any()


def test_a_near_surface_of_which_every_second_place_is_plain_holds_together() -> None:
    inverse = scene(at=(10, 30), size=(20, 20), inverse=0.5)
    told = ((COLUMN // 8 + ROW // 8) % 2 == 0).ravel()
    assert not lonely(POINTS_PX, inverse, told, FOCAL_PX).any()


@pytest.mark.parametrize("count", [0, 1, 5])
def test_few_samples_are_no_misuse(count: int) -> None:
    found = lonely(POINTS_PX[:count], np.full(count, 0.9), np.ones(count, np.bool_), FOCAL_PX)
    assert found.shape == (count,)

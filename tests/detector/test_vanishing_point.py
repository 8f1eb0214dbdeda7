"""Segments that meet in a known point; single cases are in test_steps."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from detector.vanishing_point import candidates, fullest_cell, intersections, nearest_centre

SIZE = (640, 480)
coordinate = st.floats(5.0, 475.0)


def towards(x: float, y: float, betas_deg: list[float], near_px: float = 80.0) -> np.ndarray:
    """Return segments of 100 px, below the point, whose lines go through it."""
    beta = np.radians(betas_deg)
    ray = np.column_stack([np.cos(beta), np.sin(beta)])
    return np.column_stack([[x, y] + near_px * ray, [x, y] + (near_px + 100.0) * ray])


@settings(max_examples=60)
@given(x=coordinate, y=coordinate, first=st.floats(42.0, 100.0), apart=st.floats(5.5, 14.5))
def test_two_lines_meet_where_they_were_made_to(x: float, y: float, first: float, apart: float) -> None:
    found = intersections(towards(x, y, [first, first + apart]))
    np.testing.assert_allclose(found, [[x, y]], atol=1e-6)


@settings(max_examples=60)
@given(x=coordinate, y=coordinate)
def test_the_candidate_is_the_middle_of_the_cell_of_the_point(x: float, y: float) -> None:
    segments = towards(x, y, [50.0, 60.0, 70.0, 80.0, 110.0, 120.0])
    found = candidates(segments, np.array([[320.0, 240.0]]), SIZE)
    assert found.shape == (1, 2)
    assert (found % 10.0 == 5.0).all()
    assert np.abs(found[0] - [x, y]).max() <= 5.0 + 1e-6


def test_every_pair_counts_once() -> None:
    assert len(intersections(towards(300.0, 100.0, [60.0, 68.0, 76.0]))) == 2  # 8, 8; 16 is too far apart
    assert len(intersections(towards(300.0, 100.0, [60.0, 66.0, 72.0]))) == 3


def test_parallels_do_not_meet_even_where_the_gate_lets_them_through() -> None:
    parallels = np.array([[0.0, 0, 10, 10], [50, 0, 60, 10]])
    assert len(intersections(parallels, min_deg=-1.0)) == 0


def test_the_fuller_cell_wins_over_the_nearer() -> None:
    points = np.array([[105.0, 105], [303, 303], [307, 307]])
    found = fullest_cell(points, SIZE, np.array([105.0, 105.0]))
    assert found is not None
    assert found.tolist() == [305.0, 305.0]


def test_cells_begin_at_whole_tens_and_the_image_ends_at_its_size() -> None:
    near = np.zeros(2)
    at = {point: fullest_cell(np.array([point]), SIZE, near) for point in ((0.0, 0.0), (9.99, 10.0))}
    assert at[(0.0, 0.0)] == pytest.approx([5.0, 5.0])
    assert at[(9.99, 10.0)] == pytest.approx([5.0, 15.0])
    for outside in ((640.0, 5.0), (5.0, 480.0), (-0.01, 5.0), (5.0, -0.01)):
        assert fullest_cell(np.array([outside]), SIZE, near) is None
    for inside in ((639.9, 5.0), (5.0, 479.9)):
        assert fullest_cell(np.array([inside]), SIZE, near) is not None


def test_another_cell_size_is_another_grid() -> None:
    found = fullest_cell(np.array([[33.0, 47.0]]), SIZE, np.zeros(2), cell_px=25.0)
    assert found == pytest.approx([37.5, 37.5])


def test_lines_of_two_groups_never_meet() -> None:
    left, right = towards(320.0, 10.0, [110.0], 200.0), towards(320.0, 10.0, [100.0], 200.0)
    segments = np.vstack([left, right])
    assert len(candidates(segments, np.array([[320.0, 240.0]]), SIZE)) == 1
    centres = np.array([(s[:2] + s[2:]) / 2 for s in segments])
    assert len(candidates(segments, centres, SIZE)) == 0


def test_a_line_belongs_to_the_centre_nearest_to_its_middle() -> None:
    segments = np.array([[0.0, 0, 100, 0], [0, 0, 10, 0]])
    centres = np.array([[0.0, 0.0], [60.0, 0.0]])
    assert nearest_centre(segments, centres).tolist() == [1, 0]


def test_without_lines_or_centres_there_is_no_candidate() -> None:
    assert candidates(np.zeros((0, 4)), np.zeros((3, 2)), SIZE).shape == (0, 2)
    assert candidates(towards(320, 10, [60, 70]), np.zeros((0, 2)), SIZE).shape == (0, 2)
    assert candidates(towards(320, 10, [60]), np.zeros((1, 2)), SIZE).shape == (0, 2)

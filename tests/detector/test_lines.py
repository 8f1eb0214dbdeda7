"""Segments drawn at known places and angles; single cases are in test_steps."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from detector.lines import AngleGate, HoughSettings, angles_deg, edges, find_segments, gate, lower_half_lines

SETTINGS = HoughSettings(votes=40, min_length_px=30.0, max_gap_px=5.0)


def drawn(angle_deg: float, middle: tuple[int, int] = (240, 240), half_length_px: float = 60.0) -> np.ndarray:
    image = np.full((320, 480), 90, np.uint8)
    x, y = (
        half_length_px * math.cos(math.radians(angle_deg)),
        half_length_px * math.sin(math.radians(angle_deg)),
    )
    start, end = (
        (round(middle[0] - x), round(middle[1] - y)),
        (round(middle[0] + x), round(middle[1] + y)),
    )
    cv2.line(image, start, end, 210, 5, cv2.LINE_AA)
    return image


@pytest.mark.parametrize("angle_deg", [45, 60, 75, 90, 105, 120, 135])
def test_a_drawn_line_is_found_where_and_as_it_is(angle_deg: int) -> None:
    found, total, _ = lower_half_lines(drawn(angle_deg), SETTINGS, AngleGate())
    assert 0 < len(found) <= total
    beta = angles_deg(found)
    assert np.abs(beta - angle_deg).max() < 3.0
    normal = np.array([-math.sin(math.radians(angle_deg)), math.cos(math.radians(angle_deg))])
    aside = (found.reshape(-1, 2) - [240.0, 240.0]) @ normal
    assert np.abs(aside).max() < 6.0  # the two edges of a stroke 5 px wide


@pytest.mark.parametrize("angle_deg", [0, 20, 35, 145, 160])
def test_flat_lines_are_found_and_left_out(angle_deg: int) -> None:
    found, total, _ = lower_half_lines(drawn(angle_deg), SETTINGS, AngleGate())
    assert len(found) == 0
    assert total > 0


def test_an_odd_height_begins_the_lower_half_at_the_lesser_row() -> None:
    image = np.full((321, 480), 90, np.uint8)
    image[160:, 200:] = 210
    found, *_ = lower_half_lines(image, SETTINGS, AngleGate())
    assert found[:, [1, 3]].min() >= 160
    assert found[:, [1, 3]].max() <= 320
    assert found[:, [1, 3]].max() >= 318


def test_segments_are_moved_down_by_where_the_region_begins() -> None:
    edge_image = np.zeros((100, 200), np.uint8)
    edge_image[:, 50] = 255
    at_0, at_70 = (find_segments(edge_image, top, SETTINGS) for top in (0, 70))
    np.testing.assert_array_equal(at_70 - at_0, np.tile([0.0, 70.0, 0.0, 70.0], (len(at_0), 1)))
    assert set(at_0[:, [0, 2]].ravel()) == {50.0}


def test_edges_depend_on_contrast_relative_to_the_median_grey() -> None:
    bright, dark = np.full((80, 120), 200, np.uint8), np.full((80, 120), 40, np.uint8)
    for image in (bright, dark):
        image[:, 60:] += 30
    assert not edges(bright).any()
    assert edges(dark).any()
    assert edges(bright, 0.1, 0.2).any()


@given(
    x=st.integers(-500, 500),
    y=st.integers(-500, 500),
    dx=st.integers(-300, 300),
    dy=st.integers(-300, 300),
)
def test_the_angle_of_a_segment_does_not_depend_on_its_direction(x: int, y: int, dx: int, dy: int) -> None:
    if dx == dy == 0:
        return
    forth, back = angles_deg(np.array([[x, y, x + dx, y + dy], [x + dx, y + dy, x, y]], np.float64))
    assert 0.0 <= forth < 180.0
    assert forth == pytest.approx(back)
    radians = math.radians(forth)
    assert dx * math.sin(radians) == pytest.approx(dy * math.cos(radians), abs=1e-6)


@given(tenths=st.integers(0, 1799))
def test_the_gate_is_strict_at_both_ends(tenths: int) -> None:
    # Angles as exact directions are awkward at the limits themselves: 45 and 135 are exact.
    beta = math.radians(tenths / 10.0)
    segment = np.array([[0.0, 0.0, 100.0 * math.cos(beta), 100.0 * math.sin(beta)]])
    if tenths not in (400, 1400):
        assert gate(segment, AngleGate())[0] == (400 < tenths < 1400)
    if abs(tenths - 900) != 100:
        expected = 400 < tenths < 1400 and abs(tenths - 900) > 100
        if tenths not in (400, 1400):
            assert gate(segment, AngleGate(vertical_gap_deg=10.0))[0] == expected


def test_the_gate_leaves_its_own_limits_out() -> None:
    diagonals = np.array([[0.0, 0, 10, 10], [0, 0, -10, 10]])  # 45 and 135 degrees
    assert gate(diagonals, AngleGate(45.0, 135.0)).tolist() == [False, False]
    assert gate(diagonals, AngleGate(44.9, 135.1)).tolist() == [True, True]


def test_a_wanted_number_that_no_votes_reach_gives_all_there_is() -> None:
    image = drawn(60)
    plenty, *_ = lower_half_lines(image, HoughSettings(5, 30.0, 5.0), AngleGate())
    wanted, *_ = lower_half_lines(image, SETTINGS, AngleGate(), wanted=500)
    np.testing.assert_array_equal(wanted, plenty)

"""The pictures of the void map say what the map says."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from detector.camera_model import CameraModel
from detector.drawing.reliability import draw_reliability
from detector.drawing.void_map import draw_map_from_above, draw_map_over, range_colour
from detector.parallax.confidence import ReliabilityBin
from detector.parallax.void_map import VoidMap, VoidMapParams, choose_gap

CAMERA = CameraModel.from_hfov(320, 240, 70.0)
LEVEL = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""Camera looks north, level."""


def half_known() -> VoidMap:
    """Free for 2 m to the left, 6 m to the right up to 20 degrees, unknown beyond."""
    empty = VoidMap.unknown()
    degrees = np.degrees(empty.azimuth_rad)
    known = (degrees >= -34.0) & (degrees <= 20.0)
    free = np.where(known, np.where(degrees < 0.0, 2.0, 6.0), 0.0)
    return VoidMap(empty.azimuth_rad, free, np.where(known, 9, 0), np.where(known, 0.1, np.inf), known)


def share_of(picture: NDArray[np.uint8], colour: tuple[int, int, int]) -> float:
    return float((np.abs(picture.astype(int) - colour).max(axis=-1) <= 12).mean())


def test_near_and_far_differ_in_colour_and_grow_evenly() -> None:
    colours = [np.array(range_colour(metres), float) for metres in (0.3, 0.7, 1.0, 2.0, 4.0, 8.0, 30.0)]
    assert tuple(colours[0]) == tuple(colours[1])
    assert tuple(colours[-2]) == tuple(colours[-1])
    reds = [colour[2] for colour in colours]
    blues = [colour[0] for colour in colours]
    assert reds[0] > reds[-1]
    assert blues[0] < blues[-1]


def test_over_the_image_each_side_has_its_colour_and_the_unknown_none() -> None:
    image = np.full((240, 320), 128, np.uint8)
    picture = draw_map_over(image, half_known(), CAMERA, LEVEL)
    assert picture.shape == (240, 320, 3)
    strip = picture[122:130]
    assert share_of(strip[:, :150], range_colour(2.0)) > 0.8
    assert share_of(strip[:, 175:235], range_colour(6.0)) > 0.8
    for metres in (2.0, 6.0):
        assert share_of(strip[:, 270:], range_colour(metres)) == 0.0
    assert np.array_equal(picture[:60], picture[:60, :1].repeat(320, axis=1)), "nothing off the horizon"


def test_a_camera_that_looks_down_sees_no_map() -> None:
    down = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    image = np.full((240, 320), 128, np.uint8)
    picture = draw_map_over(image, half_known(), CAMERA, down)
    assert (picture == picture[0, 0]).all()


def test_from_above_left_is_left_and_the_heading_points_up() -> None:
    found = half_known()
    picture = draw_map_from_above(found, size_px=400, reach_m=8.0)
    left, right = picture[:190, :195], picture[:190, 205:]
    assert share_of(left, range_colour(2.0)) > 3 * share_of(right, range_colour(2.0))
    assert share_of(right, range_colour(6.0)) > 0.02
    assert share_of(picture[210:], range_colour(6.0)) == 0.0, "nothing is known behind"
    turned = draw_map_from_above(found, heading_rad=math.pi / 2, size_px=400, reach_m=8.0)
    assert share_of(turned[:195, :195], range_colour(6.0)) > 0.02, "what was ahead is to the left now"


@pytest.mark.parametrize("with_gap", [True, False])
def test_the_answer_is_drawn_where_there_is_one(with_gap: bool) -> None:
    found = half_known()
    gap = choose_gap(found, VoidMapParams()) if with_gap else None
    image = np.full((240, 320), 128, np.uint8)
    over = draw_map_over(image, found, CAMERA, LEVEL, gap=gap)
    assert bool((over == 255).all(axis=-1).any()) is with_gap
    above = draw_map_from_above(found, gap=gap, confidence=0.5 if with_gap else None)
    bare = draw_map_from_above(found)
    assert bool((above != bare).any()) is with_gap


def test_the_reliability_diagram_shows_every_bin() -> None:
    parts = (ReliabilityBin(0.3, 0.2, 40), ReliabilityBin(0.9, 0.95, 40))
    picture = draw_reliability(parts)
    assert picture.shape == (520, 620, 3)
    assert (picture != draw_reliability(parts[:1])).any()

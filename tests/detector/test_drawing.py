"""Charts and figures: what is drawn stands where its value is, and the figures show what the steps found."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from detector.drawing import sheet
from detector.drawing.chart import Bars, Chart, Rule, Series, draw_chart, nice_ticks, tick_text
from detector.drawing.figures import figures
from detector.drawing.palette import (
    BLUE,
    CHART_BLUE,
    CHART_GREEN,
    CHART_VERMILLION,
    RED,
    YELLOW,
    magnitude_colours,
)
from detector.drawing.text import put_text
from detector.params import DetectorParams
from detector.report import Pair, examine

PAIRS = Path(__file__).parents[1] / "data" / "pairs"
PANEL_PX = 720
MARGIN_PX = 16


def places(picture, colour):
    """Return the (N, 2) x, y of the pixels of a colour."""
    rows, columns = np.nonzero((picture == np.array(colour, np.uint8)).all(axis=2))
    return np.column_stack([columns, rows])


# ---------------------------------------------------------------------- charts


@given(low=st.floats(-1e6, 1e6), span=st.floats(1e-3, 1e6), wanted=st.integers(2, 12))
def test_ticks_are_round_lie_on_the_axis_and_are_about_as_many_as_wanted(low, span, wanted):
    ticks = nice_ticks(low, low + span, wanted)
    assert all(low - 1e-6 * span <= tick <= low + span + 1e-6 * span for tick in ticks)
    assert len(ticks) <= 1.05 * wanted + 1
    if len(ticks) > 1:
        step = ticks[1] - ticks[0]
        assert float(f"{step:.1e}"[0]) in (1, 2, 5, 9), "9: 0.99999 of the next power"


def test_ticks_of_a_count_are_whole_numbers_and_an_axis_without_length_has_one():
    assert nice_ticks(2, 15, 12, whole=True) == [2, 4, 6, 8, 10, 12, 14]
    assert nice_ticks(0.4, 3.6, 12, whole=True) == [1, 2, 3]
    assert nice_ticks(3.0, 3.0) == [3.0]
    assert tick_text(-0.0) == "0"


def test_a_larger_value_stands_higher_and_in_proportion():
    x = np.array([0.0, 1.0, 2.0])
    chart = Chart("t", "x", "y", series=(Series(x, np.array([0.0, 5.0, 10.0]), CHART_BLUE, thickness=0),))
    at = places(draw_chart(chart, 500, 300), CHART_BLUE)
    middles = [at[np.abs(at[:, 0] - column) < 12].mean(axis=0) for column in np.unique(at[:, 0])[[5, -6]]]
    across = np.sort([at[:, 0].min(), at[:, 0].max()])
    centre = at[np.abs(at[:, 0] - across.mean()) < 10].mean(axis=0)
    assert middles[0][1] > centre[1] > middles[1][1]
    assert centre[1] == pytest.approx((middles[0][1] + middles[1][1]) / 2, abs=1.5)


def test_bars_stand_on_each_other_and_what_is_not_a_number_is_left_out():
    left, right = np.array([0.0, 1.0]), np.array([1.0, 2.0])
    lower = Bars(left, right, np.array([4.0, 0.0]), CHART_BLUE)
    upper = Bars(left, right, np.array([2.0, 3.0]), CHART_VERMILLION)
    picture = draw_chart(Chart("t", "x", "y", bars=(lower, upper)), 500, 300)
    blue, red = places(picture, CHART_BLUE), places(picture, CHART_VERMILLION)
    first = red[red[:, 0] <= blue[:, 0].max()]
    assert first[:, 1].max() <= blue[:, 1].min()
    assert red[red[:, 0] > blue[:, 0].max() + 2][:, 1].max() >= blue[:, 1].max() - 1, (
        "the second stands on the axis"
    )
    gap = Series(np.array([0.0, 1.0]), np.array([np.nan, 1.0]), CHART_GREEN)
    assert len(places(draw_chart(Chart("t", "x", "y", series=(gap,)), 500, 300), CHART_GREEN)) > 0


def test_a_rule_stands_at_its_value_and_one_off_the_axis_is_not_drawn():
    series = Series(np.array([0.0, 10.0]), np.array([1.0, 1.0]), CHART_BLUE)

    def chart(at):
        return Chart("t", "x", "y", series=(series,), at_x=(Rule(at, "", RED),), x_range=(0.0, 10.0))

    halves = places(draw_chart(chart(5.0), 500, 300), RED)[:, 0]
    ends = places(draw_chart(chart(10.0), 500, 300), RED)[:, 0]
    assert halves.mean() < ends.mean()
    assert len(places(draw_chart(chart(11.0), 500, 300), RED)) == 0


@pytest.mark.parametrize("values", [[], [3.0], [np.nan, np.inf], [0.0, 0.0], [7.0, 7.0]])
def test_a_chart_of_nothing_or_of_one_value_is_no_error(values):
    y = np.array(values, np.float64)
    chart = Chart("t", "x", "y", series=(Series(np.arange(len(y), dtype=np.float64), y, CHART_BLUE, "name"),))
    assert draw_chart(chart, 400, 300).shape == (300, 400, 3)


def test_text_is_shrunk_to_its_room_and_stands_at_its_anchor():
    picture = np.full((60, 300, 3), 255, np.uint8)
    put_text(picture, "words that are far too long for this", (10, 30), room_px=100, anchor=(0.0, 0.5))
    columns = np.nonzero((picture < 128).any(axis=(0, 2)))[0]
    rows = np.nonzero((picture < 128).any(axis=(1, 2)))[0]
    assert 10 <= columns.min() <= 14
    assert 80 <= columns.max() <= 114
    assert abs(rows.mean() - 30) < 4


# ---------------------------------------------------------------------- colours, sheets


def test_the_scale_of_magnitudes_gets_brighter_and_ends_where_told():
    for on_light in (False, True):
        colours = magnitude_colours(np.linspace(2.0, 8.0, 20), 8.0, smallest=2.0, on_light=on_light)
        grey = cv2.cvtColor(colours[None], cv2.COLOR_BGR2GRAY)[0].astype(int)
        assert (np.diff(grey) > 0).all(), "told apart without any colour"
        beyond = magnitude_colours(np.array([0.0, 99.0]), 8.0, smallest=2.0, on_light=on_light)
        np.testing.assert_array_equal(beyond, colours[[0, -1]])
    assert magnitude_colours(np.zeros(0), 1.0).shape == (0, 3)


def test_the_colour_bar_has_the_scales_colours_largest_on_top():
    bar = sheet.colour_bar(1.0, 9.0, "px", 300)
    column = bar[42:286, 10]
    ends = magnitude_colours(np.array([9.0, 1.0]), 9.0, smallest=1.0, on_light=True).astype(int)
    assert np.abs(column[[0, -1]] - ends).max() <= 6
    grey = cv2.cvtColor(column[None], cv2.COLOR_BGR2GRAY)[0].astype(int)
    assert (np.diff(grey) <= 1).all(), "but for rounding"
    sheet.colour_bar(0.0, 0.0, "px", 100)  # nothing moved: no error


def test_a_sheet_holds_its_pictures_whole():
    small, large = np.full((10, 20, 3), 7, np.uint8), np.full((30, 40, 3), 9, np.uint8)
    row = sheet.side_by_side([small, large])
    column = sheet.one_below_the_other([small, large])
    assert row.shape[0] == 30
    assert column.shape == (40, 40, 3)
    for picture in (row, column):
        assert ((picture == 7).all(axis=2).sum(), (picture == 9).all(axis=2).sum()) == (200, 1200)


# ---------------------------------------------------------------------- figures


@pytest.fixture(scope="module")
def open_pair():
    images = [
        cv2.imread(str(PAIRS / "office" / name), cv2.IMREAD_GRAYSCALE) for name in ("00068.jpg", "00069.jpg")
    ]
    pair, params = Pair(*images), DetectorParams.preset("paper", plane_deviation_px_at_1280=0.0)
    steps = examine(pair, params)
    return pair, steps, figures(pair, steps, params)


def in_figure(point_px, image, panel_px):
    """Return where a point of the frame stands in a figure's first panel."""
    zoom = panel_px / image.shape[1]
    x, y = ((value + 0.5) * zoom - 0.5 + MARGIN_PX for value in point_px)
    return round(x), round(y)


def test_the_flow_figure_shows_what_each_filter_dropped(open_pair):
    _, steps, drawn = open_pair
    picture = drawn["figure-3"]
    for colour, mask in (
        (CHART_VERMILLION, ~steps.came_back),
        (CHART_BLUE, steps.came_back & ~steps.long_enough),
        (CHART_GREEN, steps.long_enough & ~steps.kept),
    ):
        assert mask.any()
        # The key's line of the colour, at the right of the third panel, is always there; the vectors are beside it.
        at = places(picture, colour)
        assert (at[:, 0] < MARGIN_PX + PANEL_PX).sum() > 0
        assert (at[:, 0] > MARGIN_PX + PANEL_PX).sum() > 0
    assert picture.shape[1] > 2 * PANEL_PX


def test_the_lmcc_is_marked_where_it_is(open_pair):
    pair, steps, drawn = open_pair
    found = steps.result.detection.diagnostics
    x, y = in_figure(found.lmcc_px, pair.later, PANEL_PX)
    assert tuple(drawn["figure-5"][y, x]) == BLUE
    x, y = in_figure(found.lmcc_px, pair.later, 1.5 * PANEL_PX)
    assert tuple(drawn["figure-6"][y, x]) == YELLOW


def test_a_figure_is_drawn_only_where_its_step_was_reached(open_pair):
    _, _, drawn = open_pair
    assert list(drawn) == ["figure-3", "figure-4", "figure-5", "figure-6"]
    wall = Pair(
        *(
            cv2.imread(str(PAIRS / "brickwall" / name), cv2.IMREAD_GRAYSCALE)
            for name in ("001.jpg", "003.jpg")
        )
    )
    for overrides, expected in (
        ({}, ["figure-3", "figure-4", "figure-5"]),
        ({"min_flow_vectors": 5000}, ["figure-3", "figure-4"]),
        ({"still_flow_px_at_1280": 100.0}, ["figure-3"]),
        ({"min_features": 90_000}, []),
    ):
        params = DetectorParams.preset("default", **overrides)
        assert list(figures(wall, examine(wall, params), params)) == expected


def test_figures_have_one_width_whatever_the_size_of_the_frames(open_pair):
    pair, _, drawn = open_pair
    small = Pair(
        *(
            cv2.resize(image, None, fx=0.7, fy=0.7, interpolation=cv2.INTER_AREA)
            for image in (pair.earlier, pair.later)
        )
    )
    params = DetectorParams.preset("paper")
    again = figures(small, examine(small, params), params)
    assert abs(again["figure-3"].shape[1] - drawn["figure-3"].shape[1]) < 40, "but for the width of the ticks"

"""The picture of ``detector bench``: time against the size of the image, of the whole comparison and of the methods alone, and against the number of points."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from detector.drawing.chart import Chart, Series, draw_chart
from detector.drawing.palette import (
    CHART_BLUE,
    CHART_GREEN,
    CHART_PURPLE,
    CHART_VERMILLION,
    GREY,
    INK,
    ORANGE,
    Colour,
)
from detector.drawing.sheet import one_below_the_other, side_by_side

_PANEL_PX: Final = (760, 520)
_MS: Final = 1e3
_LEGEND_ROOM: Final = 1.6
_LINES: Final[tuple[tuple[str, str, Colour], ...]] = (
    ("literal", "literal, first loop", INK),
    ("literal_other", "literal, other loops", GREY),
    ("parallax", "method parallax", ORANGE),
    ("sfm", "structure from motion", CHART_PURPLE),
    ("first", "first loop", CHART_VERMILLION),
    ("other", "other loops", CHART_BLUE),
    ("floor", "Lucas-Kanade alone", CHART_GREEN),
)
_METHODS: Final[tuple[tuple[str, str, Colour], ...]] = (
    ("parallax", "parallax", ORANGE),
    ("parallax_poses", "parallax with poses", CHART_VERMILLION),
    ("flow_balance", "left-right flow balance", CHART_PURPLE),
    ("other", "paper, other loops", CHART_BLUE),
    ("floor", "Lucas-Kanade alone", CHART_GREEN),
    ("line_vp", "lines alone", GREY),
)
"""The literal path and structure from motion would press these together."""


def performance_chart(figures: dict[str, Any]) -> NDArray[np.uint8]:
    """Return the chart of the figures of :func:`detector.bench.run`, (H, W, 3) uint8 BGR."""
    methods = _against_size(figures, "Methods and rivals", _METHODS)
    if methods.series:
        # Their lines are flat and the longest lies on top, where the legend needs room.
        highest = max(float(np.nanmax(series.y)) for series in methods.series if isinstance(series, Series))
        methods = replace(methods, y_range=(0.0, _LEGEND_ROOM * highest))
    charts = (_against_size(figures, "Time of one pair", _LINES), _against_points(figures), methods)
    whole, points, below = (draw_chart(chart, *_PANEL_PX) for chart in charts)
    return one_below_the_other([side_by_side([whole, points]), below])


def _against_size(figures: dict[str, Any], title: str, lines: tuple[tuple[str, str, Colour], ...]) -> Chart:
    sizes = sorted(figures["sizes"].items(), key=lambda item: _megapixels(item[0]))
    x = np.array([_megapixels(name) for name, _ in sizes])
    series = []
    for key, name, colour in lines:
        spreads = [row[f"{key}_s"] for _, row in sizes]
        if all(spread is None for spread in spreads):
            continue
        y = np.array([np.nan if spread is None else spread["median"] * _MS for spread in spreads])
        series.append(Series(x, y, colour, name))
    sides = ", ".join(name for name, _ in sizes)
    threads = figures["threads"]
    return Chart(
        f"{title}, {threads} thread{'' if threads == 1 else 's'} (medians)",
        f"size (megapixels): {sides}",
        "time (ms)",
        series,
    )


def _against_points(figures: dict[str, Any]) -> Chart:
    points = figures["points"]
    n = np.array([each["n"] for each in points], np.float64)
    ours = np.array([each["other_s"] for each in points], np.float64) * _MS
    floor = np.array([np.nan if each["floor_s"] is None else each["floor_s"] for each in points]) * _MS
    return Chart(
        f"Other loops by number of points, {points[0]['size'] if points else 'no pair answered'}",
        "points that the flow starts from",
        "time (ms)",
        [
            Series(n, ours, CHART_BLUE, "other loops", thickness=0),
            Series(n, floor, CHART_GREEN, "Lucas-Kanade alone", thickness=0),
        ]
        if len(points)
        else [],
    )


def _megapixels(size: str) -> float:
    width, height = size.split("x")
    return int(width) * int(height) / 1e6

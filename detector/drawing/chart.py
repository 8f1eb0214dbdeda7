"""Line and bar charts with axes, ticks, units and labels."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from detector.drawing.palette import GREY, INK, PALE, WHITE, Colour
from detector.drawing.text import put_text, put_text_upwards, text_size

_SCALE: Final = 0.55
_TITLE_SCALE: Final = 0.62
_NOTE_SCALE: Final = 0.45
_MARGIN_PX: Final = 16


@dataclass(frozen=True, slots=True)
class Series:
    """Points that belong together.

    Attributes
    ----------
    x, y
        (N,) in the units of the axes; what is not finite is left out.
    colour
        Of line and points.
    name
        For the legend; without one it does not appear there.
    markers, thickness
        Whether each point is marked; thickness of the line in px, 0 for none.
    notes
        One text for each point, written above it.
    """

    x: NDArray[np.float64]
    y: NDArray[np.float64]
    colour: Colour
    name: str = ""
    markers: bool = True
    thickness: int = 2
    notes: Sequence[str] = ()


@dataclass(frozen=True, slots=True)
class Bars:
    """Bars from zero, each as wide as its share of the x axis; later ones stand on those before."""

    left: NDArray[np.float64]
    right: NDArray[np.float64]
    height: NDArray[np.float64]
    colour: Colour
    name: str = ""


@dataclass(frozen=True, slots=True)
class Rule:
    """A dashed line across the chart at a value of one axis, with its words."""

    at: float
    words: str
    colour: Colour = INK


@dataclass(frozen=True, slots=True)
class Chart:
    """One chart.

    Attributes
    ----------
    title, x_label, y_label
        ASCII; labels with their unit.
    series, bars
        What is shown.
    at_x, at_y
        Lines across it.
    x_range, y_range
        Given, or from the data; y begins at 0 where not given.
    whole_x
        Ticks of the x axis at whole numbers alone.
    """

    title: str
    x_label: str
    y_label: str
    series: Sequence[Series] = ()
    bars: Sequence[Bars] = ()
    at_x: Sequence[Rule] = ()
    at_y: Sequence[Rule] = ()
    x_range: tuple[float, float] | None = None
    y_range: tuple[float, float] | None = None
    whole_x: bool = False


def nice_ticks(low: float, high: float, wanted: int = 6, *, whole: bool = False) -> list[float]:
    """Return round values between two, about as many as wanted: steps of 1, 2 or 5 times a power of ten.

    Parameters
    ----------
    low, high
        Ends of the axis, inclusive.
    wanted
        Number of ticks to come near to.
    whole
        Whole numbers alone.
    """
    span = high - low
    if not (math.isfinite(span) and span > 0.0):
        return [low] if math.isfinite(low) else []
    rough = span / max(wanted - 1, 1)
    power = 10.0 ** math.floor(math.log10(rough))
    step = next((f * power for f in (1.0, 2.0, 5.0) if f * power >= rough * 0.999), 10.0 * power)
    if whole:
        step = max(1.0, round(step))
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [i * step for i in range(first, last + 1)]


def tick_text(value: float) -> str:
    """Return a tick's value in few characters."""
    text = f"{value:.4g}"
    return "0" if text == "-0" else text


def draw_chart(chart: Chart, width_px: int, height_px: int) -> NDArray[np.uint8]:
    """Return a chart on white.

    Returns
    -------
    (height_px, width_px, 3) uint8, BGR.
    """
    return _Drawing(chart, width_px, height_px).picture


class _Drawing:
    def __init__(self, chart: Chart, width_px: int, height_px: int) -> None:
        self.picture = np.full((height_px, width_px, 3), 255, np.uint8)
        self._chart = chart
        self._x, self._y = _x_range(chart), _y_range(chart)
        self._x_ticks = nice_ticks(*self._x, wanted=12 if chart.whole_x else 9, whole=chart.whole_x)
        self._y_ticks = nice_ticks(*self._y)
        widest = max((text_size(tick_text(tick), _SCALE)[0] for tick in self._y_ticks), default=0)
        self._left = _MARGIN_PX + 26 + widest + 10
        self._right = width_px - _MARGIN_PX
        self._top, self._bottom = 44, height_px - 62
        self._axes()
        for bars in self._stacked():
            self._draw_bars(*bars)
        for row, rule in enumerate(chart.at_x):
            self._rule_at_x(rule, row)
        for rule in chart.at_y:
            self._rule_at_y(rule)
        for series in chart.series:
            self._draw_series(series)
        self._legend()

    def _at(self, x: float, y: float) -> tuple[int, int]:
        across = (x - self._x[0]) / (self._x[1] - self._x[0])
        up = (y - self._y[0]) / (self._y[1] - self._y[0])
        return (
            round(self._left + across * (self._right - self._left)),
            round(self._bottom - up * (self._bottom - self._top)),
        )

    def _axes(self) -> None:
        chart, picture = self._chart, self.picture
        put_text(
            picture,
            chart.title,
            (_MARGIN_PX, 12),
            scale=_TITLE_SCALE,
            anchor=(0.0, 0.0),
            room_px=picture.shape[1] - 2 * _MARGIN_PX,
        )
        for tick in self._y_ticks:
            _, y = self._at(self._x[0], tick)
            cv2.line(picture, (self._left, y), (self._right, y), PALE, 1)
            put_text(picture, tick_text(tick), (self._left - 8, y), scale=_SCALE, anchor=(1.0, 0.5))
        for tick in self._x_ticks:
            x, _ = self._at(tick, self._y[0])
            cv2.line(picture, (x, self._bottom), (x, self._bottom + 6), INK, 1)
            put_text(picture, tick_text(tick), (x, self._bottom + 10), scale=_SCALE, anchor=(0.5, 0.0))
        corners = [(self._left, self._top), (self._left, self._bottom), (self._right, self._bottom)]
        cv2.polylines(picture, [np.array(corners, np.int32)], False, INK, 1)
        middle = (self._left + self._right) // 2
        put_text(picture, chart.x_label, (middle, picture.shape[0] - 12), scale=_SCALE, anchor=(0.5, 1.0))
        put_text_upwards(
            picture, chart.y_label, (_MARGIN_PX + 8, (self._top + self._bottom) // 2), scale=_SCALE
        )

    def _stacked(self) -> list[tuple[Bars, NDArray[np.float64]]]:
        """Return each set of bars with what it stands on."""
        below: dict[tuple[float, float], float] = {}
        stacked = []
        for bars in self._chart.bars:
            places = [(float(a), float(b)) for a, b in zip(bars.left, bars.right, strict=True)]
            stacked.append((bars, np.array([below.get(place, 0.0) for place in places])))
            for place, height in zip(places, bars.height, strict=True):
                below[place] = below.get(place, 0.0) + float(height)
        return stacked

    def _draw_bars(self, bars: Bars, below: NDArray[np.float64]) -> None:
        for left, right, height, base in zip(bars.left, bars.right, bars.height, below, strict=True):
            if height <= 0.0:
                continue
            x0, y0 = self._at(float(left), float(base + height))
            x1, y1 = self._at(float(right), float(base))
            cv2.rectangle(self.picture, (x0, y0), (max(x0, x1 - 1), y1), bars.colour, thickness=cv2.FILLED)

    def _draw_series(self, series: Series) -> None:
        finite = np.isfinite(series.x) & np.isfinite(series.y)
        points = [
            self._at(float(x), float(y)) for x, y in zip(series.x[finite], series.y[finite], strict=True)
        ]
        if series.thickness and len(points) > 1:
            line = np.array(points, np.int32)
            cv2.polylines(
                self.picture, [line], False, series.colour, thickness=series.thickness, lineType=cv2.LINE_AA
            )
        if series.markers:
            for point in points:
                cv2.circle(self.picture, point, 5, series.colour, thickness=cv2.FILLED, lineType=cv2.LINE_AA)
        kept = [note for note, is_kept in zip(series.notes, finite, strict=False) if is_kept]
        for (x, y), note in zip(points, kept, strict=False):
            self._on_white(note, (x, y - 10), INK, (0.5, 1.0), _NOTE_SCALE)

    def _rule_at_x(self, rule: Rule, row: int) -> None:
        """Draw an upright rule; its words stand in a row of their own, so that those of two near ones do not collide."""
        if not self._x[0] <= rule.at <= self._x[1]:
            return
        x, _ = self._at(rule.at, self._y[0])
        for y in range(self._top, self._bottom, 12):
            cv2.line(self.picture, (x, y), (x, min(y + 6, self._bottom)), rule.colour, 2)
        on_the_right = x < (self._left + self._right) // 2
        at = (x + (8 if on_the_right else -8), self._top + 4 + 22 * row)
        self._on_white(rule.words, at, rule.colour, (0.0 if on_the_right else 1.0, 0.0), _SCALE)

    def _rule_at_y(self, rule: Rule) -> None:
        if not self._y[0] <= rule.at <= self._y[1]:
            return
        _, y = self._at(self._x[0], rule.at)
        for x in range(self._left, self._right, 12):
            cv2.line(self.picture, (x, y), (min(x + 6, self._right), y), rule.colour, 2)
        self._on_white(rule.words, (self._right - 4, y - 8), rule.colour, (1.0, 1.0), _SCALE)

    def _on_white(
        self, words: str, at: tuple[int, int], colour: Colour, anchor: tuple[float, float], scale: float
    ) -> None:
        if not words:
            return
        width, height = text_size(words, scale)
        left, top = round(at[0] - anchor[0] * width), round(at[1] - anchor[1] * height)
        corner = (left + width + 2, top + height + 3)
        cv2.rectangle(self.picture, (left - 2, top - 2), corner, WHITE, thickness=cv2.FILLED)
        put_text(self.picture, words, at, scale=scale, colour=colour, anchor=anchor)

    def _legend(self) -> None:
        """Write the names of what is shown into the corner that covers least of it."""
        names = [(bars.name, bars.colour) for bars in self._chart.bars if bars.name]
        names += [(series.name, series.colour) for series in self._chart.series if series.name]
        if not names:
            return
        pitch = 24
        width = 34 + max(text_size(name, _SCALE)[0] for name, _ in names)
        height = pitch * len(names)
        corners = [
            (x, y)
            for y in (self._top + 2, self._bottom - height - 6)
            for x in (self._right - width - 4, self._left + 6)
        ]
        left, top = min(corners, key=lambda at: self._ink(at[0], at[1], width, height))
        box = self.picture[top : top + height, left : left + width]
        box[:] = 255
        for row, (name, colour) in enumerate(names):
            y = top + pitch * row + 4
            for shade, thickness in ((colour, cv2.FILLED), (GREY, 1)):
                cv2.rectangle(self.picture, (left + 4, y), (left + 20, y + 14), shade, thickness=thickness)
            put_text(self.picture, name, (left + 30, y + 7), scale=_SCALE, anchor=(0.0, 0.5))

    def _ink(self, left: int, top: int, width: int, height: int) -> int:
        """Return how much of a box is drawn on, the pale grid aside."""
        box = self.picture[top : top + height, left : left + width]
        return int((box.min(axis=2) < min(PALE)).sum())


def _x_range(chart: Chart) -> tuple[float, float]:
    if chart.x_range is not None:
        return _widened(*chart.x_range)
    values = [series.x for series in chart.series]
    values += [edge for bars in chart.bars for edge in (bars.left, bars.right)]
    low, high = _ends(values)
    if chart.bars:
        return _widened(low, high)
    return _widened(low - 0.04 * (high - low), high + 0.04 * (high - low))


def _y_range(chart: Chart) -> tuple[float, float]:
    if chart.y_range is not None:
        return _widened(*chart.y_range)
    stacks: dict[tuple[float, float], float] = {}
    for bars in chart.bars:
        for left, right, height in zip(bars.left, bars.right, bars.height, strict=True):
            place = (float(left), float(right))
            stacks[place] = stacks.get(place, 0.0) + float(height)
    values = [series.y for series in chart.series] + [np.array(list(stacks.values()))]
    _, high = _ends([*values, np.array([rule.at for rule in chart.at_y])])
    return _widened(0.0, 1.15 * high)


def _ends(values: Sequence[NDArray[np.float64]]) -> tuple[float, float]:
    every = np.concatenate([np.zeros(0), *values])
    every = every[np.isfinite(every)]
    return (float(every.min()), float(every.max())) if len(every) else (0.0, 1.0)


def _widened(low: float, high: float) -> tuple[float, float]:
    return (low, high) if high > low else (low, low + 1.0)

"""Pictures of a search: how it went, what each setting is worth, and each setting against the score."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray
from optuna.trial import FrozenTrial

from companion.tune.space import Dimension
from detector.drawing.chart import Chart, Rule, Series, draw_chart
from detector.drawing.palette import CHART_BLUE, CHART_GREEN, CHART_VERMILLION
from detector.drawing.sheet import one_below_the_other, side_by_side
from detector.drawing.text import put_text, text_size

_PANEL_PX = (760, 420)
_SMALL_PX = (500, 330)
_A_ROW = 3
_ROW_PX, _BAR_PX, _MARGIN_PX, _SCALE = 30, 360, 16, 0.55

Picture = NDArray[np.uint8]


def history(trials: Sequence[FrozenTrial]) -> Picture:
    """Return each trial's score and the best so far, (H, W, 3) uint8 BGR."""
    numbers = np.array([trial.number for trial in trials], float)
    values = _values(trials)
    rules = [Rule(float(values[0]), "usual settings")] if len(trials) and trials[0].number == 0 else []
    chart = Chart(
        "Score of each trial on the cases searched on",
        "trial",
        "mean score",
        series=(
            Series(numbers, values, CHART_BLUE, "trial", thickness=0),
            Series(numbers, np.maximum.accumulate(values), CHART_VERMILLION, "best so far", markers=False),
        ),
        at_y=rules,
        whole_x=True,
        y_range=_score_range(values),
    )
    return draw_chart(chart, *_PANEL_PX)


def importance(shares: Mapping[str, float]) -> Picture:
    """Return a bar for each setting, largest first, (H, W, 3) uint8 BGR."""
    names = sorted(shares, key=lambda name: -shares[name])
    left = max((text_size(name, _SCALE)[0] for name in names), default=0) + 2 * _MARGIN_PX
    height = 44 + _ROW_PX * len(names) + _MARGIN_PX
    picture = np.full((height, left + _BAR_PX + 90, 3), 255, np.uint8)
    put_text(picture, "Importance (share of the differences between trials)", (_MARGIN_PX, 26), scale=0.5)
    most = max(shares.values(), default=0.0)
    for row, name in enumerate(names):
        top = 44 + row * _ROW_PX
        put_text(picture, name, (_MARGIN_PX, top + 18), scale=_SCALE)
        length = round(_BAR_PX * shares[name] / most) if most > 0.0 else 0
        cv2.rectangle(picture, (left, top + 4), (left + length, top + 22), CHART_GREEN, cv2.FILLED)
        put_text(picture, f"{shares[name]:.2f}", (left + length + 8, top + 18), scale=_SCALE)
    return picture


def settings(trials: Sequence[FrozenTrial], space: Sequence[Dimension]) -> Picture:
    """Return each setting of every trial against its score, (H, W, 3) uint8 BGR; the best trial is marked."""
    values = _values(trials)
    best = int(values.argmax())
    panels = []
    for each in space:
        at = np.array([_place(each, trial) for trial in trials])
        ticks = (
            f" ({', '.join(f'{i}: {choice}' for i, choice in enumerate(each.choices))})"
            if each.choices
            else ""
        )
        chart = Chart(
            each.name,
            f"{'log10 of the value' if each.is_log else 'value'}{ticks}",
            "mean score",
            series=(
                Series(at, values, CHART_BLUE, thickness=0),
                Series(at[best : best + 1], values[best : best + 1], CHART_VERMILLION, "best", thickness=0),
            ),
            y_range=_score_range(values),
        )
        panels.append(draw_chart(chart, *_SMALL_PX))
    panels += [np.full_like(panels[0], 255)] * (-len(panels) % _A_ROW if len(panels) > _A_ROW else 0)
    return one_below_the_other([side_by_side(panels[i : i + _A_ROW]) for i in range(0, len(panels), _A_ROW)])


def _place(each: Dimension, trial: FrozenTrial) -> float:
    value = trial.params[each.name]
    if each.choices:
        return float(each.choices.index(value))
    return float(np.log10(value)) if each.is_log else float(value)


def _values(trials: Sequence[FrozenTrial]) -> NDArray[np.float64]:
    return np.array([trial.value for trial in trials], np.float64)


def _score_range(values: NDArray[np.float64]) -> tuple[float, float]:
    low, high = float(values.min()), float(values.max())
    margin = max(0.1 * (high - low), 0.01)
    return low - margin, high + margin

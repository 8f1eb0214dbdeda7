"""The reliability diagram: how often answers are right, by how sure they say they are."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from detector.drawing.chart import Chart, Series, draw_chart
from detector.drawing.palette import CHART_BLUE, GREY
from detector.parallax.confidence import ReliabilityBin

_SIZE_PX: Final = (620, 520)


def draw_reliability(parts: Sequence[ReliabilityBin]) -> NDArray[np.uint8]:
    """Return the diagram, (520, 620, 3) uint8, BGR. On the diagonal answers are right as often as they say.

    Parameters
    ----------
    parts
        From :func:`detector.parallax.confidence.reliability`; the number of answers is written above each.
    """
    diagonal = np.array([0.0, 1.0])
    measured = Series(
        np.array([part.confidence for part in parts]),
        np.array([part.right for part in parts]),
        CHART_BLUE,
        "measured (answers)",
        notes=[str(part.answers) for part in parts],
    )
    chart = Chart(
        "Reliability of the confidence",
        "confidence (mean of the answers)",
        "share of answers that are right",
        (Series(diagonal, diagonal, GREY, "as it says", markers=False, thickness=1), measured),
        x_range=(0.0, 1.0),
        y_range=(0.0, 1.08),
    )
    return draw_chart(chart, *_SIZE_PX)

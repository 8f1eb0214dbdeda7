"""Colours (BGR) that the colour-blind can tell apart, and the scale that shows a magnitude."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

Colour = tuple[int, int, int]

WHITE: Final[Colour] = (255, 255, 255)
BLACK: Final[Colour] = (0, 0, 0)
INK: Final[Colour] = (40, 40, 40)
GREY: Final[Colour] = (140, 140, 140)
PALE: Final[Colour] = (225, 225, 225)

# On frames: the colours of the paper's Figs. 5 and 6. The marks differ in shape as well.
GREEN: Final[Colour] = (60, 220, 60)
YELLOW: Final[Colour] = (0, 235, 255)
RED: Final[Colour] = (60, 60, 255)
BLUE: Final[Colour] = (255, 130, 30)
ORANGE: Final[Colour] = (40, 160, 255)
SKY: Final[Colour] = (255, 225, 80)
"""Of lines: the scale of magnitudes has nothing like it."""

# In charts: Okabe and Ito, "Color Universal Design", 2008.
CHART_BLUE: Final[Colour] = (178, 114, 0)
CHART_VERMILLION: Final[Colour] = (0, 94, 213)
CHART_GREEN: Final[Colour] = (115, 158, 0)
CHART_PURPLE: Final[Colour] = (167, 121, 204)

_DARK_END: Final = {False: 0.15, True: 0.0}
_BRIGHT_END: Final = {False: 1.0, True: 0.82}


def magnitude_colours(
    magnitudes: NDArray[np.float64], largest: float, *, smallest: float = 0.0, on_light: bool = False
) -> NDArray[np.uint8]:
    """Return the (N, 3) BGR colours of magnitudes: the plasma map, dark blue for the smallest to orange or yellow for the largest.

    Parameters
    ----------
    magnitudes
        (N,), not negative.
    largest
        This and more have the last colour.
    smallest
        This and less have the first.
    on_light
        For a light background: the map ends before yellow. On a dark one it begins behind its darkest blue.
    """
    if len(magnitudes) == 0:
        return np.zeros((0, 3), np.uint8)
    dark, bright = _DARK_END[on_light], _BRIGHT_END[on_light]
    share = np.clip((np.asarray(magnitudes, np.float64) - smallest) / max(largest - smallest, 1e-9), 0.0, 1.0)
    levels = np.round((dark + (bright - dark) * share) * 255.0).astype(np.uint8)
    colours = cv2.applyColorMap(levels.reshape(-1, 1), cv2.COLORMAP_PLASMA)
    return np.asarray(colours, np.uint8).reshape(-1, 3)

"""Near things that are too small to be there.

A wrong match may call a few samples near. Something that near would fill more of the picture than that, so what is cut off from its surroundings in depth and covers less than a hand's
area at its distance is an error. What is far may be small; there nothing is asked.
"""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

_LEAST_AREA: Final = 0.07
"""In baselines squared: 6 x 6 cm where the camera moved by a quarter of a metre."""
_BANDS: Final = (1.5, 2.0, 3.0, 4.0, 5.0)
"""Baselines; what is nearer than each must cover the area as seen from there."""
_SAME_SHARE: Final = 0.2
"""Neighbours whose ranges differ by less than this share hold together."""
_STEPS: Final = 50.0
_NONE: Final = -32000


def lonely(
    points_px: NDArray[np.float64],
    inverse_range: NDArray[np.float64],
    told: NDArray[np.bool_],
    focal_px: float,
) -> NDArray[np.bool_]:
    """Return which samples (N,) are called near and have too few neighbours for it.

    Parameters
    ----------
    points_px
        (N, 2) on a grid, or some of one.
    inverse_range
        (N,) 1/baseline.
    told
        (N,) where that says something.
    focal_px
        Of the image that the points are in.
    """
    near = told & (inverse_range > 1.0 / _BANDS[-1])
    if not near.any():
        return near
    columns, column = np.unique(points_px[:, 0], return_inverse=True)
    rows, row = np.unique(points_px[:, 1], return_inverse=True)
    if len(columns) < 2 or len(rows) < 2:
        return np.zeros(len(told), np.bool_)
    cell_rad2 = float(np.diff(columns).min() * np.diff(rows).min()) / focal_px**2
    surface = np.full((len(rows), len(columns)), _NONE, np.int16)
    steps = np.rint(_STEPS * np.log(np.clip(inverse_range[told], 1e-4, 1e4)))
    surface[row[told], column[told]] = steps.astype(np.int16)
    # A plain place between two samples of one surface does not part them.
    surface = np.asarray(cv2.dilate(surface, np.ones((3, 3), np.uint8)), np.int16)
    found = np.zeros(len(told), np.bool_)
    for baselines in _BANDS:
        kept = surface.copy()
        most = int(_LEAST_AREA / baselines**2 / cell_rad2)
        cv2.filterSpeckles(kept, _NONE, most, _STEPS * _SAME_SHARE)
        found |= near & (inverse_range > 1.0 / baselines) & (kept[row, column] == _NONE)
    return found

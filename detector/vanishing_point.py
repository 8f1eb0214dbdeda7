"""Vanishing-point candidates: one histogram of pairwise intersections a cluster (paper section 2.3, equations 1-3)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from detector.lines import angles_deg


def nearest_centre(segments_px: NDArray[np.float64], centres_px: NDArray[np.float64]) -> NDArray[np.intp]:
    """Return for each segment the index of the cluster centre nearest to its midpoint."""
    midpoints = (segments_px[:, :2] + segments_px[:, 2:]) / 2.0
    squared = ((midpoints[:, None, :] - centres_px[None, :, :]) ** 2).sum(axis=2)
    return np.asarray(np.argmin(squared, axis=1), np.intp)


def intersections(
    segments_px: NDArray[np.float64], *, min_deg: float = 5.0, max_deg: float = 15.0
) -> NDArray[np.float64]:
    """Return the (M, 2) points where the lines of two segments meet, for angles strictly between the two limits.

    Differences of angle are taken modulo 180, so that the rule holds for any gate on beta. Near-parallel lines are left
    out because their intersection is ill-defined, steeper ones because they do not bound one object.
    """
    first, second = np.triu_indices(len(segments_px), k=1)
    beta = angles_deg(segments_px)
    difference = np.abs(beta[first] - beta[second])
    difference = np.minimum(difference, 180.0 - difference)
    kept = (difference > min_deg) & (difference < max_deg)
    u, v = segments_px[first[kept]], segments_px[second[kept]]
    du, dv = u[:, 2:] - u[:, :2], v[:, 2:] - v[:, :2]
    cross = du[:, 0] * dv[:, 1] - du[:, 1] * dv[:, 0]
    between = v[:, :2] - u[:, :2]
    meet = cross != 0.0  # only a gate that lets parallels through can fail this
    along = (between[meet, 0] * dv[meet, 1] - between[meet, 1] * dv[meet, 0]) / cross[meet]
    points: NDArray[np.float64] = u[meet, :2] + along[:, None] * du[meet]
    return points


def fullest_cell(
    points_px: NDArray[np.float64],
    image_size_px: tuple[int, int],
    near_px: NDArray[np.float64],
    cell_px: float = 10.0,
) -> NDArray[np.float64] | None:
    """Return the middle of the grid cell that holds most points (equations 2 and 3).

    Parameters
    ----------
    points_px
        (M, 2) intersections; those outside the image do not count.
    image_size_px
        Width and height.
    near_px
        (2,) the group's centre: among equally full cells the nearest one wins.
    cell_px
        Side of a cell.

    Returns
    -------
    (2,) or None when no point lies in the image.
    """
    width, height = image_size_px
    x, y = points_px[:, 0], points_px[:, 1]
    inside = points_px[(x >= 0) & (x < width) & (y >= 0) & (y < height)]
    if len(inside) == 0:
        return None
    cells, counts = np.unique(np.floor(inside / cell_px), axis=0, return_counts=True)
    fullest = (cells[counts == counts.max()] + 0.5) * cell_px
    squared = ((fullest - near_px) ** 2).sum(axis=1)
    return np.asarray(fullest[int(np.argmin(squared))], np.float64)


def candidates(
    segments_px: NDArray[np.float64],
    centres_px: NDArray[np.float64],
    image_size_px: tuple[int, int],
    *,
    pair_min_deg: float = 5.0,
    pair_max_deg: float = 15.0,
    cell_px: float = 10.0,
) -> NDArray[np.float64]:
    """Return the (C, 2) candidates, at most one for each cluster centre, in the order of the centres."""
    if len(segments_px) == 0 or len(centres_px) == 0:
        return np.zeros((0, 2))
    group = nearest_centre(segments_px, centres_px)
    found = [
        fullest_cell(
            intersections(segments_px[group == index], min_deg=pair_min_deg, max_deg=pair_max_deg),
            image_size_px,
            centre,
            cell_px,
        )
        for index, centre in enumerate(centres_px)
    ]
    return np.array([point for point in found if point is not None], np.float64).reshape(-1, 2)

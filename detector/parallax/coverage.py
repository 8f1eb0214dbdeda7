"""What could stand in the way near by although no sample shows it.

Samples are where the picture has texture. A smooth pillar or the plain end of a wall has none, and what is seen to its left and right says nothing of it. Two rules follow,
both for near things only, where it matters for the next step and where samples lie dense enough to ask for it:

- A way is known only where, at every distance along it, no gap between samples that look past that distance is wide enough to hide something.
- What is seen near may go on, unseen, up to the next sample that shows it or what lies behind it.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from detector.parallax.samples import RangedSamples

_NEAREST_RADII: Final = 2.0
"""Nearer than so many radii the hull's width is more of the view than the picture shows."""
_STEP: Final = 0.85
_SLACK: Final = 1.3
"""What stands a little nearer than a distance covers it too: it is met itself."""
_EDGE_SHARE: Final = 0.5
"""At the picture's edge a thing is seen in part only: what is hidden there counts from this share of its width on."""
_GRAZE_SHARE: Final = 0.2
"""Of the hidden width: what may reach in by no more is the blur of flow at the edge of a thing."""
_BAND_RAD: Final = math.radians(4.0)
"""Half the least height of a third, as seen: two rows of samples or more."""
_STANDING_M: Final = 0.8
"""How far below the camera a line of sight may pass a place and still tell of what stands there: lower, and it may pass under a table's or a bush's top."""
_FINE_RAD: Final = math.radians(0.5)
_SURELY: Final = 2.0
"""Standard deviations."""


def uncovered_from_m(
    samples: RangedSamples,
    azimuths_rad: NDArray[np.float64],
    radius_m: float,
    hidden_width_m: float,
    most_m: float,
    elevation_rad: float,
) -> NDArray[np.float64]:
    """Return the nearest distance along each azimuth at which something could stand in the swept width unseen.

    Parameters
    ----------
    samples
        In the level frame; those without information say where the picture ends.
    azimuths_rad
        (M,) of the ways.
    radius_m
        Half the swept width. All lengths are in the samples' unit.
    hidden_width_m
        What is at least so wide must show.
    most_m
        How far this is asked.
    elevation_rad
        Samples further from the horizon say nothing of flight height.

    Returns
    -------
    (M,), infinite where nothing could be hidden up to ``most_m``.
    """
    found = np.full(len(azimuths_rad), np.inf)
    level = np.abs(samples.rays_level[:, 2]) <= math.sin(elevation_rad)
    if not level.any():
        return found
    rays = samples.rays_level[level]
    middle_rad = math.atan2(float(rays[:, 1].sum()), float(rays[:, 0].sum()))
    place = _wrapped(np.arctan2(rays[:, 1], rays[:, 0]) - middle_rad)
    view = (float(place.min()), float(place.max()))
    way = _wrapped(azimuths_rad - middle_rad)
    told = samples.informative[level]
    nearest = _nearest(samples.where(level))[told]
    order = np.argsort(place[told])
    place, nearest = place[told][order], nearest[order]
    for distance_m in reversed(_distances(_NEAREST_RADII * radius_m, most_m)):
        half_rad = math.atan2(radius_m, distance_m)
        seen = place[nearest * distance_m < _SLACK]
        bounds = np.concatenate([view[:1], seen, view[1:]])
        gap_m = np.diff(bounds) * distance_m
        gap_m[[0, -1]] /= _EDGE_SHARE
        wide = np.flatnonzero(gap_m > hidden_width_m)
        # A gap counts whole where it only begins in the way: what hides in it may stand at its edge.
        hidden = (
            (way[:, None] + half_rad > bounds[wide][None, :])
            & (way[:, None] - half_rad < bounds[wide + 1][None, :])
        ).any(axis=1)
        outside_rad = np.maximum(way + half_rad - view[1], view[0] - (way - half_rad))
        hidden |= outside_rad * distance_m > hidden_width_m
        found[hidden] = distance_m
    return found


def looked_past(
    samples: RangedSamples, distances_m: NDArray[np.float64], hidden_width_m: float, half_height_m: float
) -> NDArray[np.bool_]:
    """Return which places were surely looked past, at all of the vehicle's height, by distance and azimuth.

    Parameters
    ----------
    samples
        In metres, in the level frame.
    distances_m
        (D,) horizontal.
    hidden_width_m
        What is at least so wide must show.
    half_height_m
        Of the vehicle. Each third of its height is asked by itself: a low bush, or a tree's lower branches, stand beside samples at flight height that look past them. A plain wall
        shows nothing at flight height, but the floor in front of it may: a line of sight to the floor beyond a place, which passes it below the vehicle's middle, tells as much.

    Returns
    -------
    (D, 720), azimuths half a degree apart from the level frame's x axis: whether it lies, in each third of the height at this distance or below, between two samples that look past
    this distance and are too near to each other for anything ``hidden_width_m`` wide.
    """
    bins = round(math.tau / _FINE_RAD)
    told = samples.where(samples.informative)
    past = np.zeros((len(distances_m), bins), np.bool_)
    if len(told) == 0:
        return past
    rays = told.rays_level
    middle_rad = math.atan2(float(rays[:, 1].sum()), float(rays[:, 0].sum()))
    place = _wrapped(np.arctan2(rays[:, 1], rays[:, 0]) - middle_rad)
    order = np.argsort(place)
    place, nearest = place[order], _nearest(told)[order]
    elevation = np.arcsin(np.clip(rays[order, 2], -1.0, 1.0))
    azimuth = _wrapped(np.asarray(np.arange(bins) * _FINE_RAD - middle_rad, np.float64))
    third_m = 2.0 * half_height_m / 3.0
    for row, distance_m in enumerate(distances_m):
        beyond = nearest * distance_m < 1.0
        drop_m = distance_m * np.tan(elevation)
        half_m = max(0.5 * third_m, distance_m * math.tan(_BAND_RAD))
        most_rad = hidden_width_m / distance_m
        # What stands on the floor hides the floor behind it.
        past[row] = _between(
            place[beyond & (drop_m > 0.5 * third_m) & (drop_m <= _STANDING_M)], azimuth, most_rad
        )
        thirds = [
            _between(place[beyond & (np.abs(drop_m - middle_m) <= half_m)], azimuth, most_rad)
            for middle_m in (0.0, -third_m, third_m)
        ]
        past[row] |= np.logical_and.reduce(thirds)
    return past


def _between(
    seen_rad: NDArray[np.float64], azimuths_rad: NDArray[np.float64], most_rad: float
) -> NDArray[np.bool_]:
    """Return which azimuths lie between two of those seen (in order) that are no further apart than ``most_rad``."""
    if seen_rad.size < 2:
        return np.zeros(azimuths_rad.shape, np.bool_)
    right = np.searchsorted(seen_rad, azimuths_rad)
    inside = (right > 0) & (right < seen_rad.size)
    gap_rad = seen_rad[np.minimum(right, seen_rad.size - 1)] - seen_rad[np.maximum(right - 1, 0)]
    return np.asarray(inside & (gap_rad <= most_rad))


def reach_in_rad(
    told: RangedSamples,
    bearings_rad: NDArray[np.float64],
    away_m: NDArray[np.float64],
    hidden_width_m: float,
    most_m: float,
    elevation_rad: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return how far to its left and right each seen thing may go on unseen.

    It ends, at the latest, at the next sample that surely shows nothing nearer than it: that is the thing itself, or what is behind it. It goes no further than ``hidden_width_m``:
    wider gaps are not known at all (:func:`uncovered_from_m`).

    Parameters
    ----------
    told
        The samples with information, in the level frame.
    bearings_rad, away_m
        (N,) of the things: azimuth, and horizontal distance from the camera.
    hidden_width_m, most_m, elevation_rad
        As :func:`uncovered_from_m` takes them; what is further than ``most_m`` reaches nowhere.

    Returns
    -------
    left_rad, right_rad
        (N,) each, not below 0.
    """
    left, right = np.zeros(len(away_m)), np.zeros(len(away_m))
    near = np.flatnonzero(away_m < most_m)
    level = np.abs(told.rays_level[:, 2]) <= math.sin(elevation_rad)
    if near.size == 0 or not level.any():
        return left, right
    bins = round(math.tau / _FINE_RAD)
    azimuth = np.arctan2(told.rays_level[level, 1], told.rays_level[level, 0])
    looked = np.zeros(bins)
    np.maximum.at(looked, _fine(azimuth, bins), 1.0 / np.maximum(_nearest(told.where(level)), 1e-9))
    least_m = away_m[near] / _SLACK
    most_rad = hidden_width_m / np.maximum(away_m[near], hidden_width_m)
    graze_rad = _GRAZE_SHARE * most_rad
    start = _fine(bearings_rad[near], bins)
    for side, found in ((-1, left), (1, right)):
        open_still = np.ones(near.size, np.bool_)
        reach = np.zeros(near.size)
        for step in range(1, math.ceil(float(most_rad.max()) / _FINE_RAD) + 1):
            open_still &= looked[(start + side * step) % bins] < least_m
            if not open_still.any():
                break
            reach[open_still] = step * _FINE_RAD
        found[near] = np.maximum(np.minimum(reach, most_rad) - graze_rad, 0.0)
    return left, right


def _nearest(samples: RangedSamples) -> NDArray[np.float64]:
    """Return (N,) the inverse of the horizontal distance that nothing in each sample's direction is surely nearer than."""
    level = np.hypot(samples.rays_level[:, 0], samples.rays_level[:, 1])
    return np.asarray((samples.inverse_range + _SURELY * samples.sigma) / level)


def _distances(first_m: float, most_m: float) -> list[float]:
    """Return distances from the first to the last, each a step beyond the one before."""
    found = [most_m]
    while found[0] * _STEP > first_m:
        found.insert(0, found[0] * _STEP)
    return found


def _fine(azimuths_rad: NDArray[np.float64], bins: int) -> NDArray[np.intp]:
    return np.asarray(np.rint(azimuths_rad / _FINE_RAD), np.intp) % bins


def _wrapped(angle_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray((angle_rad + math.pi) % math.tau - math.pi)

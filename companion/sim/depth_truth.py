"""What a depth image says about where to fly: depth by columns, the deepest region, and whether one plane fills the view."""

from __future__ import annotations

import itertools
import math
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from detector.camera_model import CameraModel

COLUMNS: Final = 18
_ROWS: Final = (0.2, 0.7)
"""Part of the height that counts: below is the floor, above the ceiling."""
_NEAR_PERCENTILE: Final = 20.0
_DEEP: Final = 0.9
_PLANE_TOLERANCE: Final = 0.02
_PLANE_INLIERS: Final = 0.75
_PLANE_ANGLE_DEG: Final = 42.0
_SINGLE_PLANE_INLIERS: Final = 0.9
_PLANE_DRAWS: Final = 300
_PLANE_SAMPLES: Final = 4000


def column_profile_m(depth_m: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return the depth of 18 equally wide columns, (18,): the 20th percentile over the rows from 20 to 70 % of the height."""
    height, width = depth_m.shape
    band = depth_m[round(_ROWS[0] * height) : round(_ROWS[1] * height)]
    borders = np.linspace(0, width, COLUMNS + 1).round().astype(int)
    return np.array(
        [np.percentile(band[:, left:right], _NEAR_PERCENTILE) for left, right in itertools.pairwise(borders)]
    )


def depth_truth(
    depth_m: NDArray[np.float32], camera: CameraModel, rng: np.random.Generator
) -> dict[str, Any]:
    """Return the ``depth`` entry of a frame, as docs/evaluation.md lists its keys; plain values."""
    finite = np.isfinite(depth_m)
    known = np.where(finite, depth_m, np.float32(np.nanmax(np.where(finite, depth_m, np.nan), initial=0.1)))
    profile = column_profile_m(known)
    deepest = np.flatnonzero(profile >= _DEEP * profile.max())
    x_px = camera.width_px * (float(deepest.mean()) + 0.5) / COLUMNS - 0.5
    ray = camera.pixel_to_ray([[x_px, camera.cy_px]])[0]
    inliers, plane = dominant_plane(known, camera, rng)
    return {
        "valid_frac": round(float(finite.mean()), 3),
        "deep_region": _deep_region(known),
        "column_profile_m": [round(float(value), 3) for value in profile],
        "free_column": {
            "x": round(x_px, 1),
            "depth_m": round(float(profile.max()), 3),
            "bins_within_10pct": [int(column) for column in deepest],
            "bearing_deg": round(math.degrees(math.atan2(ray[0], ray[2])), 2),
        },
        "plane": {
            "inlier_frac": round(inliers, 3),
            "normal_vs_axis_deg": round(plane[0], 1),
            "dist_m": round(plane[1], 3),
        },
        "median_depth_m": round(float(np.median(known)), 3),
        "plane_like": bool(inliers >= _PLANE_INLIERS and plane[0] <= _PLANE_ANGLE_DEG),
    }


def is_single_plane(depth: dict[str, Any]) -> bool:
    """Return whether one plane that is met more or less squarely is nearly all there is in view."""
    plane = depth["plane"]
    return bool(
        plane["inlier_frac"] >= _SINGLE_PLANE_INLIERS and plane["normal_vs_axis_deg"] <= _PLANE_ANGLE_DEG
    )


def dominant_plane(
    depth_m: NDArray[np.float32], camera: CameraModel, rng: np.random.Generator
) -> tuple[float, tuple[float, float]]:
    """Find the plane that holds most of a depth image.

    Along a plane 1 / z is linear in the ray's x / z and y / z, so three pixels give one (RANSAC).

    Returns
    -------
    The share of pixels within 2 % of its depth; the angle between its normal and the optical axis, deg, and its
    distance, m.
    """
    height, width = depth_m.shape
    count = min(_PLANE_SAMPLES, depth_m.size)
    at = rng.choice(depth_m.size, count, replace=False)
    rays = camera.pixel_to_ray(np.column_stack((at % width, at // width)).astype(np.float64))
    rows = np.column_stack((rays[:, :2] / rays[:, 2:3], np.ones(count)))
    inverse = 1.0 / depth_m.reshape(height * width)[at].astype(np.float64)
    best, coefficients = -1, np.array([0.0, 0.0, float(np.median(inverse))])
    for _ in range(_PLANE_DRAWS):
        three = rng.choice(count, 3, replace=False)
        if abs(np.linalg.det(rows[three])) < 1e-6:
            continue
        found = np.linalg.solve(rows[three], inverse[three])
        inside = int((np.abs(rows @ found - inverse) < _PLANE_TOLERANCE * inverse).sum())
        if inside > best:
            best, coefficients = inside, found
    near = np.abs(rows @ coefficients - inverse) < _PLANE_TOLERANCE * inverse
    if near.sum() >= 3:
        coefficients = np.linalg.lstsq(rows[near], inverse[near], rcond=None)[0]
    length = float(np.linalg.norm(coefficients))
    angle_deg = math.degrees(math.acos(min(1.0, abs(float(coefficients[2])) / length)))
    share = float((np.abs(rows @ coefficients - inverse) < _PLANE_TOLERANCE * inverse).mean())
    return share, (angle_deg, 1.0 / length)


def _deep_region(depth_m: NDArray[np.float32]) -> dict[str, Any]:
    """Return the largest connected region within 10 % of the deepest (95th percentile)."""
    limit_m = _DEEP * float(np.percentile(depth_m, 95.0))
    _, labels, stats, centroids = cv2.connectedComponentsWithStats((depth_m >= limit_m).astype(np.uint8))
    largest = 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))
    left, top, width, height = (int(value) for value in stats[largest, :4])
    region = depth_m[labels == largest]
    return {
        "depth_m": round(float(np.median(region)), 3),
        "centroid": [round(float(value), 1) for value in centroids[largest]],
        "bbox": [left, top, left + width, top + height],
        "area_frac": round(region.size / depth_m.size, 4),
    }

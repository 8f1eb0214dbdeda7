"""Structure from motion from two views: what the paper compares its run time with, and nothing that the detector itself uses.

The paper (section 3) sets its 1.8 s beside 2.6 s for the two-view reconstruction of Baggio et al. 2012, chapter 4. These are its
steps: features with descriptors in both frames, matching, essential matrix, pose, triangulation. No bundle adjustment, one pair.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from detector.camera_model import CameraModel

_RATIO: Final = 0.75
"""A match counts when its descriptor is nearer than this share of the second best's (Lowe 2004 suggests 0.7 to 0.8)."""
_RANSAC_CONFIDENCE: Final = 0.999
_RANSAC_LIMIT_PX: Final = 1.0
_FEWEST_MATCHES: Final = 8
_FURTHEST_BASELINES: Final = 1e4
"""Points further than this many baselines are as good as at infinity."""


@dataclass(frozen=True, slots=True)
class TwoView:
    """Relative pose and points of two views.

    Attributes
    ----------
    failure
        Why there is no reconstruction, in a few words; None where there is one.
    later_from_earlier
        (3, 3) rotation that takes coordinates of the earlier camera to those of the later one (x right, y down, z forward).
    translation_earlier
        (3,) how the camera moved, in the earlier camera's axes, of length 1: one camera has no scale.
    points_earlier
        (M, 3) triangulated points in the earlier camera's axes, in baselines.
    matched_px
        (M, 2) where these points are in the earlier frame.
    n_features_earlier, n_features_later, n_matches
        SIFT key points, and matches that passed the ratio test.
    seconds
        Wall time of each step: features, matching, essential, triangulation.
    """

    failure: str | None
    later_from_earlier: NDArray[np.float64]
    translation_earlier: NDArray[np.float64]
    points_earlier: NDArray[np.float64]
    matched_px: NDArray[np.float64]
    n_features_earlier: int = 0
    n_features_later: int = 0
    n_matches: int = 0
    seconds: dict[str, float] = field(default_factory=dict)


def reconstruct(
    earlier: NDArray[np.uint8],
    later: NDArray[np.uint8],
    camera: CameraModel,
    *,
    timer: Callable[[], float] = time.perf_counter,
) -> TwoView:
    """Estimate relative pose and points from two frames of one camera.

    Parameters
    ----------
    earlier, later
        (H, W) uint8, as the camera saw them.
    camera
        Its model, of the frames' size.
    timer
        Gives seconds, for the time of each step.

    Raises
    ------
    ValueError
        An image is not (H, W) uint8 of the camera's size.
    """
    for name, image in (("earlier", earlier), ("later", later)):
        if image.shape != (camera.height_px, camera.width_px) or image.dtype != np.uint8:
            raise ValueError(
                f"{name}: expected ({camera.height_px}, {camera.width_px}) uint8, got {image.shape} {image.dtype}"
            )
    begin = timer()
    sift = cv2.SIFT.create()
    points_a, words_a = _features(sift, earlier)
    points_b, words_b = _features(sift, later)
    after_features = timer()
    index_a, index_b = _matches(words_a, words_b)
    after_matching = timer()
    counts = (len(points_a), len(points_b), len(index_a))
    seconds = {"features": after_features - begin, "matching": after_matching - after_features}
    if len(index_a) < _FEWEST_MATCHES:
        return _failed(f"{len(index_a)} matches, at least {_FEWEST_MATCHES} needed", counts, seconds)

    # On the plane at z = 1, where the essential matrix lives; its limit there is a pixel's share of the focal length.
    flat_a, flat_b = (_on_unit_plane(camera, points) for points in (points_a[index_a], points_b[index_b]))
    essential, inlier = cv2.findEssentialMat(
        flat_a,
        flat_b,
        np.eye(3),
        method=cv2.RANSAC,
        prob=_RANSAC_CONFIDENCE,
        threshold=_RANSAC_LIMIT_PX / camera.fx_px,
    )
    # Several solutions come stacked, and none as an empty matrix.
    if essential is None or essential.shape != (3, 3):
        return _failed("no essential matrix", counts, {**seconds, "essential": timer() - after_matching})
    in_front, turned, moved, inlier = cv2.recoverPose(essential, flat_a, flat_b, np.eye(3), mask=inlier)
    rotation, translation = np.asarray(turned, np.float64), np.asarray(moved, np.float64).reshape(3)
    after_essential = timer()
    seconds["essential"] = after_essential - after_matching
    if in_front < _FEWEST_MATCHES:
        return _failed(f"{in_front} points in front of both cameras", counts, seconds)
    used = np.asarray(inlier).reshape(-1) > 0
    here, there = np.eye(3, 4), np.column_stack([rotation, translation])
    stacked = cv2.triangulatePoints(here, there, flat_a[used].T, flat_b[used].T)
    with np.errstate(divide="ignore", invalid="ignore"):
        points = (stacked[:3] / stacked[3]).T
    near_enough = np.isfinite(points).all(axis=1) & (points[:, 2] > 0.0)
    near_enough &= points[:, 2] < _FURTHEST_BASELINES
    seconds["triangulation"] = timer() - after_essential
    return TwoView(
        None,
        rotation,
        # x_b = R x_a + t: the later camera stands at -R^T t.
        np.asarray(-rotation.T @ translation, np.float64),
        np.asarray(points[near_enough], np.float64),
        points_a[index_a][used][near_enough].astype(np.float64),
        *counts,
        seconds=seconds,
    )


def _features(sift: cv2.SIFT, image: NDArray[np.uint8]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    key_points, words = sift.detectAndCompute(image, None)
    points = np.array([point.pt for point in key_points], np.float32).reshape(-1, 2)
    return points, np.zeros((0, 128), np.float32) if words is None else np.asarray(words, np.float32)


def _matches(
    words_a: NDArray[np.float32], words_b: NDArray[np.float32]
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the indices of the matches that pass the ratio test; a key point of the later frame is used once, by the nearest."""
    if len(words_a) == 0 or len(words_b) < 2:
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(words_a, words_b, k=2)
    best: dict[int, tuple[float, int]] = {}
    for first, second in pairs:
        if first.distance >= _RATIO * second.distance:
            continue
        known = best.get(first.trainIdx)
        if known is None or first.distance < known[0]:
            best[first.trainIdx] = (first.distance, first.queryIdx)
    later = np.array(sorted(best), np.intp)
    return np.array([best[index][1] for index in sorted(best)], np.intp), later


def _on_unit_plane(camera: CameraModel, points_px: NDArray[np.float32]) -> NDArray[np.float64]:
    rays = camera.pixel_to_ray(points_px.astype(np.float64))
    return np.ascontiguousarray(rays[:, :2] / rays[:, 2:])


def _failed(why: str, counts: tuple[int, int, int], seconds: dict[str, float]) -> TwoView:
    nothing = np.zeros((0, 3))
    return TwoView(why, np.eye(3), np.zeros(3), nothing, np.zeros((0, 2)), *counts, seconds=seconds)

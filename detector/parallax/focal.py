"""The focal length from the flow itself, pooled over several pairs.

A wrong focal length bends the flow of a rotation: towards the borders it grows with the square of the angle from the axis. One pair says little of
that; a robust cost pooled over a dozen pairs that turn says it to a few per cent. Where it does not, the answer is a refusal with its reason, and
the caller goes on with what it assumed: a focal length 10 % too large is harmless, one 20 % too small is not.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from detector.camera_model import CameraModel
from detector.parallax.egomotion import cost_of_motion, estimate_egomotion
from detector.parallax.flow_field import FlowField
from detector.parallax.params import ParallaxParams
from detector.rotation import rotation_matrix, rotation_vector

_SHARES: Final = tuple(0.42 * 1.16**step for step in range(9))
"""Focal length over width that are tried: fields of view from 100 to 40 degrees."""
_SAMPLES: Final = 300


@dataclass(frozen=True, slots=True)
class FocalEstimate:
    """What several pairs say of the focal length.

    Attributes
    ----------
    share
        Focal length over image width; the best found, also where it is refused.
    sigma
        Standard deviation of ``share``; infinite where the cost has no minimum within what was tried.
    pairs
        Pairs behind it.
    refused
        Why it must not be used; None where it may.
    """

    share: float
    sigma: float
    pairs: int
    refused: str | None

    def camera(self, width_px: int, height_px: int) -> CameraModel:
        """Return the model: square pixels, no distortion, the axis in the middle."""
        focal_px = self.share * width_px
        return CameraModel(
            width_px, height_px, focal_px, focal_px, 0.5 * (width_px - 1), 0.5 * (height_px - 1)
        )


@dataclass(frozen=True, slots=True)
class _Pair:
    field: FlowField
    later_from_earlier: NDArray[np.float64]
    direction_later: NDArray[np.float64]


class FocalEstimator:
    """Collects flow fields and estimates the focal length from them.

    Parameters
    ----------
    params
        Settings; ``focal_pairs`` says how many fields are kept.
    """

    def __init__(self, params: ParallaxParams) -> None:
        self._params = params
        self._pairs: deque[_Pair] = deque(maxlen=params.focal_pairs)

    def __len__(self) -> int:
        return len(self._pairs)

    def add(self, field: FlowField) -> None:
        """Take the flow of another pair, measured with any undistorted camera model of the right size.

        The rotation that was taken out of it is put back: it was taken out by that model's focal length, exactly, so this leaves no trace of it.
        """
        used = field.where(field.believed)
        if len(used) < self._params.least_informative:
            return
        used = used.where(np.linspace(0, len(used) - 1, min(_SAMPLES, len(used))).astype(np.intp))
        motion = estimate_egomotion(used, self._params, attitude_given=False)
        if motion is None:
            return
        camera = used.camera
        as_taken_px = camera.ray_to_pixel(camera.pixel_to_ray(used.earlier_px) @ used.later_from_earlier)
        seen = np.asarray(np.isfinite(as_taken_px).all(axis=1), np.bool_)
        raw = replace(used, earlier_px=as_taken_px, later_from_earlier=np.eye(3)).where(seen)
        self._pairs.append(_Pair(raw, motion.later_from_earlier, motion.direction_later))

    def estimate(self) -> FocalEstimate:
        """Return the focal length that explains all fields best, or why there is none."""
        return _estimated(tuple(self._pairs), self._params)


def _estimated(pairs: Sequence[_Pair], params: ParallaxParams) -> FocalEstimate:
    count = len(pairs)
    if count < params.focal_least_pairs:
        return FocalEstimate(
            math.nan, math.inf, count, f"{count} pairs, at least {params.focal_least_pairs} needed"
        )
    logs = np.log(np.array(_SHARES))
    costs = np.array([_pooled_cost(pairs, share, params) for share in _SHARES])
    best = int(np.argmin(costs))
    if best in (0, len(_SHARES) - 1):
        return FocalEstimate(
            _SHARES[best],
            math.inf,
            count,
            "the best one lies at the end of what is tried: nothing bends the flow",
        )
    # A parabola through the best and its neighbours, in the logarithm: its bottom is the answer, its curvature the certainty (the cost is a chi square).
    near = slice(best - 1, best + 2)
    half_curvature, slope, _ = np.polyfit(logs[near] - logs[best], costs[near], 2)
    if not half_curvature > 0.0:
        return FocalEstimate(_SHARES[best], math.inf, count, "the cost has no minimum")
    found = _SHARES[best] * math.exp(-float(slope) / (2.0 * float(half_curvature)))
    relative = 1.0 / math.sqrt(float(half_curvature))
    refused = None
    if relative > params.focal_most_sigma:
        refused = (
            f"known to {100.0 * relative:.0f} %, at least {100.0 * params.focal_most_sigma:.0f} % needed: "
            "the camera turned too little, or saw too little"
        )
    return FocalEstimate(found, relative * found, count, refused)


def _pooled_cost(pairs: Sequence[_Pair], share: float, params: ParallaxParams) -> float:
    total = 0.0
    for pair in pairs:
        was = pair.field.camera
        camera = FocalEstimate(share, 0.0, 0, None).camera(was.width_px, was.height_px)
        # A shorter focal length makes the same flow a larger turn.
        turn = rotation_matrix(rotation_vector(pair.later_from_earlier) * (was.fx_px / camera.fx_px))
        cost, _ = cost_of_motion(replace(pair.field, camera=camera), params, (turn, pair.direction_later))
        total += cost
    return total

"""Tell the flow of a camera that only turned from flow that holds parallax.

A turning camera sees no parallax: its flow says nothing of depth, however large it is.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from detector.flow import Camera, Tracks

_ROUNDS = 12
_SCALE_RAD = 0.002
"""Residuals beyond this lose weight: a part of the scene may move, or lie near enough to show parallax."""


def fit_rotation(start_rays: NDArray[np.float64], end_rays: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotation that best takes one set of rays to the other.

    Orthogonal Procrustes by singular values, reweighted (Cauchy) so that nearby objects do not pull.

    Parameters
    ----------
    start_rays, end_rays
        (..., N, 3) unit rays of the same points, N >= 3; a fit for each of the leading indices.

    Returns
    -------
    (..., 3, 3) ``later_from_earlier``.
    """
    weights = np.ones((*start_rays.shape[:-1], 1))
    rotation = np.broadcast_to(np.eye(3), (*start_rays.shape[:-2], 3, 3))
    for _ in range(_ROUNDS):
        u, _, vt = np.linalg.svd((end_rays * weights).swapaxes(-1, -2) @ start_rays)
        u[..., :, 2] *= (np.linalg.det(u) * np.linalg.det(vt))[..., None]  # a rotation, not a reflection
        rotation = u @ vt
        away = end_rays - start_rays @ rotation.swapaxes(-1, -2)
        weights = 1.0 / (1.0 + np.einsum("...i,...i->...", away, away)[..., None] / _SCALE_RAD**2)
    return rotation


def parallax_px(cameras: Sequence[Camera], tracks: Tracks, *, percentile: float = 80.0) -> float:
    """Return the flow that the best pure rotation leaves, in px of the second frame.

    Parameters
    ----------
    cameras
        One, or several where the field of view is not known: the one that explains most counts. It matters, since towards the borders
        a turn's flow grows with the square of the angle from the axis.
    tracks
        Before any rotation is taken out.
    percentile
        Of the residual lengths; high, since near objects may be few.
    """
    start = np.stack([camera.pixel_to_ray(tracks.start_px) for camera in cameras])
    end = np.stack([camera.pixel_to_ray(tracks.end_px) for camera in cameras])
    turned = start @ fit_rotation(start, end).swapaxes(-1, -2)
    at_px = np.stack([camera.ray_to_pixel(rays) for camera, rays in zip(cameras, turned, strict=True)])
    left_px = np.linalg.norm(tracks.end_px - at_px, axis=2)
    if np.isfinite(left_px).all():  # all cameras at once, in a fraction of the time
        return float(np.percentile(left_px, percentile, axis=1).min())
    return min(
        float(np.percentile(left[np.isfinite(left)], percentile)) if np.isfinite(left).any() else 0.0
        for left in left_px
    )


def rotation_matrix(vector_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (3, 3) rotation of a rotation vector (3,), in rad (Rodrigues)."""
    angle = float(np.linalg.norm(vector_rad))
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = vector_rad / angle
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    rotation: NDArray[np.float64] = (
        np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * cross @ cross
    )
    return rotation


def rotation_vector(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotation vector (3,), in rad, of a small rotation (3, 3), below a quarter turn."""
    twice_sine_axis = np.array(
        [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
    )
    sine = 0.5 * float(np.linalg.norm(twice_sine_axis))
    return np.asarray(0.5 * twice_sine_axis * (math.asin(min(sine, 1.0)) / sine if sine > 1e-9 else 1.0))

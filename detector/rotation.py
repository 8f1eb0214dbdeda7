"""Tell the flow of a camera that only turned from flow that holds parallax.

A turning camera sees no parallax: its flow says nothing of depth, however large it is.
"""

from __future__ import annotations

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
        (N, 3) unit rays of the same points, N >= 3.

    Returns
    -------
    (3, 3) ``later_from_earlier``.
    """
    weights = np.ones(len(start_rays))
    rotation = np.eye(3)
    for _ in range(_ROUNDS):
        u, _, vt = np.linalg.svd((end_rays * weights[:, None]).T @ start_rays)
        rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u) * np.linalg.det(vt)]) @ vt
        residual = np.linalg.norm(end_rays - start_rays @ rotation.T, axis=1)
        weights = 1.0 / (1.0 + (residual / _SCALE_RAD) ** 2)
    return rotation


def parallax_px(camera: Camera, tracks: Tracks, *, percentile: float = 80.0) -> float:
    """Return the flow that the best pure rotation leaves, in px of the second frame.

    Parameters
    ----------
    camera
        Its field of view matters: towards the borders a turn's flow grows with the square of the angle from the axis.
    tracks
        Before any rotation is taken out.
    percentile
        Of the residual lengths; high, since near objects may be few.
    """
    rotation = fit_rotation(camera.pixel_to_ray(tracks.start_px), camera.pixel_to_ray(tracks.end_px))
    turned = camera.ray_to_pixel(camera.pixel_to_ray(tracks.start_px) @ rotation.T)
    left = np.linalg.norm(tracks.end_px - turned, axis=1)
    left = left[np.isfinite(left)]
    return float(np.percentile(left, percentile)) if left.size else 0.0

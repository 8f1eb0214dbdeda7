"""Sparse optical flow (paper section 2.2): Lucas-Kanade there and back, and the distribution filter.

Rotation convention: given ``later_from_earlier``, the *start* of every vector is moved to where a pure rotation of
the camera would put it in the second frame. What is left between start and end is the flow of the translation
alone, every end is a real pixel of the second frame, and so is every point found from the ends (cluster
centres, (x_d, y_d)).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from detector.params import DetectorParams


class Camera(Protocol):
    """What the flow asks of a camera model."""

    def pixel_to_ray(self, points_px: NDArray[np.floating], /) -> NDArray[np.float64]:
        """Return the (N, 3) unit rays of (N, 2) pixels."""
        ...

    def ray_to_pixel(self, rays: NDArray[np.floating], /) -> NDArray[np.float64]:
        """Return the (N, 2) pixels of (N, 3) rays, NaN behind the camera."""
        ...


@dataclass(frozen=True, slots=True)
class Tracks:
    """Optical flow vectors of one pair.

    Attributes
    ----------
    start_px
        (N, 2) float64. Where the point was, moved into the second camera's orientation when the rotation is known.
    end_px
        (N, 2) float64. Where it is in the second frame.
    """

    start_px: NDArray[np.float64]
    end_px: NDArray[np.float64]

    def __post_init__(self) -> None:
        for name, points in (("start_px", self.start_px), ("end_px", self.end_px)):
            if points.ndim != 2 or points.shape[1] != 2:
                raise ValueError(f"{name}: expected (N, 2), got {points.shape}")
        if len(self.start_px) != len(self.end_px):
            raise ValueError(f"expected as many starts as ends, got {len(self.start_px)}, {len(self.end_px)}")

    @classmethod
    def none(cls) -> Tracks:
        """Return no vectors."""
        return cls(np.zeros((0, 2)), np.zeros((0, 2)))

    def __len__(self) -> int:
        return len(self.start_px)

    def __getitem__(self, keep: NDArray[np.bool_] | NDArray[np.intp] | slice) -> Tracks:
        return Tracks(self.start_px[keep], self.end_px[keep])

    @property
    def flow_px(self) -> NDArray[np.float64]:
        """(N, 2) end minus start."""
        return self.end_px - self.start_px

    @property
    def lengths_px(self) -> NDArray[np.float64]:
        """(N,) length of each vector."""
        flow = self.flow_px
        return np.hypot(flow[:, 0], flow[:, 1])

    @property
    def angles_deg(self) -> NDArray[np.float64]:
        """(N,) angle alpha of each vector to the x axis, y down, in [0, 360)."""
        flow = self.flow_px
        angles: NDArray[np.float64] = np.degrees(np.arctan2(flow[:, 1], flow[:, 0])) % 360.0
        angles[angles >= 360.0] = 0.0  # a tiny negative angle rounds up to 360
        return angles


def track(
    from_image: NDArray[np.uint8],
    to_image: NDArray[np.uint8],
    points_px: NDArray[np.floating],
    *,
    window_px: int = 15,
    levels: int = 5,
    iterations: int = 10,
    epsilon_px: float = 0.03,
    guess_px: NDArray[np.floating] | None = None,
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Follow points from one image to another with pyramidal Lucas-Kanade.

    Parameters
    ----------
    from_image, to_image
        (H, W) uint8, same size.
    points_px
        (N, 2) points in ``from_image``.
    window_px, levels, iterations, epsilon_px
        Window side, pyramid levels above the base, and the two stopping rules.
    guess_px
        (N, 2) where to start looking in ``to_image``; the points themselves when not given.

    Returns
    -------
    (N, 2) float32 points in ``to_image`` and (N,) bool, whether each was found.
    """
    if len(points_px) == 0:
        return np.zeros((0, 2), np.float32), np.zeros(0, np.bool_)
    points = np.ascontiguousarray(points_px, dtype=np.float32).reshape(-1, 1, 2)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, iterations, epsilon_px)
    start = np.zeros_like(points)
    flags = 0
    if guess_px is not None:
        start = np.array(guess_px, dtype=np.float32).reshape(-1, 1, 2)
        flags = cv2.OPTFLOW_USE_INITIAL_FLOW
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        from_image,
        to_image,
        points,
        start,
        winSize=(window_px, window_px),
        maxLevel=levels,
        criteria=criteria,
        flags=flags,
    )
    ends = np.asarray(found, dtype=np.float32).reshape(-1, 2)
    ok = (np.asarray(status).reshape(-1) == 1) & np.isfinite(ends).all(axis=1)
    return ends, ok


def track_by(
    params: DetectorParams,
    from_image: NDArray[np.uint8],
    to_image: NDArray[np.uint8],
    points_px: NDArray[np.floating],
    guess_px: NDArray[np.floating] | None = None,
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return :func:`track` with a detector's settings of Lucas-Kanade."""
    return track(
        from_image,
        to_image,
        points_px,
        window_px=params.lk_window_px,
        levels=params.lk_levels,
        iterations=params.lk_iterations,
        epsilon_px=params.lk_epsilon_px,
        guess_px=guess_px,
    )


def distribution_filter(
    start_px: NDArray[np.floating], returned_px: NDArray[np.floating], limit_px: float = 0.5
) -> NDArray[np.bool_]:
    """Keep what comes back to where it started (N -> N').

    Parameters
    ----------
    start_px, returned_px
        (N, 2) the points, and the same points followed there and back.
    limit_px
        Largest difference on either axis, exclusive.

    Returns
    -------
    (N,) bool.
    """
    difference = np.abs(np.asarray(returned_px, np.float64) - np.asarray(start_px, np.float64))
    kept: NDArray[np.bool_] = np.all(difference < limit_px, axis=1)
    return kept


def derotate(
    points_px: NDArray[np.floating], camera: Camera, later_from_earlier: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return where points of the first frame would be if the camera had only rotated.

    Parameters
    ----------
    points_px
        (N, 2) points of the first frame.
    camera
        Pixel to ray and back.
    later_from_earlier
        (3, 3) rotation that takes coordinates of the earlier camera to those of the later one.

    Returns
    -------
    (N, 2) points in the second frame, NaN where they fall behind the camera.
    """
    rays = np.asarray(camera.pixel_to_ray(np.asarray(points_px, np.float64)))
    rotated: NDArray[np.float64] = np.asarray(camera.ray_to_pixel(rays @ later_from_earlier.T), np.float64)
    return rotated

"""What one pair says about ranges: the interface between the flow (egomotion, ranges) and the void map.

The level frame
    Its z axis points down. Where the camera's pose is known it is that of the pose itself: local NED, x north, y east, so that the
    azimuths of different pairs can be compared. Where it is not, x lies along the later camera's optical axis, y to its right, and the
    camera is taken to be level. Rays start at the *later* camera.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class RangedSamples:
    """Rays with the inverse of their range. Parallax measures the inverse: it has a normal error, and zero means far.

    Attributes
    ----------
    rays_level
        (N, 3) unit vectors in the level frame (see the module), from the later camera.
    inverse_range
        (N,) 1/m, or 1/baseline where ``metric`` is false. Noise may make it negative.
    sigma
        (N,) its standard deviation, same unit, above zero.
    pixels_px
        (N, 2) x, y in the later frame, as it was taken (distortion and all).
    metric
        Whether the ranges are in metres; else in baselines, the distance between the two cameras.
    informative
        (N,) whether flow *along the epipolar line* could be measured there. Where it could not, ``inverse_range`` says nothing: a plain surface
        shows no flow, and that must not read as "infinitely far".
    """

    rays_level: NDArray[np.float64]
    inverse_range: NDArray[np.float64]
    sigma: NDArray[np.float64]
    pixels_px: NDArray[np.float64]
    metric: bool
    informative: NDArray[np.bool_]

    def __post_init__(self) -> None:
        n = len(self.rays_level)
        for name, shape in (
            ("rays_level", (n, 3)),
            ("inverse_range", (n,)),
            ("sigma", (n,)),
            ("pixels_px", (n, 2)),
            ("informative", (n,)),
        ):
            found = np.shape(getattr(self, name))
            if found != shape:
                raise ValueError(f"{name}: expected {shape}, got {found}")

    def __len__(self) -> int:
        return len(self.rays_level)

    def where(self, keep: NDArray[np.bool_]) -> RangedSamples:
        """Return the samples that a mask (N,) names."""
        return RangedSamples(
            self.rays_level[keep],
            self.inverse_range[keep],
            self.sigma[keep],
            self.pixels_px[keep],
            self.metric,
            self.informative[keep],
        )

    @staticmethod
    def none(*, metric: bool) -> RangedSamples:
        """Return no samples at all."""
        nothing = np.zeros(0)
        return RangedSamples(
            np.zeros((0, 3)), nothing, nothing, np.zeros((0, 2)), metric, np.zeros(0, np.bool_)
        )

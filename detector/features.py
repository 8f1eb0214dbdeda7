"""Key-point locations (paper section 2.1). They seed the optical flow; descriptors are never computed."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray


def feature_locations(
    image: NDArray[np.uint8], *, octave_layers: int = 3, contrast: float = 0.04, unique: bool = False
) -> NDArray[np.float32]:
    """Return where SIFT finds key points.

    Parameters
    ----------
    image
        (H, W) uint8.
    octave_layers
        Layers in an octave of the scale space.
    contrast
        Contrast threshold; larger finds fewer points.
    unique
        SIFT gives a location once for each dominant orientation. True keeps it once.

    Returns
    -------
    (N, 2) float32, x and y in px. A fixed image always gives the same points in the same order.
    """
    sift = cv2.SIFT.create(nfeatures=0, nOctaveLayers=octave_layers, contrastThreshold=contrast)
    key_points = sift.detect(image, None)
    locations = np.array([point.pt for point in key_points], dtype=np.float32).reshape(-1, 2)
    if unique and len(locations):
        _, first = np.unique(locations, axis=0, return_index=True)
        locations = locations[np.sort(first)]
    return locations

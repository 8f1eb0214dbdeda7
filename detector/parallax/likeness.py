"""Whether the two ends of a flow vector look alike.

Near things move by more pixels than the search can follow. In fine, even texture it then stays where it began, the way back ends at the start, and the sample reads as "surely far". But the
pieces of picture about its two ends are not the same piece of wall, and that shows: their correlation is that of two places picked at random.
"""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from detector.dense_flow import turned_picture
from detector.parallax.flow_field import FlowField

_HALF_PX: Final = 6
"""Patches of 13 x 13 px: chance alone rarely correlates 169 px of texture."""
_LEAST_CONTRAST: Final = 1e-6


def alike(
    earlier: NDArray[np.uint8], later: NDArray[np.uint8], field: FlowField, pixels_px: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the correlation of the patches about both ends of the flow, in [-1, 1].

    Parameters
    ----------
    earlier, later
        (H, W) uint8, the frames of the pair.
    field
        Its flow.
    pixels_px
        (N, 2) points of the later frame that are wanted, each one of ``field.later_px``.

    Returns
    -------
    (N,) zero-mean normalised cross-correlation; 1 where the flow is not believed: what a sample says there is not from it.
    """
    found = np.ones(len(pixels_px))
    if len(pixels_px) == 0 or not field.believed.any():
        return found
    turned, _ = turned_picture(earlier, field.camera, field.later_from_earlier)
    width_px = field.camera.width_px
    keys, wanted = (np.rint(at @ [1.0, width_px]) for at in (field.later_px, pixels_px))
    order = np.argsort(keys)
    index = order[np.minimum(np.searchsorted(keys[order], wanted), len(keys) - 1)]
    told = field.believed[index] & (keys[index] == wanted)
    index = index[told]
    ends = _patches(later, field.later_px[index]), _patches(turned, field.earlier_px[index])
    one, other = (patch - patch.mean(axis=1, keepdims=True) for patch in ends)
    contrast = np.sqrt((one**2).sum(axis=1) * (other**2).sum(axis=1))
    found[told] = (one * other).sum(axis=1) / np.maximum(contrast, _LEAST_CONTRAST)
    return found


def _patches(image: NDArray[np.uint8], middle_px: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (N, 169) grey values about points."""
    reach = np.arange(-_HALF_PX, _HALF_PX + 1)
    right, down = (offset.ravel() for offset in np.meshgrid(reach, reach))
    x = np.asarray(middle_px[:, :1] + right[None, :], np.float32)
    y = np.asarray(middle_px[:, 1:] + down[None, :], np.float32)
    return np.asarray(cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.float64)

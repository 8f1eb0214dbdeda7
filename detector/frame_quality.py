"""Is a frame fit for detection? Black, saturated, blurred (paper section 4: "unblurred frames"), or too small."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from cv2.typing import MatLike
from numpy.typing import NDArray

from detector.params import DetectorParams
from detector.results import NoDetectionReason

_BLUR_TAPS = 9
"""Length of the averaging filter of Crete et al."""

_BLUR_WIDTH_PX = 640
"""Blur is judged at this width or below: what a lens leaves unresolved at 1920 px is no motion blur."""


@dataclass(frozen=True, slots=True)
class FrameFault:
    """Why a frame cannot be used, and the figures behind it."""

    reason: NoDetectionReason
    detail: str


def perceptual_blur(image: NDArray[np.uint8]) -> float:
    """Return the blur of an image, from 0 (sharp) to 1, after Crete et al. 2007 ("The blur effect").

    The image is averaged along each axis: a sharp one loses much of its variation between neighbours, a blurred one
    hardly any. That is relative to the image's own variation, so neither brightness, contrast nor amount of texture
    matter. The larger of the two axes counts, because motion blurs along one direction.

    Returns
    -------
    float; 0 for an image without any variation, which is not blurred but empty.
    """
    width = image.shape[1]
    if width > _BLUR_WIDTH_PX:
        scale = _BLUR_WIDTH_PX / width
        image = np.asarray(
            cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8
        )
    # A light smoothing first: sensor noise varies from pixel to pixel and would pass for sharpness.
    # 16-bit integers with five binary places below a grey level: as good as floats here, at a quarter of their time.
    grey = cv2.multiply(cv2.GaussianBlur(image, (3, 3), 0), np.array([32.0]), dtype=cv2.CV_16S)
    worst = 0.0
    for axis in (0, 1):
        averaged = cv2.blur(grey, (1, _BLUR_TAPS) if axis == 0 else (_BLUR_TAPS, 1))
        variation, left = _variation(grey, axis), _variation(averaged, axis)
        lost = cv2.max(cv2.subtract(variation, left), np.zeros(1))
        total = cv2.sumElems(variation)[0]
        if total > 0.0:
            worst = max(worst, 1.0 - cv2.sumElems(lost)[0] / total)
    return float(worst)


def _variation(image: MatLike, axis: int) -> MatLike:
    """Return the absolute differences of neighbours along an axis."""
    return cv2.absdiff(image[1:], image[:-1]) if axis == 0 else cv2.absdiff(image[:, 1:], image[:, :-1])


def frame_fault(image: NDArray[np.uint8], params: DetectorParams) -> FrameFault | None:
    """Return what is wrong with one frame, or None.

    Parameters
    ----------
    image
        (H, W) uint8.
    params
        Limits.
    """
    height, width = image.shape
    if width < params.min_width_px or height < params.min_height_px:
        return FrameFault(
            NoDetectionReason.WRONG_SIZE,
            f"{width} x {height} px, at least {params.min_width_px} x {params.min_height_px} needed",
        )
    counts = cv2.calcHist([image], [0], None, [256], [0.0, 256.0])
    share = np.cumsum(counts, dtype=np.float64) / image.size  # of the pixels up to each grey
    saturated = 1.0 - float(share[math.ceil(params.saturated_grey) - 1])
    if saturated > params.saturated_fraction:
        return FrameFault(
            NoDetectionReason.SATURATED,
            f"{saturated:.0%} of the pixels saturated, at most {params.saturated_fraction:.0%}",
        )
    bright = int(np.searchsorted(share, 0.98))
    if bright < params.black_grey:
        return FrameFault(
            NoDetectionReason.BLACK,
            f"98 % of the pixels below grey {bright}, limit {params.black_grey:.0f}",
        )
    blur = perceptual_blur(image)
    if blur > params.blur_limit:
        return FrameFault(NoDetectionReason.BLURRED, f"blur {blur:.2f}, at most {params.blur_limit:.2f}")
    return None

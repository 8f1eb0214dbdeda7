"""A frame and what is worked out about it once, though it is the later frame of one pair and the earlier one of others."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from detector.camera_model import CameraModel
from detector.frame_quality import FrameFault, frame_fault
from detector.params import DetectorParams
from detector.results import NoDetectionReason


@dataclass(slots=True)
class Frame:
    """One frame.

    Attributes
    ----------
    image
        (H, W) uint8. Kept, not copied: it must not change any more.
    fault
        Why it cannot be used, if so.
    seeds_px
        (N, 2) where the flow starts when this is the earlier frame: found when first needed, or carried over from
        the pair that it was the later frame of, and renewed. None where nothing is known yet.
    carried_px
        (N, 2) ends of the vectors of the pair that it was the later frame of, not renewed yet.
    n_features
        How many key points were found, before any cap. None where nobody has looked.
    """

    image: NDArray[np.uint8]
    fault: FrameFault | None
    seeds_px: NDArray[np.float32] | None = None
    carried_px: NDArray[np.float64] | None = None
    n_features: int | None = None


def prepare(image: NDArray[np.uint8], params: DetectorParams) -> Frame:
    """Return a frame with its quality judged.

    Parameters
    ----------
    image
        (H, W) uint8.
    params
        Limits.

    Raises
    ------
    ValueError
        When the image is not (H, W) uint8.
    """
    if image.ndim != 2 or image.dtype != np.uint8:
        raise ValueError(f"expected (H, W) uint8, got {image.shape} {image.dtype}")
    return Frame(image, frame_fault(image, params))


def pair_fault(earlier: Frame, later: Frame, camera: CameraModel | None) -> FrameFault | None:
    """Return why two frames cannot be used as a pair; None where they can.

    Parameters
    ----------
    earlier, later
        The frames.
    camera
        Of both, if known.
    """
    height_px, width_px = later.image.shape
    if earlier.image.shape != later.image.shape:
        return FrameFault(
            NoDetectionReason.WRONG_SIZE,
            f"frames of {_size(earlier)} and {_size(later)}: they must be of one size",
        )
    if camera is not None and (width_px, height_px) != (camera.width_px, camera.height_px):
        return FrameFault(
            NoDetectionReason.WRONG_SIZE,
            f"frames of {_size(later)}, the camera model is for {camera.width_px} x {camera.height_px}",
        )
    for name, frame in (("earlier", earlier), ("later", later)):
        if frame.fault is not None:
            return FrameFault(frame.fault.reason, f"{name} frame: {frame.fault.detail}")
    return None


def _size(frame: Frame) -> str:
    height_px, width_px = frame.image.shape
    return f"{width_px} x {height_px} px"

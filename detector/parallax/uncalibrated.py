"""The camera model where nobody gave one: estimated from the flow of the pairs so far, else assumed, and which of the two."""

from __future__ import annotations

from detector.camera_model import CameraError, CameraModel
from detector.parallax.flow_field import FlowField
from detector.parallax.focal import FocalEstimate, FocalEstimator
from detector.parallax.params import ParallaxParams
from detector.parallax.pipeline import Intrinsics


class UncalibratedCamera:
    """Learns the focal length from flow, pair by pair.

    Parameters
    ----------
    params
        ``assumed_hfov_deg``, ``focal_pairs``, ``focal_least_pairs``, ``focal_most_sigma``.
    """

    def __init__(self, params: ParallaxParams) -> None:
        self._params = params
        self._estimator = FocalEstimator(params)
        self._estimate: FocalEstimate | None = None
        self._size_px: tuple[int, int] | None = None
        self._since_estimate = 0

    @property
    def estimate(self) -> FocalEstimate | None:
        """What the pairs said last; None before the first ones, or after the frames' size changed."""
        return self._estimate

    def learn(self, field: FlowField) -> None:
        """Take the flow of a pair that moved; from time to time, estimate anew.

        An estimate takes about as long as a second of frames, so it is made when half of the least number of pairs is new.
        """
        size_px = (field.camera.width_px, field.camera.height_px)
        if size_px != self._size_px:
            self._estimator, self._estimate, self._since_estimate = FocalEstimator(self._params), None, 0
            self._size_px = size_px
        self._estimator.add(field)
        self._since_estimate += 1
        first = self._estimate is None and len(self._estimator) >= self._params.focal_least_pairs
        if first or (
            self._estimate is not None and 2 * self._since_estimate >= self._params.focal_least_pairs
        ):
            self._estimate = self._estimator.estimate()
            self._since_estimate = 0

    def intrinsics(self, width_px: int, height_px: int) -> Intrinsics | None:
        """Return the model for frames of a size, with ``estimated`` or ``assumed`` as its source; None for frames too small for any."""
        found = self._estimate if self._size_px == (width_px, height_px) else None
        try:
            if found is not None and found.refused is None:
                share = f"focal length {found.share:.3f} +- {found.sigma:.3f} of the width, from {found.pairs} pairs"
                return Intrinsics(found.camera(width_px, height_px), "estimated", share)
            assumed = CameraModel.from_hfov(width_px, height_px, self._params.assumed_hfov_deg)
        except CameraError:
            return None  # the detector says what is wrong with such a frame
        why = "not estimated yet" if found is None else f"estimate refused: {found.refused}"
        return Intrinsics(assumed, "assumed", f"{self._params.assumed_hfov_deg:g} degrees wide; {why}")

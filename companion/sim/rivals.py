"""Rivals for scale: a trivial answer in place of the detector's, everything else as it is for the paper's method.

They exist in the simulator alone. The service's configuration does not know them, because nobody should fly by them: their pipelines run in the worker
where a flight in simulated time asks for them by name (``companion.vision.pipeline.load_factory``).
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

import numpy as np
from numpy.typing import NDArray

from companion.config import CameraConfig, DetectorConfig
from companion.vision.child import FrameObserver, VoidPipeline, vehicle_of
from detector.camera_model import CameraModel
from detector.evaluation.methods import METHODS, Answer, Method, PairInput
from detector.flow import Tracks
from detector.frame import Frame, pair_fault
from detector.observer import VoidObserver
from detector.params import DetectorParams
from detector.pipeline import PairResult
from detector.results import Detection, Diagnostics, Direction, DirectionKind, NoDetection, NoDetectionReason

_KINDS: Final[Mapping[str, DirectionKind]] = MappingProxyType(
    {
        "straight": DirectionKind.LOWEST_FLOW,
        "flow_balance": DirectionKind.LOWEST_FLOW,
        "line_vp": DirectionKind.VANISHING_POINT,
    }
)
"""The rivals, and the name of a direction that theirs goes by: guidance makes no difference between directions."""
_REASONS: Final = {reason.value: reason for reason in NoDetectionReason}


def straight(detector: DetectorConfig, camera: CameraConfig) -> VoidPipeline:
    """Build the rival that answers the middle of the picture, wherever the camera moved."""
    return _RivalPipeline("straight", detector, camera)


def flow_balance(detector: DetectorConfig, camera: CameraConfig) -> VoidPipeline:
    """Build the rival that turns away from the side where more moves."""
    return _RivalPipeline("flow_balance", detector, camera)


def line_vp(detector: DetectorConfig, camera: CameraConfig) -> VoidPipeline:
    """Build the rival that answers the vanishing point of the picture's lines."""
    return _RivalPipeline("line_vp", detector, camera)


class _RivalPipeline(VoidPipeline):
    """The paper's pipeline with a rival in place of its detector; it measures how far the ways are free as that one does, by flow on a grid."""

    def __init__(self, rival: str, detector: DetectorConfig, camera: CameraConfig) -> None:
        super().__init__(DetectorParams.preset(detector.preset), camera, None, vehicle_of(detector))
        self._method = rival

    def _observer_of(self, model: CameraModel) -> FrameObserver:
        rival = RivalDetector(METHODS[self._method](self._params), _KINDS[self._method])
        return VoidObserver(self._params, model, observer_params=self._observer_params, detector=rival)


class RivalDetector:
    """Stands where the observer has its detector (:class:`detector.observer.PairDetector`).

    Parameters
    ----------
    method
        Who answers.
    kind
        What its directions are called.
    """

    def __init__(self, method: Method, kind: DirectionKind) -> None:
        self._method = method
        self._kind = kind

    def detect(
        self,
        earlier: Frame,
        later: Frame,
        *,
        camera: CameraModel | None = None,
        later_from_earlier: NDArray[np.float64] | None = None,
        translation_earlier: NDArray[np.float64] | None = None,
    ) -> PairResult:
        """Return the rival's answer to a pair, without tracks: it has none."""
        fault = pair_fault(earlier, later, camera)
        if fault is not None:
            return _result(NoDetection(fault.reason, fault.detail, Diagnostics()))
        answer = self._method.answer(
            PairInput(earlier.image, later.image, camera, later_from_earlier, translation_earlier)
        )
        return _result(_detection(answer, self._kind))

    def reset(self) -> None:
        """Forget what was learned from earlier pairs."""
        self._method.reset()


def _detection(answer: Answer, kind: DirectionKind) -> Detection:
    if answer.point_px is not None:
        return Direction(*answer.point_px, kind, None, Diagnostics())
    reason = answer.reason or ""
    return NoDetection(_REASONS.get(reason, NoDetectionReason.NOTHING_KNOWN), reason, Diagnostics())


def _result(detection: Detection) -> PairResult:
    return PairResult(detection, Tracks.none(), None)

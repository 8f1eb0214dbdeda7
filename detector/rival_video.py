"""A clip, frame by frame, by a rival method: the same pairs as the detector's, and what the rival says of each."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from detector.camera_model import CameraModel
from detector.evaluation.methods import Method, PairInput
from detector.flow import Tracks
from detector.frame import Frame
from detector.observer import CameraPose, ObserverParams, VoidObserver
from detector.params import DetectorParams
from detector.pipeline import PairResult
from detector.results import Diagnostics, NoDetection, NoDetectionReason
from detector.video import Answered, FrameAnswerer

_LEFT_TO_THE_RIVAL: Final = PairResult(
    NoDetection(NoDetectionReason.NOTHING_KNOWN, "the rival answers, not the observer", Diagnostics()),
    Tracks.none(),
    None,
)
"""What the observer is told of a pair, and nobody else: a rival's answers are of kinds that a detection has not."""


def by_rival(method: Method, params: DetectorParams, camera: CameraModel | None) -> FrameAnswerer:
    """Return what answers by a method of :data:`detector.evaluation.methods.METHODS`, on pairs chosen as for the detector.

    Parameters
    ----------
    method
        Whose answers; it is told the motion where both poses and the camera are known.
    params
        What counts as a usable frame.
    camera
        Its model, if known.
    """
    taker = _PairTaker(method)
    # The flow on a grid is for ranges, which are not asked for here.
    observer = VoidObserver(params, camera, observer_params=ObserverParams(dense=None), detector=taker)

    def answer(image: NDArray[np.uint8], time_ns: int, pose: CameraPose | None) -> Answered:
        taker.next(pose)
        seen = observer.observe(image, time_ns, pose)
        pair = taker.taken()
        if pair is None:  # the observer says why there was none
            return Answered.of(seen, Tracks.none())
        said = method.answer(pair)
        return Answered(said, None, seen.time_ns, seen.earlier_time_ns, seen.baseline_m, Tracks.none())

    return answer


class _PairTaker:
    """Stands where the observer has its detector (:class:`detector.observer.PairDetector`), and keeps the pair that it is given."""

    def __init__(self, method: Method) -> None:
        self._method = method
        self._pair: PairInput | None = None
        self._pose: CameraPose | None = None

    def next(self, pose: CameraPose | None) -> None:
        """Take the pose of the frame that comes next."""
        self._pair, self._pose = None, pose

    def taken(self) -> PairInput | None:
        """Return that frame's pair; None where the observer chose none."""
        return self._pair

    def detect(
        self,
        earlier: Frame,
        later: Frame,
        *,
        camera: CameraModel | None = None,
        later_from_earlier: NDArray[np.float64] | None = None,
        translation_earlier: NDArray[np.float64] | None = None,
    ) -> PairResult:
        self._pair = PairInput(
            earlier.image,
            later.image,
            camera,
            later_from_earlier,
            translation_earlier,
            None if self._pose is None else self._pose.world_from_camera,
        )
        return _LEFT_TO_THE_RIVAL

    def reset(self) -> None:
        self._method.reset()

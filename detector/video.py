"""A clip, frame by frame: the answer on each, and the annotated picture of it."""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from detector.camera_model import CameraModel
from detector.drawing import sheet
from detector.evaluation.methods import Answer, answer_of
from detector.flow import Tracks
from detector.frame import Frame
from detector.observer import CameraPose, Observation, VoidObserver
from detector.overlay import draw, draw_answer, legible_zoom
from detector.params import DetectorParams
from detector.pipeline import PairResult, VoidDetector
from detector.results import Detection, Diagnostics, NoDetection, NoDetectionReason

PANELS_A_ROW: Final = 3
_GAP_PX: Final = 10
_DIGITS: Final = re.compile(r"(\d+)")


@dataclass(frozen=True, slots=True)
class Answered:
    """What is known after one frame of a clip.

    Attributes
    ----------
    answer
        What the method says, in the words that all methods have.
    detection
        The same with all that the detector found on the way; None of a rival, which finds nothing else.
    time_ns, earlier_time_ns
        Of this frame and of its partner; None where there was none.
    baseline_m
        Metres flown between the two, where both poses are known.
    tracks
        The N' vectors behind it; empty where no pair was looked at.
    paint
        Draws the answer on the frame, with lines of text; None: as :mod:`detector.overlay` does.
    """

    answer: Answer
    detection: Detection | None
    time_ns: int
    earlier_time_ns: int | None
    baseline_m: float | None
    tracks: Tracks
    paint: Callable[[NDArray[np.uint8], tuple[str, ...]], NDArray[np.uint8]] | None = None

    @classmethod
    def of(
        cls,
        observation: Observation,
        tracks: Tracks,
        paint: Callable[[NDArray[np.uint8], tuple[str, ...]], NDArray[np.uint8]] | None = None,
    ) -> Self:
        """Return an observation's answer."""
        return cls(
            answer_of(observation.detection),
            observation.detection,
            observation.time_ns,
            observation.earlier_time_ns,
            observation.baseline_m,
            tracks,
            paint,
        )

    @property
    def result(self) -> PairResult | None:
        """The detection with its tracks, for drawing; None of a rival."""
        return None if self.detection is None else PairResult(self.detection, self.tracks, None)


FrameAnswerer = Callable[[NDArray[np.uint8], int, CameraPose | None], Answered]
"""Takes the next frame (H, W) uint8, its time in ns and its pose, if known."""


def by_observer(params: DetectorParams, camera: CameraModel | None) -> FrameAnswerer:
    """Return what answers as a vehicle does: the partner of each frame is chosen by the distance flown, else by the median flow."""
    recorder = _Recorder(VoidDetector(params))
    observer = VoidObserver(params, camera, detector=recorder)

    def answer(image: NDArray[np.uint8], time_ns: int, pose: CameraPose | None) -> Answered:
        recorder.tracks = Tracks.none()
        observation = observer.observe(image, time_ns, pose)
        return Answered.of(observation, recorder.tracks)

    return answer


def by_fixed_step(params: DetectorParams, camera: CameraModel | None, step: int) -> FrameAnswerer:
    """Return what pairs each frame with the one ``step`` frames before it.

    Parameters
    ----------
    params, camera
        Of the detector.
    step
        1 pairs neighbours.

    Raises
    ------
    ValueError
        For a step below 1.
    """
    if step < 1:
        raise ValueError(f"step: expected 1 or more, got {step}")
    detector = VoidDetector(params)
    kept: deque[tuple[Frame, int, CameraPose | None]] = deque(maxlen=step)

    def answer(image: NDArray[np.uint8], time_ns: int, pose: CameraPose | None) -> Answered:
        later = detector.prepare(image.copy())
        earlier = kept[0] if len(kept) == step else None
        kept.append((later, time_ns, pose))
        if earlier is None:
            words = f"frame {len(kept)} of the first {step}"
            nothing = NoDetection(NoDetectionReason.NO_EARLIER_FRAME, words, Diagnostics())
            return Answered.of(Observation(nothing, time_ns), Tracks.none())
        frame, earlier_ns, earlier_pose = earlier
        rotation = translation = baseline_m = None
        if pose is not None and earlier_pose is not None:
            baseline_m = float(np.linalg.norm(pose.position_m - earlier_pose.position_m))
            if camera is not None:
                rotation, translation = earlier_pose.motion_to(pose)
        result = detector.detect(
            frame, later, camera=camera, later_from_earlier=rotation, translation_earlier=translation
        )
        return Answered.of(Observation(result.detection, time_ns, earlier_ns, baseline_m), result.tracks)

    return answer


class _Recorder:
    """A detector that remembers the tracks of the pair it last saw."""

    def __init__(self, detector: VoidDetector) -> None:
        self._detector = detector
        self.tracks = Tracks.none()

    def detect(
        self,
        earlier: Frame,
        later: Frame,
        *,
        camera: CameraModel | None = None,
        later_from_earlier: NDArray[np.float64] | None = None,
        translation_earlier: NDArray[np.float64] | None = None,
    ) -> PairResult:
        result = self._detector.detect(
            earlier,
            later,
            camera=camera,
            later_from_earlier=later_from_earlier,
            translation_earlier=translation_earlier,
        )
        self.tracks = result.tracks
        return result

    def reset(self) -> None:
        self._detector.reset()


def annotated(image: NDArray[np.uint8], answered: Answered, number: int, time_s: float) -> NDArray[np.uint8]:
    """Return a frame with its answer, its number and time and how far its partner lies back.

    Parameters
    ----------
    image
        (H, W) uint8; small ones are enlarged until the text can be read.
    answered
        The answer on it.
    number, time_s
        Of the frame in its clip.

    Returns
    -------
    (H', W', 3) uint8, BGR, both sides even: video codecs need it.
    """
    words = f"frame {number}  {time_s:.2f} s"
    if answered.earlier_time_ns is not None:
        words += f"  pair over {(answered.time_ns - answered.earlier_time_ns) * 1e-9:.2f} s"
    if answered.baseline_m is not None:
        words += f", {answered.baseline_m:.2f} m"
    zoom, result = legible_zoom(image.shape[1]), answered.result
    if answered.paint is not None:
        picture = answered.paint(image, (words,))
    elif result is not None:
        picture = draw(image, result, zoom=zoom, notes=(words,))
    else:
        picture = draw_answer(image, answered.answer, zoom=zoom, notes=(words,))
    return _even(picture)


def side_by_side(
    image: NDArray[np.uint8], answered: Mapping[str, Answered], number: int, time_s: float
) -> NDArray[np.uint8]:
    """Return a frame with the answers of several methods, each in a panel with the method's name below it.

    Parameters
    ----------
    image
        (H, W) uint8.
    answered
        By method, in their order; :data:`PANELS_A_ROW` in a row. One alone has the whole picture, without its name.
    number, time_s
        As for :func:`annotated`, whose panels these are.

    Returns
    -------
    (H', W', 3) uint8, BGR, both sides even.
    """
    panels = {name: annotated(image, each, number, time_s) for name, each in answered.items()}
    if len(panels) == 1:
        return next(iter(panels.values()))
    # Apart from the row below, whose names they would else seem to be.
    labelled = [
        np.pad(sheet.captioned(picture, name), ((0, _GAP_PX), (0, 0), (0, 0)), constant_values=255)
        for name, picture in panels.items()
    ]
    rows = [labelled[first : first + PANELS_A_ROW] for first in range(0, len(labelled), PANELS_A_ROW)]
    return _even(sheet.one_below_the_other([sheet.side_by_side(row) for row in rows]))


def _even(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    height, width = picture.shape[:2]
    return np.pad(picture, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")


def fitted(picture: NDArray[np.uint8], size_px: tuple[int, int]) -> NDArray[np.uint8]:
    """Return the picture at a width and height, whole and in proportion, on black.

    Parameters
    ----------
    picture
        (H, W, 3) uint8.
    size_px
        Width and height wanted.
    """
    width, height = size_px
    if picture.shape[:2] == (height, width):
        return picture
    scale = min(width / picture.shape[1], height / picture.shape[0])
    inner = (
        min(width, max(1, round(picture.shape[1] * scale))),
        min(height, max(1, round(picture.shape[0] * scale))),
    )
    whole = np.zeros((height, width, 3), np.uint8)
    left, top = (width - inner[0]) // 2, (height - inner[1]) // 2
    whole[top : top + inner[1], left : left + inner[0]] = cv2.resize(
        picture, inner, interpolation=cv2.INTER_AREA
    )
    return whole


def natural_key(name: str) -> list[tuple[bool, int, str]]:
    """Return what to sort names by so that frame 9 comes before frame 10."""
    parts = _DIGITS.split(name)
    return [
        (True, int(part), part) if index % 2 else (False, 0, part.lower()) for index, part in enumerate(parts)
    ]

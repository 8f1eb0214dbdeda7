"""Ways of answering a pair that can be judged side by side: the paper's, and trivial rivals that say what chance level is."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from detector import lines, vanishing_point
from detector.camera_model import CameraModel
from detector.expansion import fit_focus_of_expansion, ideal_px
from detector.flow import Tracks
from detector.parallax import line_vp
from detector.parallax.flow_field import measure_flow
from detector.parallax.params import ParallaxParams
from detector.parallax.pipeline import Intrinsics, ParallaxDetector
from detector.params import DetectorParams
from detector.pipeline import VoidDetector
from detector.results import Detection, Direction, NoDetection

SINGLE_PLANE: Final = "single_plane"
NONE: Final = "none"
_BALANCE_FLOW: Final = ParallaxParams(width_px=320)
_BALANCE_HFOV_DEG: Final = 70.0
_BALANCE_STILL_PX: Final = 0.2
_BALANCE_LEAST_PX: Final = 64
_LEAST_CAMERA_PX: Final = 16
"""Of the side of a camera's picture (:class:`detector.camera_model.CameraModel`): for less not even one can be assumed."""


@dataclass(frozen=True, slots=True)
class PairInput:
    """What a method is given.

    Attributes
    ----------
    earlier, later
        (H, W) uint8.
    camera
        None where it is not known.
    later_from_earlier
        (3, 3) rotation that takes coordinates of the earlier camera to those of the later one; None where not given.
    translation_earlier_m
        (3,) from the earlier to the later position, in the earlier camera's axes; None where not given.
    level_from_later
        (3, 3) rotation from the later camera to a level frame, its z down; None where not given.
    """

    earlier: NDArray[np.uint8]
    later: NDArray[np.uint8]
    camera: CameraModel | None = None
    later_from_earlier: NDArray[np.float64] | None = None
    translation_earlier_m: NDArray[np.float64] | None = None
    level_from_later: NDArray[np.float64] | None = None


@dataclass(frozen=True, slots=True)
class Answer:
    """What a method says of a pair.

    Attributes
    ----------
    kind
        ``single_plane``, ``none``, or the name of what gave the direction.
    point_px
        The direction, x, y in the later frame; None unless the kind is a direction.
    reason
        Of ``none``.
    contact_frames
        Time to contact in steps of the pair's length, from the later frame.
    focus_px
        Focus of expansion in the later frame (without distortion) where the method *estimated* it; None where it was given.
    confidence
        In [0, 1], where the method says it.
    tracks
        The flow vectors behind the answer, rotation taken out where it was given. Where the method was told the focus they still say what it would
        have found.
    """

    kind: str
    point_px: tuple[float, float] | None = None
    reason: str | None = None
    contact_frames: float | None = None
    focus_px: tuple[float, float] | None = None
    confidence: float | None = None
    tracks: Tracks | None = field(default=None, compare=False, repr=False)


class Method(Protocol):
    """One way of answering."""

    def answer(self, pair: PairInput, /) -> Answer:
        """Return the answer to a pair."""
        ...

    def vanishing_point(self, image: NDArray[np.uint8], /) -> tuple[float, float] | None:
        """Return what the method's lines alone say of one image; None where they say nothing."""
        ...

    def reset(self) -> None:
        """Forget what was learned from earlier pairs."""
        ...


class _Lines:
    """The paper's line stage, which the methods share but for ``parallax``."""

    def __init__(self, params: DetectorParams) -> None:
        self._params = params

    def vanishing_point(self, image: NDArray[np.uint8], /) -> tuple[float, float] | None:
        return line_vanishing_point(image, self._params)

    def reset(self) -> None:
        """Nothing is kept."""


class PaperMethod(_Lines):
    """The detector (:class:`detector.pipeline.VoidDetector`)."""

    def __init__(self, params: DetectorParams) -> None:
        super().__init__(params)
        self._detector = VoidDetector(params)

    def answer(self, pair: PairInput, /) -> Answer:
        """Return the detector's answer."""
        result = self._detector.detect(
            pair.earlier,
            pair.later,
            camera=pair.camera,
            later_from_earlier=pair.later_from_earlier,
            translation_earlier=pair.translation_earlier_m,
        )
        told = pair.translation_earlier_m is not None
        return answer_of(result.detection, focus_px=None if told else result.focus_px, tracks=result.tracks)

    def reset(self) -> None:
        """Make the next pair a first loop."""
        self._detector.reset()


class ParallaxMethod(_Lines):
    """The parallax method (:class:`detector.parallax.pipeline.ParallaxDetector`), each pair by itself.

    Parameters
    ----------
    params
        What counts as a usable frame.
    parallax
        The method's own; by default those it has.
    """

    def __init__(self, params: DetectorParams, parallax: ParallaxParams | None = None) -> None:
        super().__init__(params)
        self._detector = ParallaxDetector(parallax, frame_params=params)

    def vanishing_point(self, image: NDArray[np.uint8], /) -> tuple[float, float] | None:
        """Return where whole-image segments meet (:mod:`detector.parallax.line_vp`)."""
        found = line_vp.line_vanishing_point(image)
        return None if found is None else (found.x_px, found.y_px)

    def answer(self, pair: PairInput, /) -> Answer:
        """Return the method's answer. What it says of the focus of expansion is estimated, also where it was told the motion: that is a prior."""
        if pair.camera is None and min(pair.later.shape) < _LEAST_CAMERA_PX:
            return Answer(NONE, reason="wrong_size")
        result = self._detector.detect(
            pair.earlier,
            pair.later,
            intrinsics=None if pair.camera is None else Intrinsics(pair.camera, "calibration"),
            later_from_earlier=pair.later_from_earlier,
            translation_earlier_m=pair.translation_earlier_m,
            level_from_later=pair.level_from_later,
        )
        return answer_of(result.detection, focus_px=result.focus_px)


class FlowBalance(_Lines):
    """Turn away from the side where more moves: the balance of left and right flow, as bees do it (Srinivasan et al. 1996).

    The direction lies off the middle of the image by the share of half its width that (left - right) / (left + right) of the mean flow says.
    The rotation is taken out where it is given.
    """

    def answer(self, pair: PairInput, /) -> Answer:
        """Return the balanced direction."""
        height_px, width_px = pair.later.shape
        usable = pair.earlier.shape == pair.later.shape and min(height_px, width_px) >= _BALANCE_LEAST_PX
        if not usable or (
            pair.camera is not None and (pair.camera.width_px, pair.camera.height_px) != (width_px, height_px)
        ):
            return Answer(NONE, reason="wrong_size")
        camera = pair.camera or CameraModel.from_hfov(width_px, height_px, _BALANCE_HFOV_DEG)
        turn = np.eye(3) if pair.later_from_earlier is None else pair.later_from_earlier
        field = measure_flow(pair.earlier, pair.later, camera, turn, _BALANCE_FLOW)
        used = field.where(field.believed)
        lengths_px = np.linalg.norm(used.later_px - used.earlier_px, axis=1)
        on_left = used.later_px[:, 0] < 0.5 * (width_px - 1)
        if not on_left.any() or on_left.all():
            return Answer(NONE, reason="too_little_flow")
        left_px, right_px = float(lengths_px[on_left].mean()), float(lengths_px[~on_left].mean())
        if left_px + right_px < _BALANCE_STILL_PX:
            return Answer(NONE, reason="no_motion")
        offset = (left_px - right_px) / (left_px + right_px)
        return Answer("flow_balance", (0.5 * (width_px - 1) * (1.0 + offset), 0.5 * (height_px - 1)))


class StraightAhead(_Lines):
    """Always the middle of the image: what a camera that is pointed where one wants to go would say."""

    def answer(self, pair: PairInput, /) -> Answer:
        """Return the middle of the later frame."""
        height_px, width_px = pair.later.shape
        return Answer("straight_ahead", (0.5 * (width_px - 1), 0.5 * (height_px - 1)))


class LineVanishingPoint(_Lines):
    """The vanishing point of the later frame, whatever the flow."""

    def answer(self, pair: PairInput, /) -> Answer:
        """Return the vanishing point."""
        point_px = self.vanishing_point(pair.later)
        return Answer(NONE, reason="no_vanishing_point") if point_px is None else Answer("line_vp", point_px)


METHODS: Final[Mapping[str, Callable[[DetectorParams], Method]]] = MappingProxyType(
    {
        "paper": PaperMethod,
        "parallax": ParallaxMethod,
        "straight": StraightAhead,
        "flow_balance": FlowBalance,
        "line_vp": LineVanishingPoint,
    }
)
"""What ``--method`` can name."""


def answer_of(
    detection: Detection, *, focus_px: tuple[float, float] | None = None, tracks: Tracks | None = None
) -> Answer:
    """Return a detection as an answer."""
    if isinstance(detection, NoDetection):
        return Answer(NONE, reason=detection.reason.value, focus_px=focus_px, tracks=tracks)
    contact = detection.time_to_contact
    frames = None if contact is None else contact.frames
    if isinstance(detection, Direction):
        point_px = (detection.x_px, detection.y_px)
        return Answer(detection.kind.value, point_px, None, frames, focus_px, detection.confidence, tracks)
    return Answer(SINGLE_PLANE, None, None, frames, focus_px, detection.confidence, tracks)


def with_focus(answer: Answer, camera: CameraModel | None) -> Answer:
    """Return an answer with the focus of expansion that its flow vectors say, where the method estimated none."""
    if answer.focus_px is not None or answer.tracks is None:
        return answer
    start, end = answer.tracks.start_px, answer.tracks.end_px
    if camera is not None:
        start, end = ideal_px(camera, start), ideal_px(camera, end)
    focus = fit_focus_of_expansion(start, end)
    return answer if focus is None else replace(answer, focus_px=(float(focus[0]), float(focus[1])))


def line_vanishing_point(image: NDArray[np.uint8], params: DetectorParams) -> tuple[float, float] | None:
    """Return the vanishing point that the paper's line stage (section 2.3) finds without any flow.

    All lines form one group, about the middle of the image, since there are no clusters to assign them to.

    Parameters
    ----------
    image
        (H, W) uint8.
    params
        Its settings of edges, Hough transform and intersections.
    """
    height_px, width_px = image.shape
    segments, *_ = lines.lines_by(params, image)
    found = vanishing_point.candidates(
        segments,
        np.array([[0.5 * (width_px - 1), 0.5 * (height_px - 1)]]),
        (width_px, height_px),
        pair_min_deg=params.pair_angle_min_deg,
        pair_max_deg=params.pair_angle_max_deg,
        cell_px=params.cell_px,
    )
    return (float(found[0, 0]), float(found[0, 1])) if len(found) else None

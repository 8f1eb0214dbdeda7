"""The detector's answers on recorded frames, compared with those it gave in flight."""

from __future__ import annotations

import math
from collections import OrderedDict
from dataclasses import replace
from typing import Final

from companion.config import Config
from companion.frames.source import Frame
from companion.guidance.observation import DetectionReport
from companion.io.messages import Message
from companion.vision.pipeline import VOID_PIPELINE, Pipeline, WithIdleWork, load_factory

_KEPT: Final = 64
"""Frames that an answer may still be owed on."""
_PX: Final = 3.0
_SHARE: Final = 0.1


class Detections:
    """Runs the detector on the frames that it answered on in flight, in the same order, with the same poses.

    Parameters
    ----------
    config
        Detector and camera.

    Raises
    ------
    companion.errors.ConfigError
        When the camera's or the detector's file cannot be used.
    """

    def __init__(self, config: Config) -> None:
        self._config = config
        self._pipeline: Pipeline = self._built()
        self._frames: OrderedDict[tuple[int, int], Message] = OrderedDict()
        self.missing = 0
        """Answers whose frame is not in the recording: the detector here has seen less than that in flight."""
        self.lossy = 0
        """Frames that are not as the camera gave them."""

    def frame(self, message: Message) -> None:
        """Take a recorded frame."""
        self._frames[int(message.fields["seq"]), message.time_ns] = message
        while len(self._frames) > _KEPT:
            self._frames.popitem(last=False)

    def begin_anew(self) -> None:
        """Forget everything, as a worker that was started again has."""
        self._pipeline = self._built()

    def again(self, recorded: DetectionReport) -> DetectionReport | None:
        """Return the answer on the frame of a recorded one; None where that frame is missing."""
        message = self._frames.get((recorded.frame_seq, recorded.frame_ns))
        if message is None or message.image is None:
            self.missing += 1
            return None
        self.lossy += not message.fields.get("lossless", False)
        report = self._pipeline.detect(
            Frame(message.image, recorded.frame_ns, recorded.frame_seq), recorded.pose
        )
        if isinstance(self._pipeline, WithIdleWork):
            self._pipeline.between_frames()
        return replace(report, detector_s=recorded.detector_s)  # how long it took is the recording's

    def _built(self) -> Pipeline:
        return load_factory(VOID_PIPELINE)(self._config.detector, self._config.camera)


def same_answer(recorded: DetectionReport, now: DetectionReport, *, tolerant: bool) -> bool:
    """Return whether two answers are the same: to the last bit, or as far as two processors may differ.

    OpenCV's and numpy's results differ in the last places between processors, and a vote or a filter may turn on that: the
    tolerant comparison asks for the same kind, the direction within 3 px and distances within a tenth.
    """
    if not tolerant:
        return recorded == now
    if (recorded.kind, recorded.reason) != (now.kind, now.reason):
        return False
    pixels = ((recorded.x_px, now.x_px), (recorded.y_px, now.y_px))
    if not all(_close(one, two, 0.0, _PX) for one, two in pixels):
        return False
    return _close(recorded.distance_m, now.distance_m, _SHARE, 0.05)


def _close(one: float | None, two: float | None, share: float, least: float) -> bool:
    if one is None or two is None:
        return one is two
    return math.isclose(one, two, rel_tol=share, abs_tol=least)


def in_words(report: DetectionReport) -> str:
    """Return an answer in a few words."""
    if report.kind == "none":
        return f"none ({report.reason})"
    place = (
        "" if report.x_px is None or report.y_px is None else f" at ({report.x_px:.2f}, {report.y_px:.2f})"
    )
    distance = "" if report.distance_m is None else f", {report.distance_m:.3f} m"
    return f"{report.kind}{place}{distance}"

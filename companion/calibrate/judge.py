"""What a calibration is worth, in words that say what to do. Pure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from companion.calibrate.solve import Calibration, Coverage
from detector.camera_model import CameraModel

Grade = Literal["good", "usable", "bad"]

_WIDTH_PX: Final = 640.0
"""Limits in pixels are for images this wide; corners are found with about the same error in parts of a pixel."""
_RMS_PX: Final = (0.5, 1.5)
_FOCAL_SIGMA: Final = (0.003, 0.02)
_COVERAGE: Final = (0.7, 0.4)
_CHECK_RMS_PX: Final = (1.0, 2.0)
_FOCAL_OFF: Final = (0.01, 0.1)
"""The detector bears a focal length that is a tenth beside the true one (docs/camera-file.md)."""


@dataclass(frozen=True, slots=True)
class Judgement:
    """A grade, and what keeps it from being better."""

    grade: Grade
    advice: tuple[str, ...]


def judge(found: Calibration, seen: Coverage) -> Judgement:
    """Judge a calibration by its error, by how well it knows the focal length, and by what it saw."""
    scale = found.model.width_px / _WIDTH_PX
    grades: list[Grade] = []
    advice: list[str] = []

    def take(grade: Grade, what: str) -> None:
        grades.append(grade)
        if grade != "good":
            advice.append(what)

    take(
        _grade(found.rms_px, _RMS_PX[0] * scale, _RMS_PX[1] * scale),
        f"error {found.rms_px:.2f} px: is the board flat, its size right, and every picture sharp?",
    )
    take(
        _grade(found.focal_sigma, *_FOCAL_SIGMA),
        f"focal length known to {found.focal_sigma:.1%} only: tilt the board more, 30 to 45 degrees each way, and take more views",
    )
    take(
        _grade(-seen.fraction, -_COVERAGE[0], -_COVERAGE[1]),
        f"corners in {seen.fraction:.0%} of the image only: hold the board also {seen.emptiest_place}",
    )
    return Judgement(_worst(grades), tuple(advice))


def judge_existing(
    model: CameraModel, errors_px: NDArray[np.float64], seen: Coverage, anew: Calibration | None
) -> Judgement:
    """Judge an existing model by a board.

    A wrong focal length hides in these errors: a board that is thought nearer than it is looks nearly the same. So
    the model is also held against a new calibration from the same views, where that knows the focal length.

    Parameters
    ----------
    model
        The camera.
    errors_px
        (N,) distances of all corners of all views, px.
    seen
        Where they were.
    anew
        A calibration from the same views, if there is one.
    """
    scale = model.width_px / _WIDTH_PX
    rms_px = float(np.sqrt(np.mean(errors_px**2)))
    grade = _grade(rms_px, _CHECK_RMS_PX[0] * scale, _CHECK_RMS_PX[1] * scale)
    advice = (
        []
        if grade == "good"
        else [f"error {rms_px:.2f} px: calibrate this camera again, in the mode that it flies in"]
    )
    if anew is not None and anew.focal_sigma < _FOCAL_SIGMA[1]:
        off = model.fx_px / anew.model.fx_px - 1.0
        focal_grade = _grade(abs(off), *_FOCAL_OFF)
        if focal_grade != "good":
            advice.append(f"focal length {off:+.1%} beside the one that these views give")
        grade = _worst([grade, focal_grade])
    if seen.fraction < _COVERAGE[1]:
        advice.append(
            f"checked in {seen.fraction:.0%} of the image only: hold the board also {seen.emptiest_place}"
        )
        grade = _worst([grade, "usable"])
    return Judgement(grade, tuple(advice))


def doubts(model: CameraModel) -> tuple[str, ...]:
    """Return what is unusual about a camera's figures by themselves."""
    found = []
    ratio = model.fx_px / model.fy_px
    if not 0.97 < ratio < 1.03:
        found.append(
            f"fx / fy is {ratio:.3f}: pixels are square on nearly all sensors; was the image stretched?"
        )
    for name, centre, side in (
        ("cx_px", model.cx_px, model.width_px),
        ("cy_px", model.cy_px, model.height_px),
    ):
        off = abs(centre - 0.5 * (side - 1)) / side
        if off > 0.1:
            found.append(
                f"{name} is {off:.0%} of the side from the middle: lenses are mounted better than that; was the image cropped?"
            )
    return tuple(found)


def _grade(value: float, good: float, usable: float) -> Grade:
    return "good" if value <= good else "usable" if value <= usable else "bad"


def _worst(grades: list[Grade]) -> Grade:
    return "bad" if "bad" in grades else "usable" if "usable" in grades else "good"

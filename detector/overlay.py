"""Draw the answer to a pair on its second frame, as in the paper's Figs. 3, 5 and 6. Drawing only: nothing is computed here."""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from detector.drawing.frame import FrameCanvas
from detector.drawing.palette import BLUE, GREEN, ORANGE, RED, SKY, WHITE, YELLOW
from detector.pipeline import PairResult
from detector.results import Detection, Diagnostics, Direction, DirectionKind, NoDetection, SinglePlane

if TYPE_CHECKING:
    from detector.evaluation.methods import Answer

_LENGTH_QUANTILE: Final = 95.0
"""Flow of this percentile and more has the last colour: a few wild vectors do not take the scale from the rest."""
_LEGIBLE_WIDTH_PX: Final = 480
"""Narrower frames are drawn enlarged: text at their own size could not be read."""
_MAX_ZOOM: Final = 8
_CANDIDATE: Final = 8


class CandidateRole(StrEnum):
    """What the vote made of a vanishing-point candidate (paper section 2.4)."""

    ELECTED = "elected"
    """The nearest to the LMCC, and its flow is that of the LMCC."""
    REJECTED = "rejected"
    """The nearest to the LMCC, and its flow is another: something nearer hides the vanishing point."""
    VALID = "valid"
    """Another one, at which the vote did not look."""


def draw(
    image: NDArray[np.uint8], result: PairResult, *, zoom: int = 1, notes: Sequence[str] = ()
) -> NDArray[np.uint8]:
    """Return a colour picture of an answer.

    ============================  ===============================================
    flow vectors N'               dark blue (short) over purple to yellow (long)
    lines behind the angle gate   light blue
    cluster centres               green dots
    LMCC                          yellow disc
    candidates                    elected: white square; examined and rejected: red square, crossed out; others: blue diamond
    direction (x_d, y_d)          white cross with a black rim
    single plane                  orange border
    ============================  ===============================================

    Parameters
    ----------
    image
        (H, W) grey or (H, W, 3) BGR uint8, the second frame; it is not changed.
    result
        Answer of the pipeline, with its tracks.
    zoom
        Whole factor by which the frame is enlarged first; see :func:`legible_zoom`.
    notes
        Lines of ASCII text below those about the answer.

    Returns
    -------
    (zoom * H, zoom * W, 3) uint8, BGR.

    Raises
    ------
    ValueError
        When the image is not (H, W) or (H, W, 3) uint8, or the zoom is less than 1.
    """
    if image.dtype != np.uint8 or not (image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3)):
        raise ValueError(f"image: expected (H, W) or (H, W, 3) uint8, got {image.shape} {image.dtype}")
    if zoom < 1:
        raise ValueError(f"zoom: expected 1 or more, got {zoom}")
    canvas = FrameCanvas(image, zoom)
    detection, diagnostics = result.detection, result.detection.diagnostics
    lengths = result.tracks.lengths_px
    canvas.flow(result.tracks, lengths, scale_end(lengths))
    for x1, y1, x2, y2 in diagnostics.lines_px:
        canvas.line((x1, y1), (x2, y2), SKY)
    for point in diagnostics.centre_points_px:
        canvas.disc(point, 4, GREEN)
    draw_candidates(canvas, detection)
    if diagnostics.lmcc_px is not None:
        canvas.disc(diagnostics.lmcc_px, 6, YELLOW)
    if isinstance(detection, Direction):
        canvas.cross((detection.x_px, detection.y_px))
    if isinstance(detection, SinglePlane):
        canvas.border(ORANGE)
    # The text goes where the direction is not.
    at_the_bottom = isinstance(detection, Direction) and detection.y_px < 0.25 * image.shape[0]
    canvas.band([headline(detection), *_figures(diagnostics), *notes], at_the_bottom=at_the_bottom)
    return canvas.picture


def draw_answer(
    image: NDArray[np.uint8], answer: Answer, *, zoom: int = 1, notes: Sequence[str] = ()
) -> NDArray[np.uint8]:
    """Return a colour picture of an answer of which nothing else is known, as of a rival: its mark as in :func:`draw`, or its reason in words.

    Parameters
    ----------
    image
        (H, W) grey or (H, W, 3) BGR uint8, the second frame; it is not changed.
    answer
        What was said of it.
    zoom, notes
        As :func:`draw` takes them.

    Returns
    -------
    (zoom * H, zoom * W, 3) uint8, BGR.
    """
    canvas = FrameCanvas(image, zoom)
    if answer.point_px is None:
        words = f"no detection: {answer.reason}"
    else:
        canvas.cross(answer.point_px)
        words = f"{answer.kind.replace('_', ' ')} at ({answer.point_px[0]:.0f}, {answer.point_px[1]:.0f})"
    at_the_bottom = answer.point_px is not None and answer.point_px[1] < 0.25 * image.shape[0]
    canvas.band([words, *notes], at_the_bottom=at_the_bottom)
    return canvas.picture


def legible_zoom(width_px: int) -> int:
    """Return the zoom at which the text on a frame of this width can be read."""
    return min(max(1, round(_LEGIBLE_WIDTH_PX / max(width_px, 1))), _MAX_ZOOM)


def scale_end(magnitudes: NDArray[np.float64]) -> float:
    """Return the magnitude from which on the last colour is used; 0 where there is none."""
    return float(np.percentile(magnitudes, _LENGTH_QUANTILE)) if len(magnitudes) else 0.0


def scale_begin(magnitudes: NDArray[np.float64]) -> float:
    """Return the magnitude up to which the first colour is used, where small ones are to be told apart; 0 where there is none."""
    return float(np.percentile(magnitudes, 100.0 - _LENGTH_QUANTILE)) if len(magnitudes) else 0.0


def candidate_roles(detection: Detection) -> list[tuple[tuple[float, float], CandidateRole]]:
    """Return each candidate with what the vote made of it; the one that it examined comes last."""
    diagnostics = detection.diagnostics
    points, lmcc = diagnostics.candidates_px, diagnostics.lmcc_px
    if not points or lmcc is None:
        return []
    squared = [(x - lmcc[0]) ** 2 + (y - lmcc[1]) ** 2 for x, y in points]
    examined = squared.index(min(squared))
    elected = isinstance(detection, Direction) and detection.kind is DirectionKind.VANISHING_POINT
    others = [(point, CandidateRole.VALID) for index, point in enumerate(points) if index != examined]
    return [*others, (points[examined], CandidateRole.ELECTED if elected else CandidateRole.REJECTED)]


def draw_candidates(canvas: FrameCanvas, detection: Detection) -> None:
    """Mark the vanishing-point candidates, each by its role."""
    for point, role in candidate_roles(detection):
        if role is CandidateRole.VALID:
            canvas.diamond(point, _CANDIDATE, BLUE)
        elif role is CandidateRole.REJECTED:
            canvas.square(point, _CANDIDATE, RED, crossed_out=True)
        else:
            canvas.square(point, _CANDIDATE, WHITE)


def headline(detection: Detection) -> str:
    """Return the answer in one line of plain ASCII, which is all that the drawing font has."""
    if isinstance(detection, NoDetection):
        return f"no detection: {detection.reason.value}"
    if isinstance(detection, SinglePlane):
        words = "SINGLE PLANE"
    else:
        name = detection.kind.value.replace("_", " ")
        words = f"{name} at ({detection.x_px:.0f}, {detection.y_px:.0f})"
    if detection.confidence is not None:
        words += f", confidence {detection.confidence:.2f}"
    contact = detection.time_to_contact
    if contact is None:
        return f"{words}, time to contact unknown"
    return f"{words}, contact in {contact.frames:.1f} +- {contact.spread_frames:.1f} frames"


def _figures(diagnostics: Diagnostics) -> list[str]:
    """Return what is known of N..N''', p, n, k and the single-plane test, in at most one line."""
    parts: list[str] = []
    if diagnostics.n_tracks:
        parts.append(
            f"N {diagnostics.n_tracks} > {diagnostics.n_after_distribution}"
            f" > {diagnostics.n_after_length} > {diagnostics.n_after_angle}"
        )
    parts += [
        f"{name} {value}"
        for name, value in (("p", diagnostics.p), ("n", diagnostics.n), ("k", diagnostics.k))
        if value is not None
    ]
    if diagnostics.plane_statistic is not None and diagnostics.plane_threshold is not None:
        parts.append(f"plane {diagnostics.plane_statistic:.2f} / {diagnostics.plane_threshold:.2f}")
    return ["  ".join(parts)] if parts else []

"""What the detector saw on the way to an answer, for pictures of it: made only while somebody looks.

Points are px of the frame of the answer, float32. Which of these there are depends on the method and on how far it came.

==============  ============  =================================================================================================
array           shape         of each row
==============  ============  =================================================================================================
features        (N, 2)        x, y of the key points that the flow was followed from, in the earlier frame (method ``paper``)
flow            (N, 4)        x, y where a vector begins (the camera's turning taken out, where it is known) and ends
flow_filter     (N,)          uint8, of ``paper``: 0 dropped for its length, 1 dropped for its angle, 2 kept
centres         (N, 3)        x, y, mean flow of a cluster (``paper``)
lines           (N, 4)        x, y, x, y of the segments behind the angle gate (``paper``)
candidates      (N, 3)        x, y of a vanishing-point candidate, and 0 not looked at, 1 rejected, 2 elected (``paper``)
samples         (N, 4)        x, y, inverse range (1/m; may be below 0) and its standard deviation (``parallax``)
informative     (N,)          uint8, whether the sample's inverse range says anything (``parallax``)
void_map        (360, 3)      azimuth (rad, local NED), free distance (m; -1 not known) and its standard deviation, of this pair
remembered      (360, 3)      the same of what the last pairs say together
==============  ============  =================================================================================================

Fields: ``frame_seq``, ``frame_ns``, ``method``, ``focus_px``, ``lmcc_px``, ``lmcc_magnitude_px``, ``counts`` (the detector's
diagnostics by name), ``seconds`` (of each step), ``gap`` (``azimuth_rad``, ``free_m``, ``sigma_m``, ``width_rad``).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from detector import outliers
from detector.camera_model import CameraModel
from detector.flow import Tracks
from detector.frame import Frame
from detector.observer import Observation
from detector.overlay import CandidateRole, candidate_roles
from detector.params import DetectorParams
from detector.pipeline import PairResult, VoidDetector

if TYPE_CHECKING:  # the worker loads one method
    from detector.parallax.stream import MapReading
    from detector.parallax.void_map import VoidMap

Arrays = dict[str, NDArray[Any]]

_MOST: Final = 1500
"""Rows of an array: all arrays together have to fit into one packet."""
_ROLES: Final = {CandidateRole.VALID: 0, CandidateRole.REJECTED: 1, CandidateRole.ELECTED: 2}
_COUNTS: Final = (
    "n_features_earlier",
    "n_features_later",
    "n_tracks",
    "n_after_distribution",
    "n_after_length",
    "n_after_angle",
    "p",
    "n",
    "k",
    "n_lines",
    "median_flow_px",
)


class KeepingDetector(VoidDetector):
    """The detector, keeping what it last answered and where the flow of that pair began."""

    last: tuple[PairResult, NDArray[np.float32] | None] | None = None

    def detect(
        self,
        earlier: NDArray[np.uint8] | Frame,
        later: NDArray[np.uint8] | Frame,
        *,
        camera: CameraModel | None = None,
        later_from_earlier: NDArray[np.float64] | None = None,
        translation_earlier: NDArray[np.float64] | None = None,
    ) -> PairResult:
        """Return the answer to a pair; as :meth:`detector.pipeline.VoidDetector.detect`."""
        result = super().detect(
            earlier,
            later,
            camera=camera,
            later_from_earlier=later_from_earlier,
            translation_earlier=translation_earlier,
        )
        self.last = (result, earlier.seeds_px if isinstance(earlier, Frame) else None)
        return result


def details_of(observation: Observation) -> dict[str, Any]:
    """Return the fields that every method has."""
    found = observation.detection.diagnostics
    return {
        "focus_px": observation.focus_px,
        "lmcc_px": found.lmcc_px,
        "lmcc_magnitude_px": found.lmcc_magnitude_px,
        "counts": {name: getattr(found, name) for name in _COUNTS},
        "seconds": dict(found.seconds),
    }


def paper_arrays(
    observation: Observation,
    result: PairResult,
    features_px: NDArray[np.float32] | None,
    params: DetectorParams,
) -> Arrays:
    """Return what the paper's method saw on a pair."""
    found = observation.detection.diagnostics
    tracks = result.tracks
    passed = _filters_passed(tracks, found.p, params)
    step = max(1, -(-len(tracks) // _MOST))
    arrays: Arrays = {
        "flow": _rows(np.hstack([tracks.start_px, tracks.end_px])[::step], 4),
        "flow_filter": passed[::step],
        "lines": _rows(found.lines_px, 4),
        "centres": _rows(
            [
                (*point, size)
                for point, size in zip(found.centre_points_px, found.centre_magnitudes_px, strict=False)
            ],
            3,
        ),
        "candidates": _rows(
            [(*point, _ROLES[role]) for point, role in candidate_roles(observation.detection)], 3
        ),
    }
    if features_px is not None:
        arrays["features"] = _rows(features_px, 2)
    return arrays


def parallax_arrays(reading: MapReading) -> Arrays:
    """Return what the parallax method saw on a pair."""
    samples = reading.samples
    step = max(1, -(-len(samples) // _MOST))
    rows = np.column_stack([samples.pixels_px, samples.inverse_range, samples.sigma])
    return {
        "samples": _rows(rows[::step], 4),
        "informative": samples.informative[::step].astype(np.uint8),
        "void_map": _map_rows(reading.measured),
        "remembered": _map_rows(reading.remembered.found),
    }


def _map_rows(found: VoidMap) -> NDArray[np.float32]:
    free_m = np.where(found.known, found.free_m, -1.0)
    sigma_m = np.where(np.isfinite(found.sigma_m), found.sigma_m, -1.0)
    return _rows(np.column_stack([found.azimuth_rad, free_m, sigma_m]), 3)


def _filters_passed(tracks: Tracks, p: int | None, params: DetectorParams) -> NDArray[np.uint8]:
    """Return how far each of the N' vectors came: past neither filter, past that of the length, past both."""
    passed = np.zeros(len(tracks), np.uint8)
    if p is None or not len(tracks):
        return passed
    long_enough = np.flatnonzero(outliers.length_filter(tracks.lengths_px, params.shortest_fraction))
    passed[long_enough] = 1
    spread = outliers.angle_spread(tracks[long_enough].angles_deg, params.angle_statistics)
    passed[long_enough[outliers.angular_filter(spread, p)]] = 2
    return passed


def _rows(values: Any, columns: int) -> NDArray[np.float32]:
    rows = np.asarray(values, np.float32).reshape(-1, columns)
    return rows[:: max(1, -(-len(rows) // _MOST))]

"""What every step of the method saw on one pair: the figures behind the paper's Figs. 3-6 and its Tables 1 and 2.

The answer is the pipeline's. What it does not hand out (the vectors that the filters dropped, the values that p, n and k
were chosen by) is worked out again here, by the same functions.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from types import FrameType
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from detector import clusters, expansion, fast_clusters, flow, outliers
from detector.camera_model import CameraModel
from detector.flow import Tracks
from detector.frame import Frame
from detector.overlay import CandidateRole, candidate_roles
from detector.params import DetectorParams
from detector.pipeline import PairResult, VoidDetector

P_SHOWN: Final = range(1, outliers.P_RANGE[-1] + 1)
"""The factors p whose survivors are shown: those that can be chosen, and the one before."""


@dataclass(frozen=True, slots=True)
class Pair:
    """The input of a report.

    Attributes
    ----------
    earlier, later
        (H, W) uint8.
    camera, later_from_earlier
        As :meth:`detector.pipeline.VoidDetector.detect` takes them.
    """

    earlier: NDArray[np.uint8]
    later: NDArray[np.uint8]
    camera: CameraModel | None = None
    later_from_earlier: NDArray[np.float64] | None = None


@dataclass(frozen=True, slots=True)
class NChoice:
    """The two indices of one number of clusters; CH / DB decides."""

    n: int
    calinski_harabasz: float
    davies_bouldin: float

    @property
    def quotient(self) -> float:
        """CH / DB, 0 where it is not defined."""
        return self.calinski_harabasz / self.davies_bouldin if self.davies_bouldin > 0.0 else 0.0


@dataclass(frozen=True, slots=True)
class KChoice:
    """The centres' magnitudes by k nearest vectors.

    Attributes
    ----------
    k
        Neighbours.
    magnitudes
        (n,) one a centre.
    largest_change
        Largest relative change against the k before; None for the first.
    """

    k: int
    magnitudes: NDArray[np.float64]
    largest_change: float | None


@dataclass(frozen=True, slots=True)
class Steps:
    """One pair, step by step. Masks are over the N vectors that Lucas-Kanade found.

    Attributes
    ----------
    result
        The pipeline's answer.
    tracks
        The N vectors; starts are in the second camera's orientation where the rotation is known.
    came_back, long_enough, kept
        (N,) bool: what the distribution filter left (N'), then the length filter (N''), then the angular one (N''').
    spread
        Mean and deviation of the N'' angles.
    survivors
        For each p of :data:`P_SHOWN` the number of vectors that the angular filter would keep.
    magnitudes
        (N''',) of the kept vectors, in ``unit``.
    labels
        (N''',) each one's cluster; empty where the clusters were not reached.
    n_choices, k_choices
        What n and k were chosen by.
    unit
        ``px``, or ``1/frame`` where the magnitude is the inverse of the time to contact.
    """

    result: PairResult
    tracks: Tracks
    came_back: NDArray[np.bool_]
    long_enough: NDArray[np.bool_]
    kept: NDArray[np.bool_]
    spread: outliers.AngleSpread
    survivors: tuple[int, ...]
    magnitudes: NDArray[np.float64]
    labels: NDArray[np.intp]
    n_choices: tuple[NChoice, ...]
    k_choices: tuple[KChoice, ...]
    unit: str

    @property
    def gains(self) -> list[float | None]:
        """For each p the share of survivors gained over p - 1; None for the first, and where none survived it."""
        before = [0, *self.survivors[:-1]]
        return [now / last - 1.0 if last else None for last, now in zip(before, self.survivors, strict=True)]


def examine(pair: Pair, params: DetectorParams) -> Steps:
    """Run the first loop on a pair and work out what each of its steps saw.

    Raises
    ------
    ValueError
        As :meth:`detector.pipeline.VoidDetector.detect` does.
    """
    detector = VoidDetector(params)
    earlier, later = detector.prepare(pair.earlier), detector.prepare(pair.later)
    result = detector.detect(earlier, later, camera=pair.camera, later_from_earlier=pair.later_from_earlier)
    found = result.detection.diagnostics
    tracks, came_back = Tracks.none(), np.zeros(0, np.bool_)
    if found.n_tracks and earlier.seeds_px is not None:
        tracks, came_back = _followed(pair, earlier.seeds_px, params)
    long_enough, kept = came_back.copy(), came_back.copy()
    spread = outliers.angle_spread(np.zeros(0))
    survivors: tuple[int, ...] = ()
    if found.p is not None:
        long_enough[came_back] = outliers.length_filter(
            tracks[came_back].lengths_px, params.shortest_fraction
        )
        spread = outliers.angle_spread(tracks[long_enough].angles_deg, params.angle_statistics)
        survivors = tuple(int(outliers.angular_filter(spread, p).sum()) for p in P_SHOWN)
        kept = np.zeros(len(tracks), np.bool_)
        kept[long_enough] = outliers.angular_filter(spread, found.p)
    magnitudes, unit = _magnitudes(tracks[kept], result, params, pair.camera)
    labels = np.zeros(0, np.intp)
    n_choices: list[NChoice] = []
    k_choices: list[KChoice] = []
    if found.n is not None and found.k is not None:
        samples = clusters.samples_of(tracks[kept].end_px, tracks[kept].angles_deg)
        labels, n_choices = _n_choices(samples, found.n, params)
        k_choices = _k_choices(np.array(found.centre_points_px), tracks[kept].end_px, magnitudes, params)
    return Steps(
        result,
        tracks,
        came_back,
        long_enough,
        kept,
        spread,
        survivors,
        magnitudes,
        labels,
        tuple(n_choices),
        tuple(k_choices),
        unit,
    )


def _followed(
    pair: Pair, seeds_px: NDArray[np.float32], params: DetectorParams
) -> tuple[Tracks, NDArray[np.bool_]]:
    """Return the N vectors and which of them came back to where they started."""
    starts = np.asarray(seeds_px, np.float64)
    guess_there = guess_back = None
    if pair.camera is not None and pair.later_from_earlier is not None:
        starts = flow.derotate(seeds_px, pair.camera, pair.later_from_earlier)
        if params.lk_predict_rotation:
            guess_there = np.where(np.isfinite(starts), starts, seeds_px)
            guess_back = np.asarray(seeds_px, np.float64)
    ends, there = flow.track_by(params, pair.earlier, pair.later, seeds_px, guess_there)
    returned, back = flow.track_by(params, pair.later, pair.earlier, ends, guess_back)
    home = back & flow.distribution_filter(seeds_px, returned, params.round_trip_px)
    there = there & np.isfinite(starts).all(axis=1)
    return Tracks(starts[there], ends[there].astype(np.float64)), np.asarray(home[there], np.bool_)


def _magnitudes(
    kept: Tracks, result: PairResult, params: DetectorParams, camera: CameraModel | None
) -> tuple[NDArray[np.float64], str]:
    if params.depth_cue == "flow" or result.focus_px is None:
        return kept.lengths_px, "px"
    starts = kept.start_px if camera is None else expansion.ideal_px(camera, kept.start_px)
    radius = np.linalg.norm(starts - np.array(result.focus_px), axis=1)
    return np.asarray(kept.lengths_px / np.maximum(radius, 1.0), np.float64), "1/frame"


def _n_choices(
    samples: NDArray[np.float64], chosen: int, params: DetectorParams
) -> tuple[NDArray[np.intp], list[NChoice]]:
    """Return the labels of the n chosen, and the indices of every n."""
    starts = clusters.seeded_starts(params.seed, params.kmeans_restarts)
    labels, choices = np.zeros(0, np.intp), []
    for n in range(params.clusters_min, min(params.clusters_max, len(samples) - 1) + 1):
        if params.speed == "exact":
            clustering = clusters.best_of(samples, n, starts, params.kmeans_iterations)
        else:
            clustering = fast_clusters.kmeans(
                samples,
                n,
                seed=params.seed,
                attempts=params.fast_restarts,
                max_iterations=params.kmeans_iterations,
            )
        if n == chosen:
            labels = clustering.labels
        choices.append(
            NChoice(
                n,
                clusters.calinski_harabasz(samples, clustering),
                clusters.davies_bouldin(samples, clustering),
            )
        )
    return labels, choices


def _k_choices(
    centres_px: NDArray[np.float64],
    end_px: NDArray[np.float64],
    magnitudes: NDArray[np.float64],
    params: DetectorParams,
) -> list[KChoice]:
    choices: list[KChoice] = []
    for i in range(1, params.nearest_steps + 1):
        k = params.nearest_step * i
        now = clusters.nearest_magnitudes(centres_px, end_px, magnitudes, k)
        change = None
        if choices:
            before = choices[-1].magnitudes
            change = float(np.max(np.abs(now - before) / np.maximum(before, 1e-12)))
        choices.append(KChoice(k, now, change))
    return choices


# ---------------------------------------------------------------------- the vote


@dataclass(frozen=True, slots=True)
class CandidateVote:
    """A vanishing-point candidate and the figures of its vote (paper section 2.4).

    Attributes
    ----------
    point_px
        In the second frame.
    role
        What became of it.
    magnitude
        L_VP, the mean of the k nearest vectors.
    difference
        abs(L_VP - L_LMCC) / L_LMCC.
    """

    point_px: tuple[float, float]
    role: CandidateRole
    magnitude: float
    difference: float


def votes(steps: Steps) -> list[CandidateVote]:
    """Return the figures of the vote on each candidate; the one that was examined comes last."""
    found = steps.result.detection.diagnostics
    roles = candidate_roles(steps.result.detection)
    if not roles or found.k is None or not found.lmcc_magnitude_px:
        return []
    points = np.array([point for point, _ in roles])
    magnitudes = clusters.nearest_magnitudes(
        points, steps.tracks[steps.kept].end_px, steps.magnitudes, found.k
    )
    lmcc = found.lmcc_magnitude_px
    return [
        CandidateVote(point, role, float(magnitude), abs(float(magnitude) - lmcc) / lmcc)
        for (point, role), magnitude in zip(roles, magnitudes, strict=True)
    ]


# ---------------------------------------------------------------------- Table 2


@dataclass(frozen=True, slots=True)
class LoopCost:
    """What one kind of loop costs.

    Attributes
    ----------
    seconds
        Wall time of each step, median over the loops.
    calls
        Calls of Python and C functions in each step, of one loop.
    total_seconds
        Median of the loops' sums.
    """

    seconds: dict[str, float]
    calls: dict[str, int]
    total_seconds: float

    @property
    def total_calls(self) -> int:
        """Calls in all steps."""
        return sum(self.calls.values())


class CallCounter:
    """A clock that counts function calls in place of seconds, those of C functions too, as a deterministic profiler does.

    Use as a context; calling it gives the number so far. Only the thread that entered is counted.
    """

    def __init__(self) -> None:
        self._calls = 0
        self._before: Any = None

    def __enter__(self) -> Self:
        self._before = sys.getprofile()
        sys.setprofile(self._note)
        return self

    def __exit__(self, *_: object) -> None:
        sys.setprofile(self._before)

    def __call__(self) -> float:
        """Return the calls so far, without that of the counter itself."""
        self._calls -= 1
        return float(self._calls)

    def _note(self, _frame: FrameType, event: str, _argument: object) -> None:
        if event in {"call", "c_call"}:
            self._calls += 1


def cost_of_loops(
    pair: Pair,
    params: DetectorParams,
    *,
    loops: int = 5,
    timer: Callable[[], float] = time.perf_counter,
) -> tuple[LoopCost, LoopCost]:
    """Measure the first loop and the others (paper, Table 2).

    In the first, nothing is known of either frame and p, n and k are estimated. In the others p, n and k are kept, and the earlier
    frame is one that was the later one before, so its key points are known, as in a stream.

    Parameters
    ----------
    pair, params
        Input.
    loops
        Loops timed of each kind, after one that warms up.
    timer
        Seconds.
    """
    if loops < 1:
        raise ValueError(f"loops: expected 1 or more, got {loops}")

    def once(detector: VoidDetector, earlier: Frame | NDArray[np.uint8]) -> dict[str, float]:
        answer = detector.detect(
            earlier, pair.later, camera=pair.camera, later_from_earlier=pair.later_from_earlier
        )
        return answer.detection.diagnostics.seconds

    once(VoidDetector(params), pair.earlier)  # what is imported and allocated once is no cost of a loop
    first = [once(VoidDetector(params, timer=timer), pair.earlier) for _ in range(loops)]
    detector = VoidDetector(params, timer=timer)
    earlier = detector.prepare(pair.earlier)
    once(detector, earlier)
    other = [once(detector, earlier) for _ in range(loops)]
    with CallCounter() as counter:
        first_calls = once(VoidDetector(params, timer=counter), pair.earlier)
        detector = VoidDetector(params, timer=counter)
        earlier = detector.prepare(pair.earlier)
        once(detector, earlier)
        other_calls = once(detector, earlier)
    return _cost(first, first_calls), _cost(other, other_calls)


def _cost(runs: list[dict[str, float]], calls: dict[str, float]) -> LoopCost:
    seconds = {name: float(np.median([run.get(name, 0.0) for run in runs])) for name in runs[0]}
    total = float(np.median([sum(run.values()) for run in runs]))
    return LoopCost(seconds, {name: round(count) for name, count in calls.items()}, total)

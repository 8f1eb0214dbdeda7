"""The paper's method for one pair of frames: features, flow, filters, clusters, lines, vote (Fig. 1).

Rotation convention: see :mod:`detector.flow`. With ``later_from_earlier`` given, the starts of the vectors are moved
into the second camera's orientation; ends, cluster centres and (x_d, y_d) are real pixels of the second frame.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from detector import clusters, expansion, fast_clusters, flow, lines, outliers, vanishing_point, vote
from detector.camera_model import CameraModel
from detector.flow import Tracks
from detector.frame import Frame, pair_fault, prepare
from detector.params import DetectorParams, scaled_px
from detector.results import (
    Detection,
    Diagnostics,
    Direction,
    DirectionKind,
    NoDetection,
    NoDetectionReason,
    SinglePlane,
    TimeToContact,
)
from detector.rotation import parallax_px
from detector.seeds import SeedFinder

Timer = Callable[[], float]

_ASSUMED_HFOVS_DEG: Final = range(45, 111, 5)
"""Fields of view tried by the check on pure rotation where no camera is known: the one that explains most counts. Ten degrees
beside the truth, a turn of 4 degrees leaves more flow behind than a camera's motion would."""
_ROTATION_TRACKS: Final = 80
"""fast: about so many vectors are asked whether the camera only turned."""
_MIN_TRACKS: Final = 10
"""Fewer vectors than this say nothing about motion."""


@dataclass(frozen=True, slots=True)
class PairResult:
    """The answer to one pair, and what it was seen by.

    Attributes
    ----------
    detection
        The answer.
    tracks
        The N' vectors behind the distribution filter: the length and angular filters drop what is slow or unusual, and both
        may be far, or near. Starts are in the second camera's orientation where the rotation was given.
    focus_px
        Focus of expansion in the image without distortion, where it is known: from the translation given, else fitted to the flow.
    """

    detection: Detection
    tracks: Tracks
    focus_px: tuple[float, float] | None


class _Stop(Exception):  # noqa: N818 - not an error: the way out of the steps, caught in detect()
    """No detection, with its reason."""

    def __init__(self, reason: NoDetectionReason, detail: str) -> None:
        super().__init__(detail)
        self.reason = reason
        self.detail = detail


class _Notes:
    """Collects the diagnostics of one pair while its steps run."""

    def __init__(self, timer: Timer) -> None:
        self._timer = timer
        self.fields: dict[str, Any] = {}
        self.seconds: dict[str, float] = {}

    @contextmanager
    def step(self, name: str) -> Iterator[None]:
        """Time one step, also when it ends the pair."""
        begin = self._timer()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + self._timer() - begin

    def diagnostics(self) -> Diagnostics:
        return Diagnostics(**self.fields, seconds=self.seconds)


class VoidDetector:
    """The paper's method with its memory: p, n and k are estimated in the first loop and kept in the others.

    Parameters
    ----------
    params
        All settings.
    timer
        Gives seconds, for the time of each step; the machine's performance counter by default.
    starts
        Initial centres of k-means; drawn from the parameters' seed by default.
    """

    def __init__(
        self, params: DetectorParams, *, timer: Timer | None = None, starts: clusters.Starts | None = None
    ) -> None:
        self.params = params
        self._timer: Timer = time.perf_counter if timer is None else timer
        self._starts = starts or clusters.seeded_starts(params.seed, params.kmeans_restarts)
        self._p: int | None = None
        self._n: int | None = None
        self._k: int | None = None
        self._seeds = SeedFinder(params)
        self._centres: NDArray[np.float64] | None = None
        self._votes: int | None = None

    def reset(self) -> None:
        """Forget p, n and k: the scene has changed, the next pair is a first loop."""
        self._p = self._n = self._k = None
        self._centres = self._votes = None
        self._seeds.reset()

    def prepare(self, image: NDArray[np.uint8]) -> Frame:
        """Return a frame for :meth:`detect`; in a stream, prepare each one once.

        Raises
        ------
        ValueError
            When the image is not (H, W) uint8.
        """
        return prepare(image, self.params)

    def renew(self, frame: Frame) -> None:
        """Find where the flow starts when this is the earlier frame, if that is not known yet.

        :meth:`detect` does it when it needs it. Done between two frames, it keeps no answer waiting: key points are what takes longest, and
        the answer on a frame does not need its own, only those of the frame before.
        """
        params, finder = self.params, self._seeds
        if params.speed == "exact" or frame.seeds_px is not None or frame.fault is not None:
            return
        if frame.carried_px is not None:
            frame.seeds_px, frame.carried_px = finder.renew(frame.image, frame.carried_px), None
            if frame.seeds_px is not None:
                renewed = len(frame.seeds_px)
                frame.n_features = (
                    renewed
                    if renewed >= params.min_features
                    else finder.count(frame.image, params.min_features)
                )
                return
        frame.seeds_px, frame.n_features = finder.find(frame.image)

    def detect(
        self,
        earlier: NDArray[np.uint8] | Frame,
        later: NDArray[np.uint8] | Frame,
        *,
        camera: CameraModel | None = None,
        later_from_earlier: NDArray[np.float64] | None = None,
        translation_earlier: NDArray[np.float64] | None = None,
    ) -> PairResult:
        """Return the answer to one pair of frames.

        Parameters
        ----------
        earlier, later
            (H, W) uint8; or frames from :meth:`prepare`, which remember what was found in them for the next pairs.
        camera
            Needed to take a rotation out and to use a translation.
        later_from_earlier
            (3, 3) rotation that takes coordinates of the earlier camera to those of the later one.
        translation_earlier
            (3,) how the camera moved, in the earlier camera's axes; any length.

        Raises
        ------
        ValueError
            When an image is not (H, W) uint8, or a rotation or translation comes without a camera.
        """
        if camera is None and not (later_from_earlier is None and translation_earlier is None):
            raise ValueError("a rotation or translation needs a camera model")
        notes = _Notes(self._timer)
        with notes.step("frames"):
            earlier = self._frame("earlier", earlier)
            later = self._frame("later", later)
        tracks = Tracks.none()
        focus: NDArray[np.float64] | None = None
        try:
            _check_frames(earlier, later, camera)
            points = self._features(earlier, later, notes)
            raw, tracks = self._flow(earlier.image, later.image, points, camera, later_from_earlier, notes)
            self._carry(later, raw, notes)
            self._check_motion(raw, tracks, camera, later_from_earlier is not None, later.image.shape, notes)
            with notes.step("contact"):
                focus = self._focus(tracks, camera, later_from_earlier, translation_earlier)
            if focus is not None:
                notes.fields["focus_of_expansion_px"] = (float(focus[0]), float(focus[1]))
            kept = self._filter(tracks, notes)
            detection = self._decide(later.image, kept, tracks, focus, camera, notes)
        except _Stop as stop:
            detection = NoDetection(stop.reason, stop.detail, notes.diagnostics())
        at = None if focus is None else (float(focus[0]), float(focus[1]))
        return PairResult(detection, tracks, at)

    # ------------------------------------------------------------------ 2.1

    def _frame(self, name: str, image: NDArray[np.uint8] | Frame) -> Frame:
        if isinstance(image, Frame):
            return image
        try:
            return self.prepare(image)
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from error

    def _features(self, earlier: Frame, later: Frame, notes: _Notes) -> NDArray[np.float32]:
        """Return where the flow starts; stop where either frame holds too few key points."""
        params, finder = self.params, self._seeds
        with notes.step("features"):
            if params.speed == "exact":
                for frame in (earlier, later):
                    if frame.seeds_px is None:
                        frame.seeds_px = finder.all_of(frame.image)
                        frame.n_features = len(frame.seeds_px)
            else:
                self.renew(earlier)
            if later.n_features is None and self._n is None:
                later.n_features = finder.count(later.image, params.min_features)
        seeds = earlier.seeds_px
        assert seeds is not None  # noqa: S101 - just found
        notes.fields["n_features_earlier"] = earlier.n_features or 0
        notes.fields["n_features_later"] = later.n_features or 0
        for reason, frame in (
            (NoDetectionReason.TOO_FEW_FEATURES_EARLIER, earlier),
            (NoDetectionReason.TOO_FEW_FEATURES_LATER, later),
        ):
            found = frame.n_features
            if found is not None and found < params.min_features:
                raise _Stop(reason, f"{found} key points, at least {params.min_features} needed")
        return seeds

    def _carry(self, later: Frame, tracks: Tracks, notes: _Notes) -> None:
        """Let the vectors' ends be where the flow starts when the later frame is the earlier one; they are renewed when there is time.

        In the other loops this is also where its key points are counted: those that were followed into it, and where these are too few,
        all.
        """
        params = self.params
        if params.speed == "exact" or later.seeds_px is not None:
            return
        later.carried_px = tracks.end_px
        if later.n_features is None:
            later.n_features = len(tracks)
            if later.n_features < params.min_features:
                with notes.step("features"):
                    self.renew(later)
        notes.fields["n_features_later"] = later.n_features
        if later.n_features < params.min_features:
            raise _Stop(
                NoDetectionReason.TOO_FEW_FEATURES_LATER,
                f"{later.n_features} key points, at least {params.min_features} needed",
            )

    # ------------------------------------------------------------------ 2.2

    def _flow(
        self,
        earlier: NDArray[np.uint8],
        later: NDArray[np.uint8],
        points: NDArray[np.float32],
        camera: CameraModel | None,
        later_from_earlier: NDArray[np.float64] | None,
        notes: _Notes,
    ) -> tuple[Tracks, Tracks]:
        """Track there and back; return the N' vectors as seen, and with the rotation taken out."""
        params = self.params

        with notes.step("flow"):
            guess_there: NDArray[np.float64] | None = None
            if camera is not None and later_from_earlier is not None and params.lk_predict_rotation:
                predicted = flow.derotate(points, camera, later_from_earlier)
                guess_there = np.where(np.isfinite(predicted), predicted, points)
            ends, there = flow.track_by(params, earlier, later, points, guess_there)
            # What was not found there cannot come back; its end stands for it so that the arrays stay aligned.
            guess_back = None if guess_there is None else np.asarray(points, np.float64)
            returned, back = flow.track_by(params, later, earlier, ends, guess_back)
            home = flow.distribution_filter(points, returned, params.round_trip_px)
            kept: NDArray[np.bool_] = there & back & home
            raw = Tracks(points[kept].astype(np.float64), ends[kept].astype(np.float64))
            tracks = raw
            if camera is not None and later_from_earlier is not None and len(raw):
                starts = flow.derotate(raw.start_px, camera, later_from_earlier)
                seen = np.asarray(np.isfinite(starts).all(axis=1), np.bool_)
                raw, tracks = raw[seen], Tracks(starts[seen], raw.end_px[seen])
        notes.fields["n_tracks"] = int(there.sum())
        notes.fields["n_after_distribution"] = len(tracks)
        return raw, tracks

    def _check_motion(
        self,
        raw: Tracks,
        tracks: Tracks,
        camera: CameraModel | None,
        derotated: bool,
        shape: tuple[int, ...],
        notes: _Notes,
    ) -> None:
        """Stop where the camera did not move: a standing or turning camera is no wall and sees no depth."""
        params = self.params
        if len(tracks) < _MIN_TRACKS:
            raise _Stop(
                NoDetectionReason.TOO_LITTLE_FLOW, f"{len(tracks)} vectors came back to where they started"
            )
        height_px, width_px = shape[:2]
        median_px = float(np.median(tracks.lengths_px))
        notes.fields["median_flow_px"] = median_px
        limit_px = max(scaled_px(params.still_flow_px_at_1280, width_px), params.still_flow_floor_px)
        if median_px < limit_px:
            raise _Stop(
                NoDetectionReason.NO_MOTION, f"median flow {median_px:.2f} px, limit {limit_px:.2f} px"
            )
        if derotated or not params.rotation_check:
            return
        with notes.step("flow"):
            judged = (
                [CameraModel.from_hfov(width_px, height_px, hfov_deg) for hfov_deg in _ASSUMED_HFOVS_DEG]
                if camera is None
                else [camera]
            )
            # A few hundred vectors tell as much as thousands.
            few = raw[:: max(1, len(raw) // _ROTATION_TRACKS)] if params.speed == "fast" else raw
            left_px = parallax_px(judged, few)
        limit_px = max(scaled_px(params.parallax_px_at_1280, width_px), params.still_flow_floor_px)
        if left_px < limit_px:
            raise _Stop(
                NoDetectionReason.NO_MOTION,
                f"a turn alone leaves {left_px:.2f} px of flow, limit {limit_px:.2f} px",
            )

    def _filter(self, tracks: Tracks, notes: _Notes) -> Tracks:
        """Length and angular filters: N' -> N'' -> N'''."""
        params = self.params
        with notes.step("flow"):
            longer = tracks[outliers.length_filter(tracks.lengths_px, params.shortest_fraction)]
            spread = outliers.angle_spread(longer.angles_deg, params.angle_statistics)
            if self._p is None:
                self._p = outliers.choose_p(spread, params.angle_gain)
            kept = longer[outliers.angular_filter(spread, self._p)]
        notes.fields.update(n_after_length=len(longer), n_after_angle=len(kept), p=self._p)
        if len(kept) < params.min_flow_vectors:
            raise _Stop(
                NoDetectionReason.TOO_LITTLE_FLOW,
                f"{len(kept)} flow vectors left, at least {params.min_flow_vectors} needed",
            )
        return kept

    def _decide(
        self,
        later: NDArray[np.uint8],
        kept: Tracks,
        tracks: Tracks,
        focus: NDArray[np.float64] | None,
        camera: CameraModel | None,
        notes: _Notes,
    ) -> Detection:
        params = self.params
        width_px = later.shape[1]
        with notes.step("clusters"):
            magnitudes = self._magnitudes(kept, focus, camera)
            centres, k = self._cluster(kept, magnitudes)
            centre_magnitudes = clusters.nearest_magnitudes(centres, kept.end_px, magnitudes, k)
            lowest = int(np.argmin(centre_magnitudes))
            lmcc, lmcc_magnitude = centres[lowest], float(centre_magnitudes[lowest])
            is_plane, statistic, threshold = self._plane_test(
                centre_magnitudes, tracks, focus, camera, width_px
            )
        notes.fields.update(
            n=len(centres),
            k=k,
            centre_points_px=tuple((float(x), float(y)) for x, y in centres),
            centre_magnitudes_px=tuple(float(m) for m in centre_magnitudes),
            lmcc_px=(float(lmcc[0]), float(lmcc[1])),
            lmcc_magnitude_px=lmcc_magnitude,
            plane_statistic=statistic,
            plane_threshold=threshold,
        )
        if is_plane:
            with notes.step("contact"):
                # One plane: every vector of it says the same, so the whole view answers.
                middle = np.array([0.5 * width_px, 0.5 * later.shape[0]])
                contact = self._contact(tracks, focus, camera, middle, gate_px=float(width_px))
            return SinglePlane(contact, notes.diagnostics())
        with notes.step("lines"):
            candidates = self._candidates(later, centres, notes)
        with notes.step("vote"):
            elected = vote.elect(
                candidates, lmcc, lmcc_magnitude, kept.end_px, magnitudes, k, params.vote_tolerance
            )
        at = lmcc if elected is None else elected
        with notes.step("contact"):
            gate_px = scaled_px(params.contact_gate_px_at_1280, width_px)
            contact = self._contact(tracks, focus, camera, at, gate_px=gate_px)
        kind = DirectionKind.LOWEST_FLOW if elected is None else DirectionKind.VANISHING_POINT
        return Direction(float(at[0]), float(at[1]), kind, contact, notes.diagnostics())

    def _plane_test(
        self,
        centre_magnitudes: NDArray[np.float64],
        tracks: Tracks,
        focus: NDArray[np.float64] | None,
        camera: CameraModel | None,
        width_px: int,
    ) -> tuple[bool, float, float]:
        """Return whether the scene is one plane, and the two figures that were compared."""
        params = self.params
        if params.plane_test == "deviation_px":
            deviation = clusters.plane_deviation(centre_magnitudes)
            limit_px = scaled_px(params.plane_deviation_px_at_1280, width_px)
            return deviation < limit_px, deviation, limit_px
        if params.plane_test == "plane_share" and focus is not None:
            start, end = tracks.start_px, tracks.end_px
            if camera is not None:
                start, end = expansion.ideal_px(camera, start), expansion.ideal_px(camera, end)
            share = expansion.plane_share(start, end, focus)
            if share is not None:
                return share >= params.plane_share, share, params.plane_share
        ratio = clusters.plane_ratio(centre_magnitudes)
        return ratio < params.plane_ratio, ratio, params.plane_ratio

    def _cluster(self, kept: Tracks, magnitudes: NDArray[np.float64]) -> tuple[NDArray[np.float64], int]:
        """Return the (n, 2) cluster centres in the image and k; n and k are chosen in the first loop."""
        params = self.params
        samples = clusters.samples_of(kept.end_px, kept.angles_deg)
        if params.speed == "exact":
            clustering = self._exact_clustering(samples)
        else:
            clustering = self._fast_clustering(samples)
        self._n, self._centres = self._n or clustering.n, clustering.centres
        centres = clustering.centres[:, :2]
        if self._k is None:
            self._k = clusters.choose_k(
                centres,
                kept.end_px,
                magnitudes,
                step=params.nearest_step,
                steps=params.nearest_steps,
                change=params.nearest_change,
            )
        return centres, self._k

    def _exact_clustering(self, samples: NDArray[np.float64]) -> clusters.Clustering:
        params = self.params
        if self._n is None:
            return clusters.choose_n(
                samples,
                self._starts,
                n_min=params.clusters_min,
                n_max=params.clusters_max,
                max_iterations=params.kmeans_iterations,
            )
        return clusters.best_of(
            samples, min(self._n, len(samples) - 1), self._starts, params.kmeans_iterations
        )

    def _fast_clustering(self, samples: NDArray[np.float64]) -> clusters.Clustering:
        """Return the clustering by OpenCV's k-means; in the other loops from the centres of the pair before, or anew if that is better."""
        params = self.params

        def anew(n: int, attempts: int) -> clusters.Clustering:
            return fast_clusters.kmeans(
                samples, n, seed=params.seed, attempts=attempts, max_iterations=params.kmeans_iterations
            )

        if self._n is None:
            return clusters.search_n(
                lambda n: anew(n, params.fast_restarts),
                lambda clustering: fast_clusters.quality_of(samples, clustering),
                len(samples),
                n_min=params.clusters_min,
                n_max=params.clusters_max,
            )
        n = min(self._n, len(samples) - 1)
        runs = [anew(n, 1)]
        if self._centres is not None and len(self._centres) == n:
            runs.append(fast_clusters.from_centres(samples, self._centres, params.kmeans_iterations))
        return min(runs, key=lambda run: run.inertia)

    def _magnitudes(
        self, kept: Tracks, focus: NDArray[np.float64] | None, camera: CameraModel | None
    ) -> NDArray[np.float64]:
        """Return what "magnitude" means: the length of the flow, or 1 / time to contact where the focus is known."""
        if self.params.depth_cue == "flow" or focus is None:
            return kept.lengths_px
        starts = kept.start_px if camera is None else expansion.ideal_px(camera, kept.start_px)
        radius = np.linalg.norm(starts - focus, axis=1)
        inverse: NDArray[np.float64] = kept.lengths_px / np.maximum(radius, 1.0)
        return inverse

    # ------------------------------------------------------------------ 2.3

    def _candidates(
        self, later: NDArray[np.uint8], centres: NDArray[np.float64], notes: _Notes
    ) -> NDArray[np.float64]:
        params = self.params
        height_px, width_px = later.shape
        segments, n_lines, votes = lines.lines_by(params, later, self._votes)
        if params.speed == "fast":
            self._votes = votes
        found = vanishing_point.candidates(
            segments,
            centres,
            (width_px, height_px),
            pair_min_deg=params.pair_angle_min_deg,
            pair_max_deg=params.pair_angle_max_deg,
            cell_px=params.cell_px,
        )
        notes.fields.update(
            n_lines=n_lines,
            lines_px=tuple((float(a), float(b), float(c), float(d)) for a, b, c, d in segments),
            candidates_px=tuple((float(x), float(y)) for x, y in found),
        )
        return found

    # ------------------------------------------------------------------ time to contact

    @staticmethod
    def _focus(
        tracks: Tracks,
        camera: CameraModel | None,
        later_from_earlier: NDArray[np.float64] | None,
        translation_earlier: NDArray[np.float64] | None,
    ) -> NDArray[np.float64] | None:
        if camera is not None and translation_earlier is not None:
            rotation = np.eye(3) if later_from_earlier is None else later_from_earlier
            return expansion.focus_of_expansion_from_translation(camera, rotation @ translation_earlier)
        if camera is None:
            return expansion.fit_focus_of_expansion(tracks.start_px, tracks.end_px)
        return expansion.fit_focus_of_expansion(
            expansion.ideal_px(camera, tracks.start_px), expansion.ideal_px(camera, tracks.end_px)
        )

    @staticmethod
    def _contact(
        tracks: Tracks,
        focus: NDArray[np.float64] | None,
        camera: CameraModel | None,
        towards_px: NDArray[np.float64],
        *,
        gate_px: float,
    ) -> TimeToContact | None:
        if focus is None:
            return None
        start, end, towards = tracks.start_px, tracks.end_px, towards_px
        if camera is not None:
            start, end = expansion.ideal_px(camera, start), expansion.ideal_px(camera, end)
            towards = expansion.ideal_px(camera, towards_px[None, :])[0]
        return expansion.time_to_contact_along(start, end, focus, towards, gate_px)


def _check_frames(earlier: Frame, later: Frame, camera: CameraModel | None) -> None:
    fault = pair_fault(earlier, later, camera)
    if fault is not None:
        raise _Stop(fault.reason, fault.detail)

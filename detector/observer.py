"""From a stream of frames to pairs worth looking at, and what such a pair says in metres.

At 30 frames/s and 1 m/s neighbouring frames are 3 cm apart and flow drowns in noise. So the partner of the newest
frame is chosen by the distance flown where poses are known, else by the median flow; never by the frame's number.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final, Protocol

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from detector.camera_model import CameraModel
from detector.dense_flow import DenseFlowParams, grid_tracks
from detector.expansion import (
    MetricRange,
    RangeSamples,
    fit_focus_of_expansion,
    focus_of_expansion_from_translation,
    free_range_along,
    ideal_px,
    ranges_m,
    refine_rotation,
    time_to_contact_along,
)
from detector.flow import Tracks, distribution_filter, track
from detector.frame import Frame, prepare
from detector.params import DetectorParams, scaled_px
from detector.pipeline import PairResult, VoidDetector
from detector.results import (
    Detection,
    Diagnostics,
    NoDetection,
    NoDetectionReason,
    TimeToContact,
)

__all__ = ["CameraPose", "MetricRange", "Observation", "ObserverParams", "PairDetector", "VoidObserver"]

_MAX_ASPECT_CHANGE: Final = 0.02  # a resized image keeps the ratio of its sides, but for rounding
_LOST: Final = (NoDetectionReason.TOO_LITTLE_FLOW,)


@dataclass(frozen=True, slots=True)
class CameraPose:
    """The camera at a frame's time.

    Attributes
    ----------
    world_from_camera
        (3, 3), camera (x right, y down, z forward) to a level world with its z axis down, such as local NED.
    position_m
        (3,) of the camera in that world.
    """

    world_from_camera: NDArray[np.float64]
    position_m: NDArray[np.float64]

    def __post_init__(self) -> None:
        if np.shape(self.world_from_camera) != (3, 3) or np.shape(self.position_m) != (3,):
            raise ValueError(
                f"expected (3, 3) and (3,), got {np.shape(self.world_from_camera)} and {np.shape(self.position_m)}"
            )

    def motion_to(self, later: CameraPose) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return how the camera moved from here to a later pose, as a detector takes it.

        Returns
        -------
        later_from_earlier
            (3, 3) rotation that takes coordinates of this camera to those of the later one.
        translation_earlier_m
            (3,) from this position to the later one, in this camera's axes.
        """
        return (
            later.world_from_camera.T @ self.world_from_camera,
            self.world_from_camera.T @ (later.position_m - self.position_m),
        )


@dataclass(frozen=True, slots=True)
class ObserverParams:
    """How pairs are chosen, and the vehicle that has to fit.

    Attributes
    ----------
    vehicle_width_m, vehicle_height_m
        What is swept along a direction to find its free range, margins included. Larger: fewer ways count as free.
    baseline_target_m, baseline_min_m, baseline_max_m
        Distance flown between the frames of a pair. Larger: surer ranges, fewer tracks that survive.
    flow_target, flow_min
        Median flow of a pair without poses, as a share of the image width.
    max_rotation_deg
        Between the frames of a pair. Larger: pairs during faster turns, of less overlap.
    max_age_s
        Of the earlier frame: the scene may change, and the estimator drifts.
    max_frames
        Earlier frames kept.
    attitude_sigma_deg, flow_sigma_px
        How far the attitude between two frames, and a track's end, may be wrong (one standard deviation).
    scene_turn_deg, scene_distance_m, scene_gap_s
        A turn, a way or a pause after which the scene counts as another one: the detector estimates p, n and k anew.
    hidden_width_m
        A way counts as free no farther than to where something so wide could stand in it unseen, between the samples. Larger:
        bolder where there is little texture.
    dense
        Flow on a grid, beside the detector's tracks, for ranges; None: the tracks alone.
    """

    vehicle_width_m: float = 0.7
    vehicle_height_m: float = 0.4
    baseline_target_m: float = 0.25
    baseline_min_m: float = 0.10
    baseline_max_m: float = 0.45
    flow_target: float = 0.015
    flow_min: float = 0.004
    max_rotation_deg: float = 18.0
    max_age_s: float = 4.0
    max_frames: int = 48
    attitude_sigma_deg: float = 0.3
    flow_sigma_px: float = 0.3
    scene_turn_deg: float = 40.0
    scene_distance_m: float = 3.0
    scene_gap_s: float = 2.0
    hidden_width_m: float = 0.3
    dense: DenseFlowParams | None = field(default_factory=DenseFlowParams)

    def __post_init__(self) -> None:
        if not 0.0 < self.baseline_min_m <= self.baseline_target_m <= self.baseline_max_m:
            raise ValueError(
                "0 < baseline_min_m <= baseline_target_m <= baseline_max_m is needed, found "
                f"{self.baseline_min_m}, {self.baseline_target_m}, {self.baseline_max_m}"
            )
        if not 0.0 < self.flow_min <= self.flow_target < 0.2:
            raise ValueError(
                f"0 < flow_min <= flow_target < 0.2 is needed, found {self.flow_min}, {self.flow_target}"
            )
        if self.max_frames < 2:
            raise ValueError(f"max_frames must be at least 2, found {self.max_frames}")


class PairDetector(Protocol):
    """What the observer asks of the detector (:class:`detector.pipeline.VoidDetector`)."""

    def detect(
        self,
        earlier: Frame,
        later: Frame,
        *,
        camera: CameraModel | None = None,
        later_from_earlier: NDArray[np.float64] | None = None,
        translation_earlier: NDArray[np.float64] | None = None,
    ) -> PairResult:
        """Return the answer on a pair, and its tracks."""
        ...

    def reset(self) -> None:
        """Forget p, n and k."""
        ...


@dataclass(frozen=True, slots=True)
class _PairGeometry:
    """What an observation answers questions from."""

    camera: CameraModel
    start_px: NDArray[np.float64]  # of the image without distortion, as are end_px and focus_px
    end_px: NDArray[np.float64]
    focus_px: NDArray[np.float64] | None
    contact_gate_px: float
    samples: RangeSamples | None
    up_camera: NDArray[np.float64] | None
    params: ObserverParams


@dataclass(frozen=True, slots=True)
class Observation:
    """The answer on one frame, and what can be asked about its pair.

    Attributes
    ----------
    detection
        The detector's answer, in px of this frame.
    time_ns, earlier_time_ns
        Of this frame and of its partner; None where there was none.
    baseline_m
        Metres flown between the two, where both poses are known.
    focus_px
        Focus of expansion in this frame, where it is known.
    """

    detection: Detection
    time_ns: int
    earlier_time_ns: int | None = None
    baseline_m: float | None = None
    focus_px: tuple[float, float] | None = None
    _geometry: _PairGeometry | None = None

    def time_to_contact_along(self, ray_camera: ArrayLike) -> TimeToContact | None:
        """Return the time to contact along a direction of this frame's camera; None when not known.

        Parameters
        ----------
        ray_camera
            (3,), any length.
        """
        geometry = self._geometry
        ray = np.asarray(ray_camera, dtype=np.float64)
        if geometry is None or geometry.focus_px is None or not ray[2] > 0.0:
            return None
        camera = geometry.camera
        towards_px = (
            camera.cx_px + camera.fx_px * ray[0] / ray[2],
            camera.cy_px + camera.fy_px * ray[1] / ray[2],
        )
        return time_to_contact_along(
            geometry.start_px,
            geometry.end_px,
            geometry.focus_px,
            towards_px,
            geometry.contact_gate_px,
            flow_sigma_px=geometry.params.flow_sigma_px,
        )

    def range_along(self, ray_camera: ArrayLike) -> MetricRange | None:
        """Return how far the vehicle could fly along a direction of this frame's camera; None when not known.

        It needs poses and a camera model. Unknown is never free.

        Parameters
        ----------
        ray_camera
            (3,), any length.
        """
        geometry = self._geometry
        if geometry is None or geometry.samples is None:
            return None
        ray, up = np.asarray(ray_camera, dtype=np.float64), geometry.up_camera
        if up is not None and abs(float(ray @ up)) > math.cos(math.radians(5.0)) * float(np.linalg.norm(ray)):
            return None  # straight up or down: the vehicle's width and height have no meaning there
        return free_range_along(
            geometry.samples,
            ray,
            half_width_m=0.5 * geometry.params.vehicle_width_m,
            half_height_m=0.5 * geometry.params.vehicle_height_m,
            up_camera=up,
            hidden_width_m=geometry.params.hidden_width_m,
        )

    def points_within(self, range_m: float) -> NDArray[np.float64]:
        """Return what was surely seen nearer than a range, as points of this frame's camera.

        Parameters
        ----------
        range_m
            Points whose range, two standard deviations of parallax added, lies below it.

        Returns
        -------
        (N, 3) in m; empty where poses or camera are not known.
        """
        geometry = self._geometry
        if geometry is None or geometry.samples is None:
            return np.zeros((0, 3))
        samples = geometry.samples
        sure = samples.inverse_per_m - 2.0 * samples.sigma_per_m > 1.0 / range_m
        points: NDArray[np.float64] = samples.points_m[sure & samples.is_resolved]
        return points


@dataclass(frozen=True, slots=True)
class _Kept:
    frame: Frame
    time_ns: int
    pose: CameraPose | None


class VoidObserver:
    """Keeps earlier frames, pairs each new one with the best of them and calls the detector.

    Parameters
    ----------
    params
        Of the detector.
    camera
        Its model; frames of another size and the same ratio of sides are understood. Without it rotation stays in the flow and nothing is known in metres.
    observer_params
        How pairs are chosen.
    timer
        Wall clock in s for the diagnostics; passed to the detector.
    detector
        In place of a :class:`detector.pipeline.VoidDetector`.
    """

    def __init__(
        self,
        params: DetectorParams,
        camera: CameraModel | None = None,
        *,
        observer_params: ObserverParams | None = None,
        timer: Callable[[], float] | None = None,
        detector: PairDetector | None = None,
    ) -> None:
        self._params = params
        self._camera = camera
        self._observer_params = observer_params or ObserverParams()
        if detector is None:
            detector = VoidDetector(params) if timer is None else VoidDetector(params, timer=timer)
        self._detector: PairDetector = detector
        self._kept: deque[_Kept] = deque(maxlen=self._observer_params.max_frames)
        self._last_ns: int | None = None
        self._scene_pose: CameraPose | None = None

    def reset(self) -> None:
        """Forget all frames, and what the detector learned from them."""
        self._kept.clear()
        self._last_ns = None
        self._forget_scene()

    def observe(self, image: NDArray[np.uint8], time_ns: int, pose: CameraPose | None = None) -> Observation:
        """Take the next frame and answer on it.

        Parameters
        ----------
        image
            (H, W) uint8.
        time_ns
            When it was exposed. Time that runs backwards (a recording that starts over) begins anew.
        pose
            Of the camera at that time, if known.

        Raises
        ------
        ValueError
            The image is not (H, W) uint8.
        """
        if image.ndim != 2 or image.dtype != np.uint8:
            raise ValueError(f"expected an image (H, W) of uint8, got {image.shape} of {image.dtype}")
        if self._last_ns is not None and time_ns <= self._last_ns:
            self.reset()
        if self._last_ns is not None and time_ns - self._last_ns > self._observer_params.scene_gap_s * 1e9:
            self._forget_scene()
        self._last_ns = time_ns

        frame = prepare(image.copy(), self._params)  # the caller may use its image again
        if frame.fault is not None:
            # Not kept: a frame that cannot be matched must not become a partner.
            return _nothing(time_ns, frame.fault.reason, frame.fault.detail)
        camera = self._camera_for(image)
        if self._camera is not None and camera is None:
            height, width = image.shape
            return _nothing(
                time_ns,
                NoDetectionReason.WRONG_SIZE,
                f"found {width} x {height} px, the camera model is for {self._camera.width_px} x {self._camera.height_px}",
            )
        if self._kept and self._kept[-1].frame.image.shape != image.shape:
            before = self._kept[-1].frame.image.shape
            self.reset()
            self._last_ns = time_ns
            self._keep(frame, time_ns, pose)
            return _nothing(
                time_ns,
                NoDetectionReason.WRONG_SIZE,
                f"the size changed from {before[1]} x {before[0]} to {image.shape[1]} x {image.shape[0]} px: starting anew",
            )
        self._note_scene(pose)
        partner = self._partner(image, time_ns, pose)
        self._keep(frame, time_ns, pose)
        if isinstance(partner, NoDetection):
            return Observation(partner, time_ns)
        return self._observe_pair(partner, frame, time_ns, pose, camera)

    def between_frames(self) -> None:
        """Do what the next answer needs and this one does not; to be called once this one is on its way.

        Without it, :meth:`observe` does the same later: the answers do not depend on it, only when they come.
        """
        if self._kept and isinstance(self._detector, VoidDetector):
            self._detector.renew(self._kept[-1].frame)

    def _observe_pair(
        self,
        earlier: _Kept,
        later: Frame,
        time_ns: int,
        pose: CameraPose | None,
        camera: CameraModel | None,
    ) -> Observation:
        later_from_earlier = translation_earlier = translation_later = None
        baseline_m: float | None = None
        if pose is not None and earlier.pose is not None:
            moved_m = pose.position_m - earlier.pose.position_m
            baseline_m = float(np.linalg.norm(moved_m))
            if camera is not None:
                later_from_earlier, translation_earlier = earlier.pose.motion_to(pose)
                translation_later = pose.world_from_camera.T @ moved_m
        result = self._detector.detect(
            earlier.frame,
            later,
            camera=camera,
            later_from_earlier=later_from_earlier,
            translation_earlier=translation_earlier,
        )
        if isinstance(result.detection, NoDetection) and result.detection.reason in _LOST:
            self._forget_scene()
        geometry = None
        if camera is not None and (len(result.tracks) or translation_later is not None):
            geometry = self._geometry(
                result.tracks, earlier.frame, later, camera, pose, later_from_earlier, translation_later
            )
        return Observation(
            result.detection,
            time_ns,
            earlier.time_ns,
            baseline_m,
            _focus_in_image(geometry, result.detection.diagnostics),
            geometry,
        )

    def _geometry(
        self,
        tracks: Tracks,
        earlier: Frame,
        later: Frame,
        camera: CameraModel,
        pose: CameraPose | None,
        later_from_earlier: NDArray[np.float64] | None,
        translation_later: NDArray[np.float64] | None,
    ) -> _PairGeometry:
        params = self._observer_params
        start_px, end_px = ideal_px(camera, tracks.start_px), ideal_px(camera, tracks.end_px)
        samples = None
        if translation_later is None or later_from_earlier is None:
            focus_px = fit_focus_of_expansion(start_px, end_px, flow_sigma_px=params.flow_sigma_px)
        else:
            later_from_start = refine_rotation(
                camera,
                tracks.start_px,
                tracks.end_px,
                translation_later,
                prior_sigma_rad=math.radians(params.attitude_sigma_deg),
                flow_sigma_px=params.flow_sigma_px,
            )
            rays = camera.pixel_to_ray(tracks.start_px) @ later_from_start.T
            start_px = ideal_px(camera, camera.ray_to_pixel(rays))
            focus_px = focus_of_expansion_from_translation(camera, translation_later)
            samples = ranges_m(
                camera,
                tracks.start_px,
                tracks.end_px,
                translation_later,
                later_from_start=later_from_start,
                flow_sigma_px=params.flow_sigma_px,
            )
            if params.dense is not None and earlier.fault is None and later.fault is None:
                on_grid, sigma_px = grid_tracks(
                    earlier.image, later.image, camera, later_from_earlier, translation_later, params.dense
                )
                dense = ranges_m(
                    camera,
                    on_grid.start_px,
                    on_grid.end_px,
                    translation_later,
                    later_from_start=later_from_start,
                    flow_sigma_px=sigma_px,
                )
                samples = samples.joined(dense)
        return _PairGeometry(
            camera=camera,
            start_px=start_px,
            end_px=end_px,
            focus_px=focus_px,
            contact_gate_px=scaled_px(self._params.contact_gate_px_at_1280, camera.width_px),
            samples=samples,
            up_camera=None if pose is None else pose.world_from_camera.T @ np.array([0.0, 0.0, -1.0]),
            params=params,
        )

    def _partner(
        self, image: NDArray[np.uint8], time_ns: int, pose: CameraPose | None
    ) -> _Kept | NoDetection:
        oldest_ns = time_ns - self._observer_params.max_age_s * 1e9
        while self._kept and self._kept[0].time_ns < oldest_ns:
            self._kept.popleft()
        if not self._kept:
            return _none(NoDetectionReason.NO_EARLIER_FRAME, "no earlier frame is kept")
        if pose is not None and any(kept.pose is not None for kept in self._kept):
            return self._partner_by_distance(pose)
        return self._partner_by_flow(image)

    def _partner_by_distance(self, pose: CameraPose) -> _Kept | NoDetection:
        """Return the frame nearest to the wanted baseline (as a ratio), of those that show the same scene."""
        params = self._observer_params
        best: _Kept | None = None
        best_cost, longest_m, overlapping = math.inf, 0.0, False
        for kept in self._kept:
            if kept.pose is None:
                continue
            turn_deg = math.degrees(_angle_rad(kept.pose.world_from_camera, pose.world_from_camera))
            distance_m = float(np.linalg.norm(pose.position_m - kept.pose.position_m))
            if turn_deg > params.max_rotation_deg or distance_m > params.baseline_max_m:
                continue
            overlapping, longest_m = True, max(longest_m, distance_m)
            if distance_m < params.baseline_min_m:
                continue
            # A turn costs overlap and exactness, so of two equal baselines the one with less of it.
            cost = (
                abs(math.log(distance_m / params.baseline_target_m))
                + 0.3 * turn_deg / params.max_rotation_deg
            )
            if cost < best_cost:
                best, best_cost = kept, cost
        if best is not None:
            return best
        if not overlapping:
            return _none(
                NoDetectionReason.NO_EARLIER_FRAME,
                f"none within {params.baseline_max_m:g} m and {params.max_rotation_deg:g} deg of this one",
            )
        return _none(
            NoDetectionReason.NO_MOTION,
            f"moved {longest_m:.3f} m, at least {params.baseline_min_m:g} m needed",
        )

    def _partner_by_flow(self, image: NDArray[np.uint8]) -> _Kept | NoDetection:
        """Return the newest frame with at least the wanted median flow, by bisection: flow grows with age while the camera moves on."""
        width = image.shape[1]
        target_px, min_px = self._observer_params.flow_target * width, self._observer_params.flow_min * width
        probe = _FlowProbe(image)
        low, high = 0, len(self._kept) - 1
        best, best_flow_px, largest_px = None, math.inf, 0.0
        while low <= high:
            index = (low + high) // 2
            flow_px = probe.median_flow_px(self._kept[index].frame.image)
            if flow_px is None or flow_px >= target_px:
                low = index + 1  # too far apart, or lost: try newer ones
            else:
                high = index - 1
            if flow_px is None:
                continue
            largest_px = max(largest_px, flow_px)
            if flow_px >= min_px and abs(math.log(flow_px / target_px)) < best_flow_px:
                best, best_flow_px = self._kept[index], abs(math.log(flow_px / target_px))
        if best is not None:
            return best
        if largest_px == 0.0:
            return _none(NoDetectionReason.NO_EARLIER_FRAME, "no earlier frame shows the same scene")
        return _none(
            NoDetectionReason.NO_MOTION, f"median flow {largest_px:.2f} px, at least {min_px:.2f} px needed"
        )

    def _keep(self, frame: Frame, time_ns: int, pose: CameraPose | None) -> None:
        """Keep the frame, thinned so that the ring spans a useful way and not just a moment."""
        params = self._observer_params
        if len(self._kept) >= 2:
            # The newest one kept is provisional: it makes room unless it is a step beyond the one before.
            last, before = self._kept[-1], self._kept[-2]
            if last.pose is not None and before.pose is not None:
                moved_m = float(np.linalg.norm(last.pose.position_m - before.pose.position_m))
                turned = _angle_rad(last.pose.world_from_camera, before.pose.world_from_camera)
                is_step = moved_m >= 0.1 * params.baseline_target_m or turned >= math.radians(2.0)
                is_step |= last.time_ns - before.time_ns >= 0.25 * params.max_age_s * 1e9
            else:
                is_step = last.time_ns - before.time_ns >= params.max_age_s * 1e9 / params.max_frames
            if not is_step:
                self._kept.pop()
        self._kept.append(_Kept(frame, time_ns, pose))

    def _note_scene(self, pose: CameraPose | None) -> None:
        if pose is None:
            return
        params = self._observer_params
        if self._scene_pose is not None:
            turned = _angle_rad(self._scene_pose.world_from_camera, pose.world_from_camera)
            moved_m = float(np.linalg.norm(pose.position_m - self._scene_pose.position_m))
            if turned > math.radians(params.scene_turn_deg) or moved_m > params.scene_distance_m:
                self._forget_scene()
        if self._scene_pose is None:
            self._scene_pose = pose

    def _forget_scene(self) -> None:
        self._detector.reset()
        self._scene_pose = None

    def _camera_for(self, image: NDArray[np.uint8]) -> CameraModel | None:
        height, width = image.shape
        camera = self._camera
        if camera is None or (camera.width_px, camera.height_px) == (width, height):
            return camera
        change = (width / height) / (camera.width_px / camera.height_px) - 1.0
        return camera.scaled_to(width, height) if abs(change) <= _MAX_ASPECT_CHANGE else None


class _FlowProbe:
    """Median flow between frames from a few corners at reduced size: good enough to choose a partner by."""

    _WIDTH_PX: Final = 320
    _CORNERS: Final = 80
    _LEAST: Final = 12

    def __init__(self, image: NDArray[np.uint8]) -> None:
        self._scale = min(1.0, self._WIDTH_PX / image.shape[1])
        self._image = self._reduced(image)
        corners = cv2.goodFeaturesToTrack(self._image, self._CORNERS, 0.02, 8)
        self._corners_px = (
            np.zeros((0, 2), np.float32)
            if corners is None
            else np.asarray(corners, np.float32).reshape(-1, 2)
        )

    def median_flow_px(self, earlier: NDArray[np.uint8]) -> float | None:
        """Return the median length in px of the full size, or None where the frames do not match."""
        reduced = self._reduced(earlier)
        there, found = track(self._image, reduced, self._corners_px, levels=4)
        back, returned = track(reduced, self._image, there, levels=4)
        kept = found & returned & distribution_filter(self._corners_px, back)
        if int(kept.sum()) < max(self._LEAST, 0.3 * len(kept)):
            return None
        median_px = float(np.median(np.linalg.norm(there[kept] - self._corners_px[kept], axis=1)))
        return median_px / float(self._scale)

    def _reduced(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        if self._scale == 1.0:
            return image
        return np.asarray(
            cv2.resize(image, None, fx=self._scale, fy=self._scale, interpolation=cv2.INTER_AREA), np.uint8
        )


def _focus_in_image(geometry: _PairGeometry | None, diagnostics: Diagnostics) -> tuple[float, float] | None:
    if geometry is None:
        return diagnostics.focus_of_expansion_px
    if geometry.focus_px is None:
        return None
    camera = geometry.camera
    x, y = (geometry.focus_px - (camera.cx_px, camera.cy_px)) / (camera.fx_px, camera.fy_px)
    focus = camera.ray_to_pixel([[x, y, 1.0]])[0]
    return (float(focus[0]), float(focus[1])) if np.isfinite(focus).all() else None


def _angle_rad(first: NDArray[np.float64], second: NDArray[np.float64]) -> float:
    """Return the angle between two orientations."""
    return math.acos(max(-1.0, min(1.0, 0.5 * (float(np.sum(first * second)) - 1.0))))


def _none(reason: NoDetectionReason, detail: str) -> NoDetection:
    return NoDetection(reason, detail, Diagnostics())


def _nothing(time_ns: int, reason: NoDetectionReason, detail: str) -> Observation:
    return Observation(_none(reason, detail), time_ns)

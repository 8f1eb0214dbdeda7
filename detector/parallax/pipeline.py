"""The parallax method for one pair of frames: a first look, a sweep of planes, flow, motion, plane or depth, ranges, and what the void map makes of them.

    flow_field -> egomotion -> depth_sweep -> guided_flow -> egomotion -> plane, ranges -> void map -> answer

What the answer distinguishes: **no motion** (the flow is a rotation's), **too little texture**, **single plane** (a wall: one plane comes nearer, or nothing is
free beyond the wall limit), **gap** (also when everything is far: then the map is free to its horizon).
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from detector.camera_model import CameraModel
from detector.flow import Tracks
from detector.frame import Frame, pair_fault, prepare
from detector.parallax.decision import Decision, decide
from detector.parallax.depth_sweep import sweep_depth
from detector.parallax.egomotion import (
    Egomotion,
    estimate_egomotion,
    focus_of_expansion,
    parallax_left_rad,
    still_limit_rad,
)
from detector.parallax.flow_field import FlowField, measure_flow
from detector.parallax.guided_flow import measure_guided_flow
from detector.parallax.params import ParallaxParams
from detector.parallax.plane import PlaneFit, fit_plane
from detector.parallax.ranges import InverseDepths, flight_frame, inverse_depths, ranged_samples
from detector.parallax.samples import RangedSamples
from detector.parallax.void_map import VoidMapParams
from detector.params import DetectorParams
from detector.results import Detection, Diagnostics, MotionEstimate, NoDetection, NoDetectionReason


@dataclass(frozen=True, slots=True)
class Intrinsics:
    """A camera model and where it came from: ``calibration``, ``field_of_view``, ``estimated`` or ``assumed``; ``detail`` says more, for people."""

    camera: CameraModel
    source: str
    detail: str = ""


@dataclass(frozen=True, slots=True)
class PairGeometry:
    """What was measured of a pair that moved.

    Attributes
    ----------
    camera
        The model that was used.
    motion, plane, depths
        See their modules; ``plane`` is None where there were too few samples for it.
    samples
        The ranges in the level frame.
    baseline_m
        Between the two cameras; None where it is not known.
    frame_from_later
        (3, 3) rotation from the later camera's axes to the frame of ``samples``.
    is_level
        Whether that frame is level, and so what is free there is free at flight height.
    """

    camera: CameraModel
    motion: Egomotion
    plane: PlaneFit | None
    depths: InverseDepths
    samples: RangedSamples
    baseline_m: float | None
    frame_from_later: NDArray[np.float64]
    is_level: bool


@dataclass(frozen=True, slots=True)
class ParallaxResult:
    """The answer to one pair, and what it was seen by.

    Attributes
    ----------
    detection
        The answer.
    tracks
        The believed samples as flow vectors, the rotation taken out of their starts.
    focus_px
        Focus of expansion in the image without distortion, as it was estimated; None where there is none.
    geometry
        What was measured; None where the pair told nothing.
    decision
        The map behind the answer; None where there is none.
    field
        All samples of the flow; None where a frame could not be used.
    """

    detection: Detection
    tracks: Tracks
    focus_px: tuple[float, float] | None
    geometry: PairGeometry | None = None
    decision: Decision | None = None
    field: FlowField | None = None


@dataclass(frozen=True, slots=True)
class _Pose:
    """What is told of a pair's motion.

    Attributes
    ----------
    attitude_given
        Whether the rotation is.
    direction_later
        (3,) from the earlier to the later position in the later camera's axes, m; None where the camera is not known to have moved far enough for parallax.
    baseline_m
        Its length, however short; None where it is not told.
    level_from_later
        (3, 3), None where it is not told.
    """

    attitude_given: bool
    direction_later: NDArray[np.float64] | None
    baseline_m: float | None
    level_from_later: NDArray[np.float64] | None


class ParallaxDetector:
    """The parallax method, one call a pair. It keeps nothing between pairs.

    Parameters
    ----------
    params
        Settings.
    map_params
        The vehicle's size and the rules of the map.
    frame_params
        What counts as a usable frame (black, saturated, blurred, too small).
    timer
        Gives seconds, for the time of each step.
    """

    def __init__(
        self,
        params: ParallaxParams | None = None,
        map_params: VoidMapParams | None = None,
        *,
        frame_params: DetectorParams | None = None,
        timer: Callable[[], float] = time.perf_counter,
    ) -> None:
        self.params = params or ParallaxParams()
        self.map_params = map_params or VoidMapParams()
        self._frame_params = frame_params or DetectorParams.preset("default")
        self._timer = timer
        self._small = self.params.model_copy(
            update={"width_px": min(self.params.width_px, self.params.coarse_width_px)}
        )

    def prepare(self, image: NDArray[np.uint8]) -> Frame:
        """Return a frame with its quality judged; in a stream, prepare each one once.

        Raises
        ------
        ValueError
            When the image is not (H, W) uint8.
        """
        return prepare(image, self._frame_params)

    def reset(self) -> None:
        """Nothing is kept from pair to pair."""

    def detect(
        self,
        earlier: NDArray[np.uint8] | Frame,
        later: NDArray[np.uint8] | Frame,
        *,
        intrinsics: Intrinsics | None = None,
        later_from_earlier: NDArray[np.float64] | None = None,
        translation_earlier_m: NDArray[np.float64] | None = None,
        level_from_later: NDArray[np.float64] | None = None,
    ) -> ParallaxResult:
        """Return the answer to one pair of frames.

        Parameters
        ----------
        earlier, later
            (H, W) uint8; or frames from :meth:`prepare`.
        intrinsics
            The camera; a field of view is assumed where it is None.
        later_from_earlier
            (3, 3) rotation that takes coordinates of the earlier camera to those of the later one: a prior, refined from the flow.
        translation_earlier_m
            (3,) how the camera moved, in the earlier camera's axes, in metres. Its direction is a prior, its length the scale.
        level_from_later
            (3, 3) rotation from the later camera's axes to a level frame, its z down (:mod:`detector.parallax.samples`).

        Raises
        ------
        ValueError
            When an image is not (H, W) uint8, or a translation comes without a rotation.
        """
        if translation_earlier_m is not None and later_from_earlier is None:
            raise ValueError("a translation needs a rotation: it is given in the earlier camera's axes")
        seconds: dict[str, float] = {}
        clock = _Clock(self._timer, seconds)
        first, second = self._frame("earlier", earlier), self._frame("later", later)
        if intrinsics is None:
            height_px, width_px = second.image.shape
            intrinsics = Intrinsics(
                CameraModel.from_hfov(width_px, height_px, self.params.assumed_hfov_deg), "assumed"
            )
        fault = pair_fault(first, second, intrinsics.camera)
        if fault is not None:
            return _nothing(fault.reason, fault.detail, Diagnostics(seconds=seconds))
        clock.step("frames")
        camera = intrinsics.camera
        baseline_m = direction = None
        if translation_earlier_m is not None and later_from_earlier is not None:
            baseline_m = float(np.linalg.norm(translation_earlier_m))
            if baseline_m >= self.params.least_baseline_m:
                direction = later_from_earlier @ translation_earlier_m
        pose = _Pose(later_from_earlier is not None, direction, baseline_m, level_from_later)
        # Where a pose says which way the camera went, a small picture is enough to make sure of it.
        look = self.params if direction is None else self._small
        coarse = measure_flow(first.image, second.image, camera, later_from_earlier, look)
        clock.step("first_look")
        glance = estimate_egomotion(
            coarse,
            look,
            attitude_given=pose.attitude_given,
            direction_prior=direction,
        )
        clock.step("first_motion")
        if glance is None:
            return self._answer(coarse, None, intrinsics, pose, clock)
        swept = sweep_depth(
            first.image, second.image, camera, glance.later_from_earlier, glance.direction_later, self.params
        )
        clock.step("sweep")
        field = measure_guided_flow(
            first.image, second.image, camera, coarse.later_from_earlier, glance, swept, self.params
        )
        clock.step("flow")
        return self._answer(field, glance, intrinsics, pose, clock)

    def _answer(
        self,
        field: FlowField,
        glance: Egomotion | None,
        intrinsics: Intrinsics,
        pose: _Pose,
        clock: _Clock,
    ) -> ParallaxResult:
        params, camera = self.params, intrinsics.camera
        textured, believed = int(field.textured.sum()), int(field.believed.sum())
        counts = Diagnostics(n_tracks=textured, n_after_distribution=believed, seconds=clock.seconds)
        if textured < params.least_informative:
            detail = (
                f"{textured} of {len(field)} samples have texture, at least {params.least_informative} needed"
            )
            return _nothing(NoDetectionReason.TOO_LITTLE_TEXTURE, detail, counts, field)
        if believed < params.least_informative:
            detail = f"{believed} samples were found again, at least {params.least_informative} needed"
            return _nothing(NoDetectionReason.TOO_LITTLE_FLOW, detail, counts, field)
        left_rad = parallax_left_rad(field)
        limit_rad = still_limit_rad(camera, params)
        # A camera that is known to have moved and sees no parallax looks at something far away.
        if left_rad < limit_rad and pose.direction_later is None:
            detail = (
                f"a turn alone leaves {1e3 * left_rad:.2f} mrad of flow, limit {1e3 * limit_rad:.2f} mrad"
            )
            return _nothing(NoDetectionReason.NO_MOTION, detail, counts, field)
        motion = estimate_egomotion(
            field,
            params,
            attitude_given=pose.attitude_given,
            direction_prior=pose.direction_later,
            start=glance,
        )
        clock.step("motion")
        if motion is None:  # believed samples suffice, so only points beyond the lens are left
            return _nothing(
                NoDetectionReason.TOO_LITTLE_FLOW,
                "too few samples within the lens",
                counts,
                field,
            )
        plane = fit_plane(field, params, motion=motion)
        clock.step("plane")
        depths = inverse_depths(field, motion, params)
        frame_from_later, is_level = flight_frame(pose.level_from_later, camera)
        samples = ranged_samples(depths, baseline_m=pose.baseline_m, frame_from_later=frame_from_later)
        geometry = PairGeometry(
            camera, motion, plane, depths, samples, pose.baseline_m, frame_from_later, is_level
        )
        clock.step("ranges")
        estimate = _motion_estimate(geometry, intrinsics, field, left_rad)
        decision = decide(geometry, params, self.map_params)
        clock.step("map")
        diagnostics = replace(counts, focus_of_expansion_px=estimate.focus_px, motion=estimate)
        return ParallaxResult(
            decision.answer(diagnostics), _tracks(field, motion), estimate.focus_px, geometry, decision, field
        )

    def _frame(self, name: str, image: NDArray[np.uint8] | Frame) -> Frame:
        if isinstance(image, Frame):
            return image
        try:
            return self.prepare(image)
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from error


class _Clock:
    """Notes how long each step took."""

    def __init__(self, timer: Callable[[], float], seconds: dict[str, float]) -> None:
        self._timer = timer
        self.seconds = seconds
        self._last_s = timer()

    def step(self, name: str) -> None:
        now_s = self._timer()
        self.seconds[name] = now_s - self._last_s
        self._last_s = now_s


def _motion_estimate(
    geometry: PairGeometry, intrinsics: Intrinsics, field: FlowField, left_rad: float
) -> MotionEstimate:
    motion, plane = geometry.motion, geometry.plane
    focus = focus_of_expansion(motion, geometry.camera)
    normal = None if plane is None else plane.normal_later
    return MotionEstimate(
        rotation_source=motion.source.value,
        intrinsics_source=intrinsics.source,
        intrinsics_detail=intrinsics.detail,
        direction_later=_floats(motion.direction_later),
        direction_sigma_deg=math.degrees(motion.direction_sigma_rad),
        rotation_sigma_deg=math.degrees(motion.rotation_sigma_rad),
        focus_px=None if focus is None else (focus.x_px, focus.y_px),
        focus_sigma_px=None if focus is None else focus.sigma_px,
        samples=len(field),
        informative=int(geometry.depths.informative.sum()),
        plane_preferred=plane is not None and plane.preferred,
        plane_share=0.0 if plane is None else plane.share,
        plane_normal_later=None if normal is None else _floats(normal),
        parallax_rad=left_rad,
    )


def _tracks(field: FlowField, motion: Egomotion) -> Tracks:
    used = field.where(field.believed)
    rays = used.camera.pixel_to_ray(used.earlier_px) @ motion.correction.T
    start = used.camera.ray_to_pixel(rays)
    seen = np.isfinite(start).all(axis=1)
    return Tracks(start[seen], used.later_px[seen])


def _nothing(
    reason: NoDetectionReason, detail: str, diagnostics: Diagnostics, field: FlowField | None = None
) -> ParallaxResult:
    return ParallaxResult(NoDetection(reason, detail, diagnostics), Tracks.none(), None, field=field)


def _floats(vector: NDArray[np.float64]) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in vector)
    return x, y, z

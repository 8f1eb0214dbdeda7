"""The worker's pipeline: the detector's answers as reports. With ``parallax_child`` the only module of the service that imports ``detector``.

From a frame and the vehicle's pose to the paper's block L2I: the answered pixel as a ray in body FRD, its
range in metres, and the free distance along level azimuths across the field of view.
"""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.config import CameraConfig, DetectorConfig
from companion.errors import ConfigError
from companion.frames.source import Frame
from companion.guidance.coordinates import r_body_from_camera, r_ned_from_body, wrap_rad
from companion.guidance.observation import BearingRange, DetectionReport, Pose
from companion.vision.details import Arrays, KeepingDetector, details_of, paper_arrays
from detector.camera_model import CameraError, CameraModel
from detector.observer import CameraPose, MetricRange, Observation, ObserverParams, VoidObserver
from detector.params import DetectorParams, ParamsError
from detector.results import Direction, NoDetection, NoDetectionReason, SinglePlane, TimeToContact

Vector = NDArray[np.float64]

BEARING_STEP_RAD = math.radians(3.0)
_MAX_ASPECT_CHANGE = 0.02
"""A frame whose sides relate otherwise than the calibrated image's by more than this is not a resized one."""
_STEEP = math.sin(math.radians(10.0))
"""An axis whose level part is below this points up or down and has no azimuth."""
_AXIS = np.array([0.0, 0.0, 1.0])
_NEAR_M = 3.0
_SQUARE_M = 0.2
_SQUARE_POINTS = 2
_MOST_SQUARES = 60


def build_pipeline(detector: DetectorConfig, camera: CameraConfig) -> VoidPipeline:
    """Build the pipeline of a configuration.

    Raises
    ------
    companion.errors.ConfigError
        When the camera file or the parameters cannot be used.
    """
    cv2.setNumThreads(detector.threads)
    try:
        calibrated = CameraModel.from_file(camera.file) if camera.file else None
    except CameraError as error:
        raise ConfigError(f"camera.file: {error}") from error
    vehicle = vehicle_of(detector)
    if detector.method == "parallax":
        # Only here: the worker loads one method.
        from companion.vision.parallax_child import ParallaxPipeline, parallax_params

        return ParallaxPipeline(camera, calibrated, vehicle, parallax_params(detector.params_file))
    try:
        if detector.params_file:
            params = DetectorParams.from_toml(Path(detector.params_file), detector.preset)
        else:
            params = DetectorParams.preset(detector.preset)
    except ParamsError as error:
        raise ConfigError(f"detector.params_file: {error}") from error
    return VoidPipeline(params, camera, calibrated, vehicle)


def vehicle_of(detector: DetectorConfig) -> ObserverParams:
    """Return the vehicle's size, and how far apart the frames of a pair are taken."""
    return ObserverParams(
        vehicle_width_m=detector.vehicle_width_m,
        vehicle_height_m=detector.vehicle_height_m,
        baseline_target_m=detector.baseline_m,
        baseline_min_m=0.4 * detector.baseline_m,
        baseline_max_m=1.8 * detector.baseline_m,
    )


class FrameObserver(Protocol):
    """What turns a stream of frames into answers."""

    def observe(self, image: NDArray[np.uint8], time_ns: int, pose: CameraPose | None = None) -> Observation:
        """Take the next frame, (H, W) uint8, with its time and the camera's pose, and answer on it."""
        ...

    def between_frames(self) -> None:
        """Do what is left to do for the next answer."""
        ...


class VoidPipeline:
    """Runs the observer on each frame and puts its answers in the vehicle's terms.

    Parameters
    ----------
    params
        Of the detector.
    camera
        Mounting, and the field of view that holds where there is no calibration.
    calibrated
        The camera file's model, at the size that it was made for.
    vehicle
        Its size, and how far apart the frames of a pair are taken.
    """

    _method = "paper"

    def __init__(
        self,
        params: DetectorParams,
        camera: CameraConfig,
        calibrated: CameraModel | None,
        vehicle: ObserverParams,
    ) -> None:
        self._params = params
        self._observer_params = vehicle
        self._hfov_deg = camera.hfov_deg
        self._calibrated = calibrated
        self._r_body_from_camera = r_body_from_camera(
            math.radians(camera.mount_roll_deg),
            math.radians(camera.mount_pitch_deg),
            math.radians(camera.mount_yaw_deg),
        )
        self._model: CameraModel | None = None
        self._observer: FrameObserver | None = None
        self._last: Observation | None = None
        self._detector: KeepingDetector | None = None

    def detect(self, frame: Frame, pose: Pose | None) -> DetectionReport:
        """Return the report on one frame. A frame of another size starts anew."""
        began_s = time.perf_counter()
        height_px, width_px = frame.image.shape
        model, observer = self._model, self._observer
        if model is None or observer is None or (model.width_px, model.height_px) != (width_px, height_px):
            try:
                model = self._model_for(width_px, height_px)
            except CameraError as error:
                return DetectionReport(
                    frame.seq,
                    frame.time_ns,
                    "none",
                    reason=NoDetectionReason.WRONG_SIZE.value,
                    detail=str(error),
                    pose=pose,
                    detector_s=time.perf_counter() - began_s,
                )
            observer = self._observer_of(model)
            self._model, self._observer = model, observer
        r_ned_from_camera = (
            None if pose is None else r_ned_from_body(pose.q_ned_from_body) @ self._r_body_from_camera
        )
        camera_pose = (
            None
            if pose is None or r_ned_from_camera is None
            else CameraPose(r_ned_from_camera, np.array([pose.north_m, pose.east_m, pose.down_m]))
        )
        observation = self._last = observer.observe(frame.image, frame.time_ns, camera_pose)
        return self._report(frame, pose, observation, model, r_ned_from_camera, began_s)

    def between_frames(self) -> None:
        """Prepare for the next frame (:meth:`VoidObserver.between_frames`)."""
        if self._observer is not None:
            self._observer.between_frames()

    def details(self) -> tuple[dict[str, Any], Arrays]:
        """Return what was seen on the way to the last report (``companion.vision.details``)."""
        if self._last is None:
            return {}, {}
        return {"method": self._method, **details_of(self._last)}, self._arrays(self._last)

    def _arrays(self, observation: Observation) -> Arrays:
        kept = self._detector.last if self._detector is not None else None
        if kept is None or observation.earlier_time_ns is None:
            return {}
        return paper_arrays(observation, *kept, self._params)

    def _observer_of(self, model: CameraModel) -> FrameObserver:
        self._detector = KeepingDetector(self._params)
        return VoidObserver(
            self._params, model, observer_params=self._observer_params, detector=self._detector
        )

    def _model_for(self, width_px: int, height_px: int) -> CameraModel:
        if self._calibrated is None:
            return CameraModel.from_hfov(width_px, height_px, self._hfov_deg)
        was = self._calibrated
        change = (width_px / height_px) / (was.width_px / was.height_px) - 1.0
        if abs(change) > _MAX_ASPECT_CHANGE:
            raise CameraError(
                f"found a frame of {width_px} x {height_px} px, allowed the sides' ratio of the camera file, "
                f"{was.width_px} x {was.height_px}"
            )
        return was.scaled_to(width_px, height_px)

    def _report(
        self,
        frame: Frame,
        pose: Pose | None,
        observation: Observation,
        model: CameraModel,
        r_ned_from_camera: Vector | None,
        began_s: float,
    ) -> DetectionReport:
        kind, reason, detail = "none", "", ""
        point_px: tuple[float, float] | None = None
        ray_body: tuple[float, float, float] | None = None
        distance_m: float | None = None
        spread_m: float | None = None
        contact: TimeToContact | None = None
        match observation.detection:
            case Direction(x_px, y_px, direction_kind, contact):
                kind, point_px = direction_kind.value, (float(x_px), float(y_px))
                ray = model.pixel_to_ray([point_px])[0]
                if np.isfinite(ray).all():
                    ray_body = _as_floats(self._r_body_from_camera @ ray)
                    distance_m, spread_m = _free_range_m(observation, ray)
            case SinglePlane(contact):
                kind = "single_plane"
                distance_m, spread_m = plane_range_m(observation, contact, model)
                if distance_m is None:
                    distance_m, spread_m = _free_range_m(observation, _level_axis(r_ned_from_camera))
            case NoDetection(no_reason, detail):
                reason = no_reason.value
        contact_s, contact_spread_s = contact_seconds(contact, observation)
        return DetectionReport(
            frame.seq,
            frame.time_ns,
            kind,
            reason=reason,
            detail=detail,
            x_px=None if point_px is None else point_px[0],
            y_px=None if point_px is None else point_px[1],
            ray_body=ray_body,
            pose=pose,
            earlier_frame_ns=observation.earlier_time_ns,
            baseline_m=_finite_or_none(observation.baseline_m),
            time_to_contact_frames=None if contact is None else _finite_or_none(contact.frames),
            time_to_contact_s=contact_s,
            time_to_contact_spread_s=contact_spread_s,
            distance_m=distance_m,
            distance_spread_m=spread_m,
            bearings=() if r_ned_from_camera is None else _bearings(observation, model, r_ned_from_camera),
            obstacles=()
            if pose is None or r_ned_from_camera is None
            else obstacles_seen(
                observation.points_within(_NEAR_M),
                r_ned_from_camera,
                pose,
                self._observer_params.vehicle_height_m,
            ),
            detector_s=time.perf_counter() - began_s,
        )


def contact_seconds(
    contact: TimeToContact | None, observation: Observation
) -> tuple[float | None, float | None]:
    """Return a time to contact in seconds, at the mean speed between the two frames of its pair, and its standard deviation.

    Parameters
    ----------
    contact
        In steps of the pair's length; None where it is not known.
    observation
        For the times of the pair's frames.
    """
    if contact is None or observation.earlier_time_ns is None:
        return None, None
    step_s = (observation.time_ns - observation.earlier_time_ns) / 1e9
    return _finite_or_none(contact.frames * step_s), _finite_or_none(contact.spread_frames * step_s)


def level_rays(model: CameraModel, r_ned_from_camera: Vector) -> list[tuple[float, Vector]]:
    """Return the level directions that the camera sees, every three degrees from its axis.

    Parameters
    ----------
    model
        The camera.
    r_ned_from_camera
        (3, 3), camera to local NED.

    Returns
    -------
    Azimuth (rad in (-pi, pi], local NED) and unit vector in the camera frame of each; none where the camera
    looks up or down, or past the horizon.
    """
    north, east, _ = r_ned_from_camera @ _AXIS
    if math.hypot(north, east) < _STEEP:
        return []
    axis_rad = math.atan2(east, north)
    # The diagonal: a rolled camera sees more of the horizon than its horizontal field of view.
    reach = math.ceil(0.5 * math.hypot(model.hfov_rad, model.vfov_rad) / BEARING_STEP_RAD)
    seen: list[tuple[float, Vector]] = []
    for step in range(-reach, reach + 1):
        azimuth_rad = wrap_rad(axis_rad + step * BEARING_STEP_RAD)
        ray = r_ned_from_camera.T @ np.array([math.cos(azimuth_rad), math.sin(azimuth_rad), 0.0])
        x_px, y_px = model.ray_to_pixel([ray])[0]
        # NaN (behind the camera, beyond the lens) fails both comparisons.
        if 0 <= x_px <= model.width_px - 1 and 0 <= y_px <= model.height_px - 1:
            seen.append((azimuth_rad, ray))
    return seen


def obstacles_seen(
    points_camera: Vector, r_ned_from_camera: Vector, pose: Pose, height_m: float
) -> tuple[tuple[float, float], ...]:
    """Return the places around the vehicle, at its own height, where something was seen.

    Points are gathered in squares of 0.2 m; a square counts with two of them, and the nearest 60 are returned.

    Parameters
    ----------
    points_camera
        (N, 3) in the camera frame, m.
    r_ned_from_camera
        (3, 3).
    pose
        Of the vehicle.
    height_m
        Points within half of it above or below the vehicle count.

    Returns
    -------
    North and east in local NED, m: the middle of the points of each square, the nearest first.
    """
    ned = points_camera @ r_ned_from_camera.T
    flat = ned[np.abs(ned[:, 2]) <= 0.5 * height_m, :2]
    if len(flat) == 0:
        return ()
    squares, member, counts = np.unique(
        np.floor(flat / _SQUARE_M), axis=0, return_inverse=True, return_counts=True
    )
    sums = np.zeros((len(squares), 2))
    np.add.at(sums, member.reshape(-1), flat)
    middles = (sums / counts[:, None])[counts >= _SQUARE_POINTS]
    nearest = middles[np.argsort(np.linalg.norm(middles, axis=1))][:_MOST_SQUARES]
    return tuple((pose.north_m + float(north), pose.east_m + float(east)) for north, east in nearest)


def _bearings(
    observation: Observation, model: CameraModel, r_ned_from_camera: Vector
) -> tuple[BearingRange, ...]:
    found: list[BearingRange] = []
    for azimuth_rad, ray in level_rays(model, r_ned_from_camera):
        along = observation.range_along(ray)
        if along is not None and _is_usable(along):
            found.append(
                BearingRange(azimuth_rad, float(along.distance_m), float(along.spread_m), along.samples)
            )
    return tuple(found)


def _free_range_m(observation: Observation, ray: Vector) -> tuple[float | None, float | None]:
    """Return the free distance along a ray of the camera and its spread, where they are known."""
    along = observation.range_along(ray)
    if along is None or not _is_usable(along):
        return None, None
    return float(along.distance_m), float(along.spread_m)


def plane_range_m(
    observation: Observation, contact: TimeToContact | None, model: CameraModel
) -> tuple[float | None, float | None]:
    """Return the distance of a plane along the camera's axis and its spread (m), where they are known.

    Time to contact is depth over the step along the axis, so the step along the axis gives it its metres. It is used
    before the free range, which near the focus of expansion is no more than a careful lower bound.
    """
    baseline_m = observation.baseline_m
    if contact is None or baseline_m is None:
        return None, None
    step_m = baseline_m
    if observation.focus_px is not None:
        step_m *= float(model.pixel_to_ray([observation.focus_px])[0][2])  # the focus is where the step leads
    distance_m, spread_m = contact.frames * step_m, contact.spread_frames * step_m
    if not (math.isfinite(distance_m) and distance_m > 0 and math.isfinite(spread_m)):
        return None, None
    return float(distance_m), float(spread_m)


def _level_axis(r_ned_from_camera: Vector | None) -> Vector:
    """Return the camera's axis turned into the horizontal plane, in the camera frame; the axis itself without an attitude."""
    if r_ned_from_camera is None:
        return _AXIS
    north, east, _ = r_ned_from_camera @ _AXIS
    level = math.hypot(north, east)
    if level < _STEEP:
        return _AXIS
    ray: Vector = r_ned_from_camera.T @ np.array([north / level, east / level, 0.0])
    return ray


def _is_usable(along: MetricRange) -> bool:
    return math.isfinite(along.distance_m) and along.distance_m > 0 and math.isfinite(along.spread_m)


def _finite_or_none(value: float | None) -> float | None:
    return float(value) if value is not None and math.isfinite(value) else None


def _as_floats(vector: Vector) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in vector)
    return x, y, z

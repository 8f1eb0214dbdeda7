"""The worker's pipeline with the parallax method: the void map, its memory and its confidence in the report."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from companion.config import CameraConfig
from companion.errors import ConfigError
from companion.frames.source import Frame
from companion.guidance.observation import BearingRange, DetectionReport, Pose
from companion.vision.child import BEARING_STEP_RAD, FrameObserver, Vector, VoidPipeline, obstacles_seen
from companion.vision.details import Arrays, parallax_arrays
from detector.camera_model import CameraModel
from detector.observer import Observation, ObserverParams
from detector.parallax.params import ParallaxParams
from detector.parallax.samples import RangedSamples
from detector.parallax.stream import MapReading, ParallaxObservation, ParallaxObserver
from detector.parallax.void_map import BINS, VoidMap, VoidMapParams
from detector.params import DetectorParams, ParamsError, read_toml, validated

_NEAR_M = 3.0
_STEP_BINS = round(BEARING_STEP_RAD / math.tau * BINS)
_SURE_SIGMAS = 2.0


class ParallaxPipeline(VoidPipeline):
    """Runs the parallax method on each frame and puts its map in the vehicle's terms.

    Parameters
    ----------
    camera
        Mounting, and the field of view that holds where there is no calibration.
    calibrated
        The camera file's model, at the size that it was made for.
    vehicle
        Its size, and how far apart the frames of a pair are taken.
    params
        The method's own.
    """

    _method = "parallax"

    def __init__(
        self,
        camera: CameraConfig,
        calibrated: CameraModel | None,
        vehicle: ObserverParams,
        params: ParallaxParams | None = None,
    ) -> None:
        super().__init__(DetectorParams.preset("default"), camera, calibrated, vehicle)
        self._vehicle, self._parallax_params = vehicle, params
        self._camera_source = "field_of_view" if calibrated is None else "calibration"
        self._map_params = VoidMapParams(
            radius_m=0.5 * vehicle.vehicle_width_m, half_height_m=0.5 * vehicle.vehicle_height_m
        )

    def details(self) -> tuple[dict[str, Any], Arrays]:
        """Return what was seen on the way to the last report (``companion.vision.details``)."""
        fields, arrays = super().details()
        reading = None if self._last is None else reading_of(self._last)
        if reading is None:
            return fields, arrays
        gap = reading.gap
        if gap is not None:
            fields["gap"] = {
                "azimuth_rad": gap.azimuth_rad,
                "free_m": gap.free_m,
                "sigma_m": gap.sigma_m,
                "width_rad": gap.width_rad,
            }
        return fields, parallax_arrays(reading)

    def _observer_of(self, model: CameraModel) -> FrameObserver:
        return ParallaxObserver(
            self._parallax_params,
            map_params=self._map_params,
            camera=model,
            camera_source=self._camera_source,
            observer_params=self._vehicle,
        )

    def _report(
        self,
        frame: Frame,
        pose: Pose | None,
        observation: Observation,
        model: CameraModel,
        r_ned_from_camera: Vector | None,
        began_s: float,
    ) -> DetectionReport:
        report = super()._report(frame, pose, observation, model, r_ned_from_camera, began_s)
        if isinstance(observation, ParallaxObservation) and observation.swept_m is not None:
            report = replace(report, swept_m=tuple(round(float(m), 3) for m in observation.swept_m))
        reading = reading_of(observation)
        if reading is None or pose is None:
            return report
        radius_m = self._map_params.radius_m
        found, in_view = reading.remembered.found, reading.measured.known
        distance_m, spread_m = report.distance_m, report.distance_spread_m
        if reading.gap is not None:
            distance_m, spread_m = reading.gap.free_m + radius_m, reading.gap.sigma_m
        elif report.kind == "single_plane" and distance_m is None:
            distance_m, spread_m = _furthest(found, in_view, radius_m)
        return replace(
            report,
            confidence=reading.confidence,
            distance_m=distance_m,
            distance_spread_m=spread_m,
            bearings=bearings_of(reading.surely, in_view, radius_m),
            remembered=bearings_of(reading.surely, ~in_view, radius_m),
            obstacles=obstacles_seen(
                near_points_m(reading.samples), np.eye(3), pose, self._vehicle.vehicle_height_m
            ),
        )


def parallax_params(file: str) -> ParallaxParams:
    """Return the method's parameters with those of a file, which is named where there is one.

    Raises
    ------
    companion.errors.ConfigError
        The file cannot be used.
    """
    try:
        return validated(ParallaxParams, read_toml(Path(file)), file) if file else ParallaxParams()
    except ParamsError as error:
        raise ConfigError(f"detector.params_file: {error}") from error


def bearings_of(found: VoidMap, wanted: NDArray[np.bool_], radius_m: float) -> tuple[BearingRange, ...]:
    """Return the map's known directions, one for every three degrees: the least of the three bins about each.

    Parameters
    ----------
    found
        The map, in metres.
    wanted
        (M,) which bins to tell.
    radius_m
        Of the vehicle. The map tells how far its middle can go, a bearing where the nearest thing stands: that is a radius further.

    Returns
    -------
    The directions in (-pi, pi], local NED.
    """
    told: list[BearingRange] = []
    for middle in range(0, BINS, _STEP_BINS):
        bins = (middle + np.arange(_STEP_BINS) - _STEP_BINS // 2) % BINS
        if not (found.known[bins] & wanted[bins]).all():
            continue
        nearest = bins[int(np.argmin(found.free_m[bins]))]
        distance_m, spread_m = float(found.free_m[nearest]) + radius_m, float(found.sigma_m[nearest])
        # Known no better than to its own length, it is not known.
        if spread_m < distance_m:
            told.append(
                BearingRange(
                    float(found.azimuth_rad[middle]), distance_m, spread_m, int(found.count[bins].max())
                )
            )
    return tuple(told)


def near_points_m(samples: RangedSamples) -> Vector:
    """Return what was surely seen within 3 m, (N, 3) in the level frame from the camera."""
    sure = samples.informative & (samples.inverse_range - _SURE_SIGMAS * samples.sigma > 1.0 / _NEAR_M)
    near = samples.where(np.asarray(sure, np.bool_))
    points: Vector = near.rays_level / near.inverse_range[:, None]
    return points


def reading_of(observation: Observation) -> MapReading | None:
    """Return an observation's map, where it has one."""
    return observation.reading if isinstance(observation, ParallaxObservation) else None


def _furthest(
    found: VoidMap, in_view: NDArray[np.bool_], radius_m: float
) -> tuple[float | None, float | None]:
    """Return how far anything is free in view: where nothing is beyond the wall limit, that is how far the wall is."""
    seen = found.known & in_view
    if not seen.any():
        return None, None
    best = int(np.argmax(np.where(seen, found.free_m, -1.0)))
    spread_m = float(found.sigma_m[best])
    return float(found.free_m[best]) + radius_m, spread_m if math.isfinite(spread_m) else None

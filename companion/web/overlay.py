"""Reports of the detector as the page draws them: in px of the picture, and from above in local NED (pure)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from companion.config import CameraConfig
from companion.errors import ConfigError
from companion.guidance.coordinates import r_body_from_camera, r_ned_from_body
from detector.camera_model import CameraError, CameraModel

_SHOWN: Final = (
    "frame_seq",
    "kind",
    "reason",
    "detail",
    "x_px",
    "y_px",
    "distance_m",
    "distance_spread_m",
    "confidence",
    "baseline_m",
    "time_to_contact_frames",
    "detector_s",
)


class Projection:
    """Puts level directions into the picture of one camera.

    Parameters
    ----------
    camera
        Mounting, and the camera file or the field of view.

    Raises
    ------
    companion.errors.ConfigError
        When the camera file cannot be used.
    """

    def __init__(self, camera: CameraConfig) -> None:
        try:
            self._calibrated = CameraModel.from_file(camera.file) if camera.file else None
        except CameraError as error:
            raise ConfigError(f"camera.file: {error}") from error
        self._hfov_deg = camera.hfov_deg
        self._r_body_from_camera = r_body_from_camera(
            math.radians(camera.mount_roll_deg),
            math.radians(camera.mount_pitch_deg),
            math.radians(camera.mount_yaw_deg),
        )
        self._model: CameraModel | None = None

    def points_px(
        self, azimuths_rad: Sequence[float], q_ned_from_body: Sequence[float], size_px: tuple[int, int]
    ) -> list[tuple[float, float] | None]:
        """Return where level directions lie in the picture.

        Parameters
        ----------
        azimuths_rad
            Local NED.
        q_ned_from_body
            Attitude at the time of the picture (w, x, y, z).
        size_px
            Of the picture, (width, height).

        Returns
        -------
        (x, y) in px of each; None outside the picture.
        """
        model = self._model_for(size_px)
        if model is None or not azimuths_rad:
            return [None] * len(azimuths_rad)
        w, x, y, z = (float(value) for value in q_ned_from_body)
        r_ned_from_camera = r_ned_from_body((w, x, y, z)) @ self._r_body_from_camera
        azimuths = np.asarray(azimuths_rad, np.float64)
        level: NDArray[np.float64] = np.column_stack(
            [np.cos(azimuths), np.sin(azimuths), np.zeros(len(azimuths))]
        )
        points = model.ray_to_pixel(level @ r_ned_from_camera)
        width_px, height_px = size_px
        return [
            # NaN (behind the camera) fails the comparisons.
            (round(float(px), 1), round(float(py), 1)) if 0 <= px < width_px and 0 <= py < height_px else None
            for px, py in points
        ]

    def _model_for(self, size_px: tuple[int, int]) -> CameraModel | None:
        width_px, height_px = size_px
        if self._model is None or (self._model.width_px, self._model.height_px) != size_px:
            try:
                if self._calibrated is None:
                    self._model = CameraModel.from_hfov(width_px, height_px, self._hfov_deg)
                else:
                    self._model = self._calibrated.scaled_to(width_px, height_px)
            except CameraError:
                return None
        return self._model


def detection_view(
    report: Mapping[str, Any], projection: Projection, size_px: tuple[int, int] | None
) -> dict[str, Any]:
    """Return a report as the page draws it.

    Parameters
    ----------
    report
        The fields of ``companion.guidance.observation.DetectionReport``.
    projection
        Puts its bearings into the picture.
    size_px
        Of its frame, (width, height); None: not known, and nothing is put there.

    Returns
    -------
    The answer; ``bearings`` and ``remembered`` as lists of azimuth (deg), free distance and spread (m), and for those in
    the picture x and y (px); ``obstacles`` as north and east (m); ``position_m`` as north and east of the vehicle then.
    """
    view: dict[str, Any] = {name: _plain(report[name]) for name in _SHOWN if report.get(name) is not None}
    view["t"] = int(report["frame_ns"]) / 1e9
    pose = report.get("pose")
    if pose is None:
        return view
    view["position_m"] = [round(float(pose["north_m"]), 3), round(float(pose["east_m"]), 3)]
    for name in ("bearings", "remembered"):
        if found := report.get(name):
            view[name] = _bearings(found, pose["q_ned_from_body"], projection, size_px)
    if obstacles := report.get("obstacles"):
        view["obstacles"] = [[round(float(north), 2), round(float(east), 2)] for north, east in obstacles]
    return view


def _bearings(
    found: Sequence[Mapping[str, Any]],
    q_ned_from_body: Sequence[float],
    projection: Projection,
    size_px: tuple[int, int] | None,
) -> list[list[float]]:
    azimuths = [float(one["azimuth_rad"]) for one in found]
    points = (
        [None] * len(found) if size_px is None else projection.points_px(azimuths, q_ned_from_body, size_px)
    )
    rows: list[list[float]] = []
    for one, point in zip(found, points, strict=True):
        row = [
            round(math.degrees(one["azimuth_rad"]), 1),
            round(float(one["distance_m"]), 2),
            round(float(one["spread_m"]), 2),
        ]
        rows.append(row if point is None else [*row, *point])
    return rows


def _plain(value: Any) -> Any:
    return round(value, 4) if isinstance(value, float) else value


def details_view(
    fields: Mapping[str, Any],
    arrays: Mapping[str, NDArray[Any]],
    projection: Projection,
    attitude: Sequence[float] | None,
    size_px: tuple[int, int] | None,
) -> dict[str, Any]:
    """Return what the detector saw on the way to an answer, as the page draws it.

    Parameters
    ----------
    fields, arrays
        As ``companion.vision.details`` lists them.
    projection
        Puts the void map into the picture.
    attitude
        ``q_ned_from_body`` at the time of the frame (w, x, y, z); None: the map is only seen from above.
    size_px
        Of the frame, (width, height).

    Returns
    -------
    The plain fields that are drawn, arrays as lists of rows (px to a tenth, thinned), ``map`` and ``map_now`` as rows of
    azimuth (deg), free distance and deviation (m), and x and y in the picture for those that lie in it.
    """
    view: dict[str, Any] = {name: fields[name] for name in _DETAILS_SHOWN if fields.get(name) is not None}
    view["t"] = int(fields["frame_ns"]) / 1e9
    for name, digits in _ROWS.items():
        if (array := arrays.get(name)) is not None and len(array):
            view[name] = _thinned(array, digits)
    for name, shown_as in (("void_map", "map_now"), ("remembered", "map")):
        if (rows := arrays.get(name)) is not None:
            view[shown_as] = _map_rows(rows, projection, attitude, size_px)
    return view


_DETAILS_SHOWN: Final = (
    "frame_seq",
    "method",
    "focus_px",
    "lmcc_px",
    "lmcc_magnitude_px",
    "counts",
    "seconds",
    "gap",
)
_ROWS: Final[Mapping[str, int]] = {
    "features": 1,
    "flow": 1,
    "flow_filter": 0,
    "centres": 1,
    "lines": 1,
    "candidates": 1,
    "samples": 3,
    "informative": 0,
}
_MOST_ROWS: Final = 600
_MAP_STEP: Final = 3
"""Every third degree of a map is drawn."""


def _thinned(array: NDArray[Any], digits: int) -> list[Any]:
    step = max(1, -(-len(array) // _MOST_ROWS))
    kept = array[::step]
    if digits == 0:
        whole: list[Any] = kept.astype(int).tolist()
        return whole
    finite = np.nan_to_num(kept.astype(np.float64), posinf=0.0, neginf=0.0)
    rounded: list[Any] = np.round(finite, digits).tolist()
    return rounded


def _map_rows(
    rows: NDArray[Any],
    projection: Projection,
    attitude: Sequence[float] | None,
    size_px: tuple[int, int] | None,
) -> list[list[float]]:
    known = rows[::_MAP_STEP]
    known = known[known[:, 1] >= 0]
    azimuths = [float(azimuth) for azimuth in known[:, 0]]
    points = (
        [None] * len(azimuths)
        if attitude is None or size_px is None
        else projection.points_px(azimuths, attitude, size_px)
    )
    found: list[list[float]] = []
    for (azimuth, free_m, sigma_m), point in zip(known.tolist(), points, strict=True):
        row = [round(math.degrees(azimuth), 1), round(free_m, 2), round(sigma_m, 2)]
        found.append(row if point is None else [*row, *point])
    return found

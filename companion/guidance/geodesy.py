"""Latitude and longitude to local NED and back, as the autopilot itself projects them (pure).

A local frame is what the estimator makes of it, so its own projection is the right one, not a better ellipsoid:

- PX4: azimuthal equidistant on a sphere of 6 371 000 m about the origin (``MapProjection``).
- ArduPilot: a plane, 0.011131884502145034 m for 1e-7 deg (a sphere of 6 378 100 m), longitudes scaled by the
  cosine of the middle latitude (``Location::get_distance_NE``).

Accuracy: against the autopilot's own projection about the same origin better than 1 mm within 10 km. About a pair of
positions of the vehicle instead of the origin, d metres away from it, directions turn by d tan(latitude) / R:
0.16 mrad at 1 km and 45 degrees, 0.2 mm for a step of 1.5 m. The 1e-7 deg of the messages are 11 mm. On recorded flights of PX4 v1.16.1 and ArduCopter 4.7-dev (10-18 m about the
first pair) the local positions they report are met within 6 mm (half of the time), 31 mm at most.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from companion.guidance.dialect import Autopilot

_PX4_RADIUS_M = 6_371_000.0
_ARDUPILOT_M_PER_UNIT = 0.011131884502145034
_UNITS_PER_DEG = 1e7
_HALF_TURN_UNITS = 1_800_000_000


@dataclass(frozen=True, slots=True)
class Anchor:
    """A place that is known both ways.

    Attributes
    ----------
    lat_int, lon_int
        1e-7 deg.
    north_m, east_m
        Local NED.
    """

    lat_int: int
    lon_int: int
    north_m: float
    east_m: float


def to_local(anchor: Anchor, lat_int: int, lon_int: int, autopilot: Autopilot) -> tuple[float, float]:
    """Return north and east in local NED (m) of a latitude and longitude in 1e-7 deg."""
    d_lon = _wrapped(lon_int - anchor.lon_int)
    if autopilot is Autopilot.ARDUPILOT:
        north = (lat_int - anchor.lat_int) * _ARDUPILOT_M_PER_UNIT
        east = d_lon * _ARDUPILOT_M_PER_UNIT * _longitude_scale(lat_int, anchor.lat_int)
        return anchor.north_m + north, anchor.east_m + east
    lat0, lat = _rad(anchor.lat_int), _rad(lat_int)
    east_part = math.cos(lat) * math.sin(_rad(d_lon))
    north_part = math.cos(lat0) * math.sin(lat) - math.sin(lat0) * math.cos(lat) * math.cos(_rad(d_lon))
    sine = math.hypot(north_part, east_part)
    cosine = math.sin(lat0) * math.sin(lat) + math.cos(lat0) * math.cos(lat) * math.cos(_rad(d_lon))
    angle = math.atan2(sine, cosine)  # acos of the cosine would lose all digits at short distances
    scale = _PX4_RADIUS_M * (angle / sine if sine > 0.0 else 1.0)
    return anchor.north_m + scale * north_part, anchor.east_m + scale * east_part


def to_global(anchor: Anchor, north_m: float, east_m: float, autopilot: Autopilot) -> tuple[int, int]:
    """Return latitude and longitude in 1e-7 deg of a place in local NED; the inverse of `to_local`.

    Raises
    ------
    ValueError
        When the place is not finite, or lies beyond a pole.
    """
    north, east = north_m - anchor.north_m, east_m - anchor.east_m
    if not (math.isfinite(north) and math.isfinite(east)):
        raise ValueError(f"not finite: north {north_m}, east {east_m}")
    if autopilot is Autopilot.ARDUPILOT:
        lat_int = anchor.lat_int + north / _ARDUPILOT_M_PER_UNIT
        scale = _longitude_scale(lat_int, anchor.lat_int)
        lon_int = anchor.lon_int + east / (_ARDUPILOT_M_PER_UNIT * scale)
    else:
        lat0 = _rad(anchor.lat_int)
        distance = math.hypot(north, east)
        angle = distance / _PX4_RADIUS_M
        if distance == 0.0:
            return anchor.lat_int, anchor.lon_int
        sine = math.sin(lat0) * math.cos(angle) + north / distance * math.cos(lat0) * math.sin(angle)
        lat = math.asin(max(-1.0, min(1.0, sine)))
        d_lon = math.atan2(
            east * math.sin(angle),
            distance * math.cos(lat0) * math.cos(angle) - north * math.sin(lat0) * math.sin(angle),
        )
        lat_int = math.degrees(lat) * _UNITS_PER_DEG
        lon_int = anchor.lon_int + math.degrees(d_lon) * _UNITS_PER_DEG
    if abs(lat_int) > _HALF_TURN_UNITS / 2:
        raise ValueError(f"{north:.0f} m north of the reference lies beyond a pole")
    return round(lat_int), _wrapped(round(lon_int))


def _rad(units: float) -> float:
    return math.radians(units / _UNITS_PER_DEG)


def _wrapped(units: int) -> int:
    """Return a longitude, or a difference of two, within half a turn."""
    return (units + _HALF_TURN_UNITS) % (2 * _HALF_TURN_UNITS) - _HALF_TURN_UNITS


def _longitude_scale(lat_a: float, lat_b: float) -> float:
    return max(0.01, math.cos(_rad((lat_a + lat_b) / 2)))


class GlobalReference:
    """Where local NED lies on the globe, learned from telemetry.

    A pair of the vehicle's own positions, in both frames at the same time, is preferred: it needs no message that is
    sent once only. GPS_GLOBAL_ORIGIN serves until there is one.
    """

    def __init__(self) -> None:
        self._origin: Anchor | None = None
        self._pair: Anchor | None = None
        self._local: tuple[int, float, float, float, float] | None = None

    @property
    def anchor(self) -> Anchor | None:
        """The reference, or None where it is not known."""
        return self._pair if self._pair is not None else self._origin

    def forget(self) -> None:
        """Forget everything: the local frame is another one (estimator reset, restart)."""
        self._origin = self._pair = self._local = None

    def on_origin(self, lat_int: int, lon_int: int) -> None:
        """Take GPS_GLOBAL_ORIGIN."""
        self._origin = Anchor(lat_int, lon_int, 0.0, 0.0)

    def on_local(
        self, time_boot_ms: int, north_m: float, east_m: float, vn_m_s: float, ve_m_s: float
    ) -> None:
        """Take LOCAL_POSITION_NED."""
        self._local = (time_boot_ms, north_m, east_m, vn_m_s, ve_m_s)

    def on_global(self, time_boot_ms: int, lat_int: int, lon_int: int) -> None:
        """Take GLOBAL_POSITION_INT; with a local position of nearly the same time the two are a pair."""
        if self._local is None or (lat_int, lon_int) == (
            0,
            0,
        ):  # ArduPilot sends zeros while it has no position
            return
        local_ms, north_m, east_m, vn_m_s, ve_m_s = self._local
        dt_s = (time_boot_ms - local_ms) / 1e3
        if abs(dt_s) > _PAIR_S:
            return
        self._pair = Anchor(lat_int, lon_int, north_m + vn_m_s * dt_s, east_m + ve_m_s * dt_s)


_PAIR_S = 0.1
"""Two positions further apart than this in time are no pair: at 5 m/s^2 the velocity explains all but 25 mm."""

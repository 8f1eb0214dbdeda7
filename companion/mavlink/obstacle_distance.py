"""OBSTACLE_DISTANCE from the free distances by azimuth, for the autopilot's own collision prevention and for ground stations.

https://mavlink.io/en/messages/common.html#OBSTACLE_DISTANCE
"""

from __future__ import annotations

import math
from typing import Final

from pymavlink.dialects.v20 import common as mavlink

from companion.guidance.coordinates import heading_rad, wrap_rad
from companion.guidance.observation import BearingRange, DetectionReport, Pose

BINS: Final = 72
INCREMENT_DEG: Final = 5.0
UNKNOWN: Final = 0xFFFF
"""UINT16_MAX: not known, which is not the same as free."""
MIN_DISTANCE_CM: Final = 20
MAX_DISTANCE_CM: Final = 1500
NO_OBSTACLE_CM: Final = MAX_DISTANCE_CM + 1
_REACH_RAD: Final = math.radians(0.5 * INCREMENT_DEG + 1.0)
"""Bearings stand three degrees apart: every bin within them has one this close to its middle."""


def distances_cm(bearings: tuple[BearingRange, ...], heading: float) -> tuple[int, ...]:
    """Return the distances of the 72 bins.

    Parameters
    ----------
    bearings
        Local NED. They are free distances for the vehicle's whole width, so what stands somewhere looks wider by that.
    heading
        Of the vehicle, rad.

    Returns
    -------
    In cm. Bin 0 is centred on the nose, the others follow clockwise, five degrees apart: the nearest of the bearings about each. ``UNKNOWN`` where there is
    none, 1501 where nothing stands within 15 m.
    """
    nearest_m = [math.inf] * BINS
    step_rad = math.radians(INCREMENT_DEG)
    for bearing in bearings:
        from_nose = wrap_rad(bearing.azimuth_rad - heading)
        middle = round(from_nose / step_rad)
        for index in (middle - 1, middle, middle + 1):
            if abs(wrap_rad(from_nose - index * step_rad)) <= _REACH_RAD:
                nearest_m[index % BINS] = min(nearest_m[index % BINS], bearing.distance_m)
    return tuple(_in_cm(metres) for metres in nearest_m)


def obstacle_distance(report: DetectionReport, newest: Pose | None) -> mavlink.MAVLink_message | None:
    """Return the message of a report, or None where it measured nothing in metres.

    Parameters
    ----------
    report
        Its bearings, those that are remembered included.
    newest
        The vehicle's newest pose: bins are about the nose as it is now. None: as it was in the report's frame.
    """
    pose = newest or report.pose
    if not report.bearings or pose is None:
        return None
    distances = distances_cm(report.bearings + report.remembered, heading_rad(pose.q_ned_from_body))
    return mavlink.MAVLink_obstacle_distance_message(
        report.frame_ns // 1000,
        mavlink.MAV_DISTANCE_SENSOR_UNKNOWN,
        list(distances),
        round(INCREMENT_DEG),
        MIN_DISTANCE_CM,
        MAX_DISTANCE_CM,
        increment_f=INCREMENT_DEG,
        angle_offset=0.0,
        frame=mavlink.MAV_FRAME_BODY_FRD,
    )


def _in_cm(metres: float) -> int:
    if math.isinf(metres):
        return UNKNOWN
    centimetres = round(100.0 * metres)
    # Below the least distance the value would mean nothing to who reads it.
    return NO_OBSTACLE_CM if centimetres > MAX_DISTANCE_CM else max(centimetres, MIN_DISTANCE_CM)

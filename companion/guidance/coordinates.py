"""From a pixel's ray to a bearing: camera, body FRD and local NED (paper Fig. 2, block L2I).

Frames: camera (x right, y down, z forward), body FRD (x forward, y right, z down), local NED.
Rotation matrices are named ``r_target_from_source``; angles are in rad, azimuths clockwise from north.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Quaternion = tuple[float, float, float, float]

_BODY_FROM_UNTILTED_CAMERA = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


def wrap_rad(angle_rad: float) -> float:
    """Return the angle in (-pi, pi]."""
    wrapped = math.remainder(angle_rad, math.tau)
    return math.pi if wrapped == -math.pi else wrapped


def r_from_euler(roll_rad: float, pitch_rad: float, yaw_rad: float) -> NDArray[np.float64]:
    """Return the rotation matrix of aerospace Euler angles (yaw, then pitch, then roll), (3, 3).

    It takes vectors of the rotated frame to the frame the angles are given in: with a vehicle's
    attitude, body FRD to local NED.
    """
    cr, sr = math.cos(roll_rad), math.sin(roll_rad)
    cp, sp = math.cos(pitch_rad), math.sin(pitch_rad)
    cy, sy = math.cos(yaw_rad), math.sin(yaw_rad)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def quaternion_from_euler(roll_rad: float, pitch_rad: float, yaw_rad: float) -> Quaternion:
    """Return the unit quaternion (w, x, y, z) of aerospace Euler angles."""
    cr, sr = math.cos(roll_rad / 2), math.sin(roll_rad / 2)
    cp, sp = math.cos(pitch_rad / 2), math.sin(pitch_rad / 2)
    cy, sy = math.cos(yaw_rad / 2), math.sin(yaw_rad / 2)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def r_ned_from_body(q_ned_from_body: Quaternion) -> NDArray[np.float64]:
    """Return the rotation matrix (3, 3) of a unit quaternion (w, x, y, z), body FRD to local NED."""
    w, x, y, z = q_ned_from_body
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def heading_rad(q_ned_from_body: Quaternion) -> float:
    """Return the azimuth of the body's forward axis, in (-pi, pi]."""
    w, x, y, z = q_ned_from_body
    return math.atan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z))


def r_body_from_camera(
    mount_roll_rad: float, mount_pitch_rad: float, mount_yaw_rad: float
) -> NDArray[np.float64]:
    """Return the rotation matrix (3, 3) of the camera's mounting, camera to body FRD.

    With all angles zero the camera looks along the body's forward axis, its image upright. Positive
    pitch looks up, positive yaw looks to the right, positive roll tilts it clockwise seen from behind.
    """
    tilt = r_from_euler(mount_roll_rad, mount_pitch_rad, mount_yaw_rad)
    return np.asarray(tilt @ _BODY_FROM_UNTILTED_CAMERA, dtype=np.float64)


def azimuth_of_body_ray(ray_body: tuple[float, float, float], q_ned_from_body: Quaternion) -> float | None:
    """Return the azimuth in local NED of a ray given in body FRD, in (-pi, pi].

    None where the ray points within 10 degrees of straight up or down: it has no azimuth worth flying.
    """
    north, east, down = r_ned_from_body(q_ned_from_body) @ np.asarray(ray_body)
    horizontal = math.hypot(north, east)
    if horizontal < math.sin(math.radians(10.0)) * math.hypot(horizontal, down):
        return None
    return math.atan2(east, north)

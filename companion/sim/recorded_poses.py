"""Poses recorded with footage: what the fake autopilot reports when it replays instead of flying."""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from companion.guidance.coordinates import Quaternion, r_ned_from_body
from companion.sim.vehicle import Vector3, VehicleState

_HALF_WINDOW_S = 0.05
"""Velocities and body rates are differences over twice this time."""

_COLUMNS = ("time_s", "n", "e", "d", "qw", "qx", "qy", "qz")


@dataclass(frozen=True)
class RecordedPoses:
    """A trajectory: linear interpolation of positions, spherical linear of attitudes.

    Attributes
    ----------
    times_s
        (N,) increasing, from any origin.
    positions_ned_m
        (N, 3) local NED.
    q_ned_from_body
        (N, 4) unit quaternions (w, x, y, z), body FRD to local NED.

    Raises
    ------
    ValueError
        When shapes, order or norms do not fit.
    """

    times_s: NDArray[np.float64]
    positions_ned_m: NDArray[np.float64]
    q_ned_from_body: NDArray[np.float64]

    def __post_init__(self) -> None:
        count = len(self.times_s)
        if count < 2:
            raise ValueError(f"at least 2 poses are needed, got {count}")
        for name, array, shape in (
            ("times_s", self.times_s, (count,)),
            ("positions_ned_m", self.positions_ned_m, (count, 3)),
            ("q_ned_from_body", self.q_ned_from_body, (count, 4)),
        ):
            if array.shape != shape:
                raise ValueError(f"{name}: expected {shape}, got {array.shape}")
            if not np.isfinite(array).all():
                raise ValueError(f"{name} has values that are not finite")
        if not (np.diff(self.times_s) > 0).all():
            raise ValueError("times_s must increase")
        if not np.allclose(np.linalg.norm(self.q_ned_from_body, axis=1), 1.0, atol=1e-3):
            raise ValueError("q_ned_from_body must be unit quaternions")

    @classmethod
    def load(cls, path: Path) -> RecordedPoses:
        """Read a CSV file with the columns time_s, n, e, d, qw, qx, qy, qz.

        Raises
        ------
        ValueError
            When a column is missing or a value is not a number; the message names the file.
        OSError
            When the file cannot be read.
        """
        with path.open(newline="") as file:
            reader = csv.DictReader(file)
            missing = [c for c in _COLUMNS if c not in (reader.fieldnames or ())]
            if missing:
                raise ValueError(f"{path}: no column {', '.join(missing)}")
            try:
                rows = np.array([[float(row[c]) for c in _COLUMNS] for row in reader], np.float64)
            except (TypeError, ValueError) as error:
                raise ValueError(f"{path}: {error}") from error
        if rows.ndim != 2:
            raise ValueError(f"{path}: no rows")
        try:
            return cls(rows[:, 0].copy(), rows[:, 1:4].copy(), rows[:, 4:8].copy())
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error

    @property
    def duration_s(self) -> float:
        """Time from the first pose to the last."""
        return float(self.times_s[-1] - self.times_s[0])

    def pose_at(self, elapsed_s: float) -> tuple[Vector3, Quaternion]:
        """Return position and attitude at a time after the first pose; clamped to the first and last pose."""
        time_s = float(self.times_s[0]) + min(max(elapsed_s, 0.0), self.duration_s)
        after = min(int(np.searchsorted(self.times_s, time_s, side="right")), len(self.times_s) - 1)
        before = after - 1
        share = (time_s - self.times_s[before]) / (self.times_s[after] - self.times_s[before])
        north, east, down = (1 - share) * self.positions_ned_m[before] + share * self.positions_ned_m[after]
        attitude = _slerp(self.q_ned_from_body[before], self.q_ned_from_body[after], share)
        return (float(north), float(east), float(down)), attitude

    def state_at(self, elapsed_s: float) -> VehicleState:
        """Return the pose with velocity and body rates by differences; both are zero outside the recording."""
        position, attitude = self.pose_at(elapsed_s)
        velocity, rates = np.zeros(3), np.zeros(3)
        if 0.0 <= elapsed_s <= self.duration_s:
            start_s = max(0.0, elapsed_s - _HALF_WINDOW_S)
            end_s = min(self.duration_s, elapsed_s + _HALF_WINDOW_S)
            p0, q0 = self.pose_at(start_s)
            p1, q1 = self.pose_at(end_s)
            velocity = (np.array(p1) - np.array(p0)) / (end_s - start_s)
            rates = _rotation_vector(q0, q1) / (end_s - start_s)
        roll, pitch, yaw = _euler(attitude)
        return VehicleState(
            position_ned_m=position,
            velocity_ned_m_s=(float(velocity[0]), float(velocity[1]), float(velocity[2])),
            acceleration_ned_m_s2=(0.0, 0.0, 0.0),
            roll_rad=roll,
            pitch_rad=pitch,
            yaw_rad=yaw,
            body_rates_rad_s=(float(rates[0]), float(rates[1]), float(rates[2])),
            on_ground=False,
        )


def _slerp(q0: NDArray[np.float64], q1: NDArray[np.float64], share: float) -> Quaternion:
    cosine = float(q0 @ q1)
    if cosine < 0.0:  # the same attitude has two quaternions: take the near one
        q1, cosine = -q1, -cosine
    if cosine > 0.9995:
        mixed = (1 - share) * q0 + share * q1
    else:
        angle = math.acos(cosine)
        mixed = (math.sin((1 - share) * angle) * q0 + math.sin(share * angle) * q1) / math.sin(angle)
    w, x, y, z = mixed / np.linalg.norm(mixed)
    return float(w), float(x), float(y), float(z)


def _rotation_vector(q0: Quaternion, q1: Quaternion) -> NDArray[np.float64]:
    """Return the turn from q0 to q1 as a rotation vector (3,) in the body frame, rad."""
    w0, x0, y0, z0 = q0
    w1, x1, y1, z1 = q1
    turn = np.array(
        [
            w0 * w1 + x0 * x1 + y0 * y1 + z0 * z1,
            w0 * x1 - x0 * w1 - y0 * z1 + z0 * y1,
            w0 * y1 + x0 * z1 - y0 * w1 - z0 * x1,
            w0 * z1 - x0 * y1 + y0 * x1 - z0 * w1,
        ]
    )
    if turn[0] < 0.0:
        turn = -turn
    sine = float(np.linalg.norm(turn[1:]))
    if sine < 1e-12:
        return np.zeros(3)
    return turn[1:] / sine * 2.0 * math.atan2(sine, turn[0])


def _euler(q_ned_from_body: Quaternion) -> Vector3:
    """Return roll, pitch and yaw in rad."""
    r = r_ned_from_body(q_ned_from_body)
    pitch = math.asin(min(1.0, max(-1.0, -float(r[2, 0]))))
    return math.atan2(r[2, 1], r[2, 2]), pitch, math.atan2(r[1, 0], r[0, 0])

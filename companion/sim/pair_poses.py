"""Where a camera might be in a world, and how it moves from frame to frame: drawn at random. Pure."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from companion.guidance.coordinates import heading_rad, quaternion_from_euler, wrap_rad
from companion.guidance.observation import Pose
from companion.sim.world.clearance import Obstacles

_FRAME_NS: Final = 250_000_000
_HOPS: Final = (3, 14)
_LONGEST_HOP_M: Final = 4.0
_MARGIN_M: Final = 0.1
_AHEAD_LEAST_M: Final = 0.5
_ATTEMPTS: Final = 200
_LOWEST_M: Final = 0.4
_OPEN_M: Final = 3.0
_VIEW_RAD: Final = np.radians(np.arange(-32.0, 33.0, 4.0))


@dataclass(frozen=True, slots=True)
class DrawnMotion:
    """How far the frames of a sequence lie apart.

    Attributes
    ----------
    step_m
        Least and greatest distance between two frames.
    sideways_rate
        Share of sequences that fly to the side: 25 to 60 degrees from the heading.
    open_rate
        Share of sequences that look where there is a way of at least 3 m, as far as the world has such places.
    track_sd_deg
        Of the others' direction around the heading.
    tilt_sd_deg, turn_sd_deg
        Of roll and pitch, and of the change of heading from frame to frame.
    climb_sd_m
        Of the change of height from frame to frame.
    """

    step_m: tuple[float, float] = (0.15, 0.30)
    sideways_rate: float = 0.15
    open_rate: float = 0.7
    track_sd_deg: float = 8.0
    tilt_sd_deg: float = 2.5
    turn_sd_deg: float = 2.0
    climb_sd_m: float = 0.015

    def __post_init__(self) -> None:
        if not 0.0 < self.step_m[0] <= self.step_m[1] <= 2.0:
            raise ValueError(f"step_m must be two lengths up to 2 m, the lesser first, got {self.step_m}")
        for name in ("sideways_rate", "open_rate"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"{name} must be in [0, 1], got {getattr(self, name)}")


def draw_sequence(
    obstacles: Obstacles,
    start_ned_m: tuple[float, float, float],
    rng: np.random.Generator,
    *,
    frames: int = 2,
    motion: DrawnMotion | None = None,
) -> tuple[Pose, ...] | None:
    """Draw the poses of a few frames in a row.

    The vehicle wanders from the start in straight hops, so that it comes wherever it could fly, and then looks and
    moves on roughly the way it came.

    Parameters
    ----------
    obstacles
        Of the world.
    start_ned_m
        A place that is free.
    rng
        Where chance comes from.
    frames
        How many, at least 2.
    motion
        How far apart.

    Returns
    -------
    The vehicle's poses, all of them free and each reached from the one before; None where no way was found.
    """
    if frames < 2:
        raise ValueError(f"frames must be at least 2, got {frames}")
    motion = motion if motion is not None else DrawnMotion()
    wants_open = rng.random() < motion.open_rate
    for attempt in range(2 * _ATTEMPTS):
        place, azimuth_rad = _wander(obstacles, start_ned_m, rng)
        poses = _fly_on(obstacles, place, azimuth_rad, rng, frames, motion)
        if poses is None:
            continue
        if attempt >= _ATTEMPTS or not wants_open or _way_ahead_m(obstacles, poses[-1]) >= _OPEN_M:
            return poses
    return None


def _way_ahead_m(obstacles: Obstacles, pose: Pose) -> float:
    """Return the longest free way within the usual field of view."""
    azimuths = heading_rad(pose.q_ned_from_body) + _VIEW_RAD
    return float(obstacles.free_distances_m((pose.north_m, pose.east_m, pose.down_m), azimuths).max())


def _wander(
    obstacles: Obstacles, start_ned_m: tuple[float, float, float], rng: np.random.Generator
) -> tuple[tuple[float, float, float], float]:
    north_m, east_m, down_m = start_ned_m
    azimuth_rad = float(rng.uniform(-math.pi, math.pi))
    for _ in range(int(rng.integers(*_HOPS))):
        azimuth_rad = float(rng.uniform(-math.pi, math.pi))
        free_m = obstacles.free_distance_m((north_m, east_m, down_m), azimuth_rad)
        hop_m = float(rng.uniform(0.2, 1.0)) * min(max(0.0, free_m - _MARGIN_M), _LONGEST_HOP_M)
        north_m += hop_m * math.cos(azimuth_rad)
        east_m += hop_m * math.sin(azimuth_rad)
    return (north_m, east_m, down_m + float(rng.uniform(-0.3, 0.3))), azimuth_rad


def _fly_on(
    obstacles: Obstacles,
    place: tuple[float, float, float],
    azimuth_rad: float,
    rng: np.random.Generator,
    frames: int,
    motion: DrawnMotion,
) -> tuple[Pose, ...] | None:
    yaw_rad = wrap_rad(azimuth_rad + float(rng.normal(0.0, math.radians(40.0))))
    offset_rad = float(rng.normal(0.0, math.radians(motion.track_sd_deg)))
    if rng.random() < motion.sideways_rate:
        offset_rad = float(rng.choice([-1.0, 1.0])) * math.radians(float(rng.uniform(25.0, 60.0)))
    tilt = np.radians(rng.normal(0.0, motion.tilt_sd_deg, 2))
    north_m, east_m, down_m = place
    if (
        obstacles.clearance_m(place) <= _MARGIN_M
        or obstacles.free_distance_m(place, yaw_rad) < _AHEAD_LEAST_M
    ):
        return None
    poses = []
    for number in range(frames):
        if number:
            step_m = float(rng.uniform(*motion.step_m))
            track_rad = yaw_rad + offset_rad
            if obstacles.free_distance_m((north_m, east_m, down_m), track_rad) < step_m + _MARGIN_M:
                return None
            north_m += step_m * math.cos(track_rad)
            east_m += step_m * math.sin(track_rad)
            down_m += float(rng.normal(0.0, motion.climb_sd_m))
            yaw_rad = wrap_rad(yaw_rad + math.radians(float(rng.normal(0.0, motion.turn_sd_deg))))
            tilt += np.radians(rng.normal(0.0, 0.4 * motion.tilt_sd_deg, 2))
        if down_m > -_LOWEST_M or obstacles.clearance_m((north_m, east_m, down_m)) <= 0.0:
            return None
        attitude = quaternion_from_euler(float(tilt[0]), float(tilt[1]), yaw_rad)
        poses.append(Pose(number * _FRAME_NS, north_m, east_m, down_m, attitude))
    return tuple(poses)

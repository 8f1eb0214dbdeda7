"""A place to fly in that is ray-cast: nothing to install, every distance known."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from companion.sim.flight_place import Place
from companion.sim.scene import Scene
from companion.sim.vehicle import Vector3

RADIUS_M = 0.35
HALF_HEIGHT_M = 0.15


def ray_cast_place(
    name: str, scene: Callable[[], Scene], goal_north_m: float, *, down_m: float = -1.2
) -> Place:
    """Return a place that starts at the origin, heading north."""
    world = scene()

    def clearance_m(position: Vector3) -> float:
        return world.clearance(position, half_height_m=HALF_HEIGHT_M) - RADIUS_M

    def free_distance_m(position: Vector3, azimuth_rad: float) -> float:
        forward = (math.cos(azimuth_rad), math.sin(azimuth_rad), 0.0)
        north, east, down = position
        return min(
            world.range_along((north - side * forward[1], east + side * forward[0], down), forward)
            for side in (-RADIUS_M, 0.0, RADIUS_M)
        )

    return Place(
        name=name,
        start_ned_m=(0.0, 0.0, down_m),
        start_heading_rad=0.0,
        goal_ned_m=(goal_north_m, 0.0, down_m),
        renderer=scene,
        clearance_m=clearance_m,
        free_distances_m=lambda position, azimuths_rad: np.array(
            [free_distance_m(position, azimuth_rad) for azimuth_rad in azimuths_rad]
        ),
    )

"""What a flight needs to know of where it flies: start, goal, what the camera sees, and how near things are."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from companion.sim.camera_feed import Renderer
from companion.sim.vehicle import Vector3


@dataclass(frozen=True)
class Place:
    """A world with a way to fly in it. Local NED with the floor at down = 0.

    Attributes
    ----------
    name
        For people.
    start_ned_m, start_heading_rad
        Where it is to begin, at the height of the flight, and the first heading.
    goal_ned_m
        Where it is to go.
    renderer
        Makes what the camera looks at; picklable, because the camera may be another process.
    clearance_m
        From the vehicle's hull at a position to the nearest thing, m; 0 or less where it touches.
    free_distances_m
        How far the vehicle could go from a position along azimuths (rad, shape (k,)) before it touches something:
        (k,), m.
    time_limit_s
        Then a flight is over, where nobody says otherwise.
    """

    name: str
    start_ned_m: Vector3
    start_heading_rad: float
    goal_ned_m: Vector3
    renderer: Callable[[], Renderer]
    clearance_m: Callable[[Vector3], float]
    free_distances_m: Callable[[Vector3, NDArray[np.float64]], NDArray[np.float64]]
    time_limit_s: float = 120.0

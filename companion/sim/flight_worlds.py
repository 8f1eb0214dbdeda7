"""From a world as data to a place to fly in: rendered by Panda3D, its distances exact."""

from __future__ import annotations

import math
from functools import partial

from companion.sim.flight_place import Place
from companion.sim.panda_camera import PandaCamera
from companion.sim.world.clearance import Obstacles
from companion.sim.world.file import load_world
from companion.sim.world.model import World


def open_world(name: str) -> Place:
    """Return the place of a built-in world or of a world's file.

    Raises
    ------
    companion.errors.ConfigError
        When there is no such world, or its file cannot be used.
    """
    return place_in(load_world(name))


def place_in(world: World) -> Place:
    """Return a world as a place to fly in."""
    obstacles = Obstacles.of(world)
    start, goal = world.start, world.goal
    return Place(
        name=world.name,
        start_ned_m=(start.north_m, start.east_m, -start.height_m),
        start_heading_rad=math.radians(start.yaw_deg),
        goal_ned_m=(goal.north_m, goal.east_m, -goal.height_m),
        renderer=partial(PandaCamera, world),
        clearance_m=obstacles.clearance_m,
        free_distances_m=obstacles.free_distances_m,
        time_limit_s=world.time_limit_s,
    )

"""From a world as data to a place to fly in: rendered by Panda3D, its distances exact."""

from __future__ import annotations

import math
from functools import partial
from typing import Final, cast

from companion.sim.flight_place import Place
from companion.sim.panda_camera import PandaCamera
from companion.sim.world.clearance import Obstacles
from companion.sim.world.file import load_world
from companion.sim.world.model import World
from companion.sim.world.random import Difficulty, random_world

RANDOM: Final = "random"
"""The world's name that asks for one drawn at random."""


def find_world(name: str, *, seed: int = 0, difficulty: str = "medium") -> World:
    """Return a built-in world, a file's world, or one drawn at random.

    Parameters
    ----------
    name
        Of a built-in world; path of a file; or ``random``.
    seed, difficulty
        Of a random world.

    Raises
    ------
    companion.errors.ConfigError
        When there is no such world, or its file cannot be used.
    """
    if name == RANDOM:
        return random_world(seed, cast("Difficulty", difficulty))  # which it checks
    return load_world(name)


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

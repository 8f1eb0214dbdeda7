"""Worlds drawn at random: floor plan, clutter, textures and light, and always a way from start to goal."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final, Literal

import numpy as np

from companion.errors import ConfigError
from companion.sim.world.clearance import VEHICLE_HALF_HEIGHT_M, VEHICLE_RADIUS_M, Obstacles
from companion.sim.world.model import (
    Box,
    Furniture,
    Goal,
    Light,
    Opening,
    Person,
    Picture,
    Pillar,
    Start,
    Wall,
    World,
)
from companion.sim.world.random_layout import FloorPlan, Layout, Ranges, draw_plan
from companion.sim.world.random_things import Draft, Thing, draw_any, draw_tall
from companion.sim.world.route import find_route
from companion.sim.world.textures import PAINTINGS

Difficulty = Literal["easy", "medium", "hard"]

_MOST_DRAWS: Final = 300
_GRID_M: Final = 0.05
_LAYOUTS: Final[tuple[tuple[Layout, float], ...]] = (
    ("room", 0.3),
    ("rooms", 0.3),
    ("corridor", 0.2),
    ("bend", 0.2),
)
"""What is drawn how often."""
_WALLS: Final = (
    "brick_wall_1", "cinder_blocks_1", "concrete_1", "concrete_2", "concrete_3", "concrete_4", "wood_planks_1", "marble_1",
)  # fmt: skip
_POOR_WALLS: Final = ("drywall_1", "stucco_1", "white_1", "plain:#d6d2c8", "plain:#b9c4c9")
_FLOORS: Final = (
    "floor_tiles_bw_1",
    "floor_tiles_white",
    "wood_planks_1",
    "concrete_tiles_1",
    "asphalt_1",
    "wood_2",
)
_CEILINGS: Final = ("ceiling_tiles_1", "ceiling_tile_noborder_1", "concrete_1", "drywall_1")
_DOORS: Final = ("door_steel_brown", "door_steel_grey", "door_steel_red")


@dataclass(frozen=True, slots=True)
class _Level:
    """What a difficulty means; pairs are the least and the greatest."""

    ranges: Ranges
    blocking: tuple[int, int]  # tall things near the straight line
    must_block: bool  # the straight line cannot be flown
    clutter_per_m2: float
    margin_m: float  # of the way beyond the vehicle's radius
    poor_walls: float  # share of walls with little to see
    brightness: tuple[float, float]


_LEVELS: Final[Mapping[str, _Level]] = MappingProxyType(
    {
        "easy": _Level(Ranges((2.2, 3.0), (1.25, 1.4)), (0, 1), False, 0.05, 0.2, 0.0, (0.9, 1.1)),
        "medium": _Level(Ranges((1.8, 3.0), (1.1, 1.4)), (1, 2), True, 0.09, 0.15, 0.15, (0.7, 1.2)),
        "hard": _Level(Ranges((1.6, 2.6), (0.9, 1.2)), (2, 4), True, 0.13, 0.05, 0.35, (0.45, 1.4)),
    }
)


def random_world(seed: int, difficulty: Difficulty = "medium", radius_m: float = VEHICLE_RADIUS_M) -> World:
    """Draw a world. The same arguments give the same world.

    Parameters
    ----------
    seed
        0 or more.
    difficulty
        ``easy``: wide, and mostly free ahead. ``medium``: the straight line is blocked, by one or two things or by
        the walls. ``hard``: narrower, fuller, plainer and darker.
    radius_m
        Of the vehicle that has to find a way.

    Returns
    -------
    A world whose ``reference_path_m`` is a way from start to goal with a margin of 0.2, 0.15 or 0.05 m
    (easy, medium, hard).

    Raises
    ------
    companion.errors.ConfigError
        When an argument is not allowed, or when no world has room for so large a vehicle.
    """
    if difficulty not in _LEVELS:
        raise ConfigError(f"difficulty: found {difficulty!r}; allowed: {', '.join(_LEVELS)}")
    if seed < 0:
        raise ConfigError(f"seed: found {seed}; allowed: 0 or more")
    level = _LEVELS[difficulty]
    # The floor plan is drawn once, so that redrawing what stands in it does not favour wide plans.
    shares = [share for _, share in _LAYOUTS]
    layout, _ = _LAYOUTS[int(np.random.default_rng((seed, 0)).choice(len(_LAYOUTS), p=shares))]
    for attempt in range(_MOST_DRAWS):
        rng = np.random.default_rng((seed, 1, list(_LEVELS).index(difficulty), attempt))
        plan = draw_plan(layout, rng, level.ranges)
        world = _furnished(plan, rng, level, f"random-{difficulty}-{seed}")
        if level.must_block and not _straight_line_blocked(world, radius_m):
            continue
        route = find_route(
            world,
            radius_m + level.margin_m,
            half_height_m=VEHICLE_HALF_HEIGHT_M + level.margin_m,
            grid_m=_GRID_M,
        )
        if route is not None:
            points = tuple((round(north, 3), round(east, 3)) for north, east in route.points_m.tolist())
            return world.model_copy(update={"reference_path_m": points})
    raise ConfigError(
        f"radius_m: found {radius_m:g}; allowed: one for which {difficulty} worlds have a way, such as "
        f"{VEHICLE_RADIUS_M:g}"
    )


def _furnished(plan: FloorPlan, rng: np.random.Generator, level: _Level, name: str) -> World:
    ceiling_m = round(rng.uniform(2.4, 3.0), 2)
    height_m = round(rng.uniform(1.1, 1.4), 2)
    start = Start(north_m=plan.start_m[0], east_m=plan.start_m[1], height_m=height_m)
    goal = Goal(north_m=plan.goal_m[0], east_m=plan.goal_m[1], height_m=height_m)
    walls = _walls(plan, rng, level.poor_walls)
    things = _things(plan, rng, level, ceiling_m)
    return World(
        name=name,
        description=f"Drawn at random: {plan.about}.",
        ceiling_m=ceiling_m,
        floor_texture=_one_of(_FLOORS, rng),
        ceiling_texture=_one_of(_CEILINGS, rng),
        start=start,
        goal=goal,
        time_limit_s=180.0,
        light=Light(
            ambient=round(rng.uniform(0.45, 0.75), 2),
            azimuth_deg=round(rng.uniform(0.0, 360.0), 1),
            elevation_deg=round(rng.uniform(35.0, 80.0), 1),
            brightness=round(rng.uniform(*level.brightness), 2),
        ),
        walls=walls,
        boxes=tuple(thing for thing in things if isinstance(thing, Box)),
        pillars=tuple(thing for thing in things if isinstance(thing, Pillar)),
        people=tuple(thing for thing in things if isinstance(thing, Person)),
        furniture=tuple(thing for thing in things if isinstance(thing, Furniture)),
    )


def _walls(plan: FloorPlan, rng: np.random.Generator, poor: float) -> tuple[Wall, ...]:
    corners = plan.outline_m
    walls = []
    for begin, end in zip(corners, corners[1:] + corners[:1], strict=True):
        texture = _one_of(_POOR_WALLS if rng.random() < poor else _WALLS, rng)
        pictures = _pictures(0.0, math.dist(begin, end), "left", rng)
        walls.append(Wall(from_m=begin, to_m=end, texture=texture, pictures=pictures))
    for door in plan.doors:
        length_m = math.dist(door.from_m, door.to_m)
        left_m, right_m = door.at_m - door.width_m / 2, door.at_m + door.width_m / 2
        pictures = (*_pictures(0.0, left_m, "right", rng), *_pictures(right_m, length_m, "right", rng))
        opening = Opening(at_m=door.at_m, width_m=door.width_m)
        walls.append(
            Wall(
                from_m=door.from_m,
                to_m=door.to_m,
                texture=_one_of(_WALLS, rng),
                openings=(opening,),
                pictures=pictures,
            )
        )
    return tuple(walls)


def _pictures(
    begin_m: float, end_m: float, side: Literal["left", "right"], rng: np.random.Generator
) -> tuple[Picture, ...]:
    """Return paintings and closed doors along a part of a wall, some metres apart."""
    pictures = []
    at_m = begin_m + rng.uniform(0.8, 2.0)
    while at_m < end_m - 0.7:
        if rng.random() < 0.35:
            picture = Picture(
                at_m=round(at_m, 2),
                side=side,
                bottom_m=0.0,
                width_m=1.0,
                height_m=2.0,
                texture=_one_of(_DOORS, rng),
            )
        else:
            width_m = round(rng.uniform(0.5, 1.0), 2)
            picture = Picture(
                at_m=round(at_m, 2),
                side=side,
                bottom_m=round(rng.uniform(0.9, 1.2), 2),
                width_m=width_m,
                height_m=round(1.25 * width_m, 2),
                texture=_one_of(PAINTINGS, rng),
            )
        pictures.append(picture)
        at_m += rng.uniform(1.6, 4.0)
    return tuple(pictures)


def _things(plan: FloorPlan, rng: np.random.Generator, level: _Level, ceiling_m: float) -> list[Thing]:
    # Circles [north, east, radius] that stay clear: start, goal, doorways, and what stands already.
    taken = [(*plan.start_m, 0.8), (*plan.goal_m, 0.7)]
    for door in plan.doors:
        part = door.at_m / math.dist(door.from_m, door.to_m)
        north, east = (a + part * (b - a) for a, b in zip(door.from_m, door.to_m, strict=True))
        taken.append((north, east, 0.9))
    things: list[Thing] = []

    def place(draft: Draft, centre_m: tuple[float, float], yaw_deg: float) -> None:
        if all(math.dist(centre_m, other[:2]) >= draft.reach_m + other[2] for other in taken):
            taken.append((*centre_m, draft.reach_m))
            things.append(draft.placed((round(centre_m[0], 3), round(centre_m[1], 3)), round(yaw_deg, 1)))

    for _ in range(int(rng.integers(level.blocking[0], level.blocking[1] + 1))):
        part, aside_m = rng.uniform(0.3, 0.75), rng.uniform(-0.4, 0.4)
        north, east = (a + part * (b - a) for a, b in zip(plan.start_m, plan.goal_m, strict=True))
        draft, yaw_deg = draw_tall(rng, ceiling_m), rng.uniform(0.0, 180.0)
        if any(_inside((north, east + aside_m), draft.reach_m, area) for area in plan.areas_m):
            place(draft, (north, east + aside_m), yaw_deg)
    for area in plan.areas_m:
        count = rng.poisson(level.clutter_per_m2 * (area[1] - area[0]) * (area[3] - area[2]))
        for _ in range(int(count)):
            draft = draw_any(rng, ceiling_m)
            place(draft, *_somewhere(draft, area, rng))
    return things


def _somewhere(
    draft: Draft, area_m: tuple[float, float, float, float], rng: np.random.Generator
) -> tuple[tuple[float, float], float]:
    """Return a centre and a heading (deg) in an area: mostly with the long side near a side of it."""
    south, north, west, east = area_m
    reach_m = draft.reach_m + 0.1
    middle = ((south + north) / 2, (west + east) / 2)
    at_north = rng.uniform(min(south + reach_m, middle[0]), max(north - reach_m, middle[0]))
    at_east = rng.uniform(min(west + reach_m, middle[1]), max(east - reach_m, middle[1]))
    from_wall_m = draft.width_m / 2 + rng.uniform(0.1, 0.2)
    tilt_deg = rng.uniform(-4.0, 4.0)
    side = int(rng.integers(6))  # 4 and 5: anywhere
    if side < 2:
        return (at_north, west + from_wall_m if side == 0 else east - from_wall_m), tilt_deg
    if side < 4:
        return (south + from_wall_m if side == 2 else north - from_wall_m, at_east), 90.0 + tilt_deg
    return (at_north, at_east), rng.uniform(0.0, 360.0)


def _inside(point_m: tuple[float, float], reach_m: float, area_m: tuple[float, float, float, float]) -> bool:
    south, north, west, east = area_m
    return south + reach_m <= point_m[0] <= north - reach_m and west + reach_m <= point_m[1] <= east - reach_m


def _straight_line_blocked(world: World, radius_m: float) -> bool:
    north, east = world.goal.north_m - world.start.north_m, world.goal.east_m - world.start.east_m
    position = (world.start.north_m, world.start.east_m, -world.start.height_m)
    free_m = Obstacles.of(world).free_distance_m(position, math.atan2(east, north), radius_m=radius_m)
    return free_m < math.hypot(north, east)


def _one_of(names: tuple[str, ...], rng: np.random.Generator) -> str:
    return names[int(rng.integers(len(names)))]

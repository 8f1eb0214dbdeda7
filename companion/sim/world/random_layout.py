"""Floor plans drawn at random: a room, two rooms with a door between, a corridor, a corridor that bends."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final, Literal

import numpy as np

Layout = Literal["room", "rooms", "corridor", "bend"]
_Point = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Ranges:
    """What a difficulty allows.

    Attributes
    ----------
    corridor_m, door_m
        Least and greatest width.
    """

    corridor_m: tuple[float, float]
    door_m: tuple[float, float]


@dataclass(frozen=True, slots=True)
class Door:
    """A wall across a plan, from one point to another, with a doorway ``at_m`` along it."""

    from_m: _Point
    to_m: _Point
    at_m: float
    width_m: float


@dataclass(frozen=True, slots=True)
class FloorPlan:
    """Where walls stand and where things may.

    Attributes
    ----------
    about
        In words.
    outline_m
        Corners [north, east] of the outer walls, with the inside to the left from each to the next.
    areas_m
        Rectangles (south, north, west, east) of floor.
    start_m, goal_m
        [north, east].
    doors
        Inner walls.
    """

    about: str
    outline_m: tuple[_Point, ...]
    areas_m: tuple[tuple[float, float, float, float], ...]
    start_m: _Point
    goal_m: _Point
    doors: tuple[Door, ...] = ()


def draw_plan(layout: Layout, rng: np.random.Generator, ranges: Ranges) -> FloorPlan:
    """Return a floor plan; it depends on nothing but the arguments."""
    return _DRAWN[layout](rng, ranges)


def _rectangle(north_m: float, east_m: float) -> tuple[_Point, ...]:
    return ((0.0, 0.0), (0.0, east_m), (north_m, east_m), (north_m, 0.0))


def _room(rng: np.random.Generator, ranges: Ranges) -> FloorPlan:
    del ranges  # a room has neither corridor nor door
    length, width = round(rng.uniform(7.0, 12.0), 2), round(rng.uniform(5.0, 9.0), 2)
    return FloorPlan(
        about=f"a room of {length:g} m by {width:g} m",
        outline_m=_rectangle(length, width),
        areas_m=((0.0, length, 0.0, width),),
        start_m=(1.1, round(rng.uniform(1.2, width - 1.2), 2)),
        goal_m=(round(length - 1.1, 2), round(rng.uniform(1.2, width - 1.2), 2)),
    )


def _rooms(rng: np.random.Generator, ranges: Ranges) -> FloorPlan:
    near, far = round(rng.uniform(5.0, 7.0), 2), round(rng.uniform(5.0, 7.0), 2)
    width = round(rng.uniform(5.0, 8.0), 2)
    length = round(near + far, 2)
    door = Door(
        from_m=(near, 0.0),
        to_m=(near, width),
        at_m=round(rng.uniform(1.0, width - 1.0), 2),
        width_m=round(rng.uniform(*ranges.door_m), 2),
    )
    return FloorPlan(
        about=f"two rooms, {length:g} m by {width:g} m together, with a door of {door.width_m:g} m",
        outline_m=_rectangle(length, width),
        areas_m=((0.0, near, 0.0, width), (near, length, 0.0, width)),
        start_m=(1.1, round(rng.uniform(1.2, width - 1.2), 2)),
        goal_m=(round(length - 1.1, 2), round(rng.uniform(1.2, width - 1.2), 2)),
        doors=(door,),
    )


def _corridor(rng: np.random.Generator, ranges: Ranges) -> FloorPlan:
    length, width = round(rng.uniform(10.0, 16.0), 2), round(rng.uniform(*ranges.corridor_m), 2)
    return FloorPlan(
        about=f"a corridor of {length:g} m by {width:g} m",
        outline_m=_rectangle(length, width),
        areas_m=((0.0, length, 0.0, width),),
        start_m=(1.0, round(width / 2 + rng.uniform(-0.15, 0.15), 2)),
        goal_m=(round(length - 1.1, 2), round(width / 2 + rng.uniform(-0.15, 0.15), 2)),
    )


def _bend(rng: np.random.Generator, ranges: Ranges) -> FloorPlan:
    width = round(rng.uniform(max(1.8, ranges.corridor_m[0]), ranges.corridor_m[1]), 2)
    first, second = round(rng.uniform(7.0, 10.0), 2), round(rng.uniform(6.0, 10.0), 2)
    inner = round(first - width, 2)
    end = round(width + second, 2)
    corners: tuple[_Point, ...] = (
        (0.0, 0.0),
        (0.0, width),
        (inner, width),
        (inner, end),
        (first, end),
        (first, 0.0),
    )
    areas: tuple[tuple[float, float, float, float], ...] = (
        (0.0, inner, 0.0, width),
        (inner, first, 0.0, end),
    )
    start = (1.0, round(width / 2, 2))
    goal = (round(first - width / 2, 2), round(end - 1.1, 2))
    to_the_right = bool(rng.random() < 0.5)
    if not to_the_right:  # mirrored; and gone round the other way, so that the inside stays to the left
        corners = tuple((north, -east) for north, east in reversed(corners))
        areas = tuple((south, north, -east, -west) for south, north, west, east in areas)
        start, goal = (start[0], -start[1]), (goal[0], -goal[1])
    side = "right" if to_the_right else "left"
    return FloorPlan(f"a corridor of {width:g} m that bends to the {side}", corners, areas, start, goal)


_DRAWN: Final[Mapping[Layout, Callable[[np.random.Generator, Ranges], FloorPlan]]] = MappingProxyType(
    {"room": _room, "rooms": _rooms, "corridor": _corridor, "bend": _bend}
)

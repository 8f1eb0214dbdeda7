"""Things drawn at random, before they have a place: cupboards, crates, pillars, people, furniture."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np

from companion.sim.world.furniture import MESHES, FurnitureKind
from companion.sim.world.model import Box, Furniture, Person, Pillar

Thing = Box | Pillar | Person | Furniture
_Point = tuple[float, float]

_CUPBOARDS: Final = (
    "wood_1",
    "wood_2",
    "cardboard_1",
    "cardboard_2",
    "cardboard_3",
    "metal_grill_1",
    "marble_2",
)
_PILLARS: Final = ("concrete_1", "concrete_2", "marble_1", "stucco_1", "brick_wall_1")
_CLOTHES: Final = ("plain:#35507a", "plain:#7a3535", "plain:#3d6b46", "plain:#c9b458", "plain:#2b2b2b")
_LOW_KINDS: Final[tuple[FurnitureKind, ...]] = (
    "desk",
    "office_chair",
    "barrel",
    "cone",
    "plant",
    "crate",
)


@dataclass(frozen=True, slots=True)
class Draft:
    """A thing without a place.

    Attributes
    ----------
    length_m, width_m
        Along its heading and across it.
    placed
        Makes it, from its centre [north, east] (m) and its heading (deg).
    """

    length_m: float
    width_m: float
    placed: Callable[[_Point, float], Thing]

    @property
    def reach_m(self) -> float:
        """Radius of the circle around its centre that holds it."""
        return math.hypot(self.length_m, self.width_m) / 2


def draw_tall(rng: np.random.Generator, ceiling_m: float) -> Draft:
    """Return something that stands in the way of a vehicle at 1 to 1.5 m height."""
    kind = int(rng.integers(4))
    if kind == 0:
        return _cupboard(rng, ceiling_m)
    if kind == 1:
        radius_m = round(rng.uniform(0.15, 0.35), 2)
        texture = _PILLARS[int(rng.integers(len(_PILLARS)))]
        return Draft(2 * radius_m, 2 * radius_m, partial(_pillar, radius_m, texture))
    if kind == 2:
        person = partial(
            _person, round(rng.uniform(1.6, 1.95), 2), _CLOTHES[int(rng.integers(len(_CLOTHES)))]
        )
        depth_m, breadth_m = person((0.0, 0.0), 0.0).shoulders_m
        return Draft(depth_m, breadth_m, person)
    return _furniture("pine", round(rng.uniform(0.9, 1.1), 2))


def draw_any(rng: np.random.Generator, ceiling_m: float) -> Draft:
    """Return anything, also what is low or light."""
    if rng.random() < 0.4:
        return draw_tall(rng, ceiling_m)
    return _furniture(_LOW_KINDS[int(rng.integers(len(_LOW_KINDS)))], round(rng.uniform(0.9, 1.15), 2))


def _cupboard(rng: np.random.Generator, ceiling_m: float) -> Draft:
    length_m, width_m = round(rng.uniform(0.5, 1.4), 2), round(rng.uniform(0.35, 0.7), 2)
    height_m = round(min(rng.uniform(1.5, 2.2), ceiling_m - 0.1), 2)
    texture = _CUPBOARDS[int(rng.integers(len(_CUPBOARDS)))]
    return Draft(length_m, width_m, partial(_box, (length_m, width_m, height_m), texture))


def _furniture(kind: FurnitureKind, scale: float) -> Draft:
    length_m, width_m, _ = MESHES[kind].size_m
    return Draft(scale * length_m, scale * width_m, partial(_piece, kind, scale))


def _box(size_m: tuple[float, float, float], texture: str, centre_m: _Point, yaw_deg: float) -> Box:
    return Box(centre_m=centre_m, size_m=size_m, yaw_deg=yaw_deg, texture=texture)


def _pillar(radius_m: float, texture: str, centre_m: _Point, yaw_deg: float) -> Pillar:
    del yaw_deg  # round
    return Pillar(centre_m=centre_m, radius_m=radius_m, texture=texture)


def _person(height_m: float, texture: str, centre_m: _Point, yaw_deg: float) -> Person:
    return Person(centre_m=centre_m, height_m=height_m, yaw_deg=yaw_deg, clothes_texture=texture)


def _piece(kind: FurnitureKind, scale: float, centre_m: _Point, yaw_deg: float) -> Furniture:
    return Furniture(kind=kind, centre_m=centre_m, yaw_deg=yaw_deg, scale=scale)

"""Every thing of a world as upright convex prisms: what a vehicle can touch."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from companion.sim.world.furniture import MESHES
from companion.sim.world.furniture_layers import LAYERS
from companion.sim.world.model import Box, Furniture, Person, Pillar, Wall, World

_PILLAR_SIDES: Final = 16
_PERSON_SIDES: Final = 12


@dataclass(frozen=True, eq=False)
class Prism:
    """A horizontal convex polygon between two heights.

    Attributes
    ----------
    outline_m
        (n, 2) float64, corners [north, east], clockwise as seen from above (north up, east right).
    bottom_m, top_m
        Heights above the floor.
    kind
        ``wall``, ``box``, ``pillar``, ``person`` or ``furniture``.
    """

    outline_m: NDArray[np.float64]
    bottom_m: float
    top_m: float
    kind: str


def prisms_of(world: World) -> tuple[Prism, ...]:
    """Return everything in a world that can be touched, except floor and ceiling.

    Pillars and people become polygons around their circle or ellipse (1.02 times as wide at most), furniture its
    layers. Pictures are flat and are left out.
    """
    prisms: list[Prism] = []
    for wall in world.walls:
        prisms.extend(wall_prisms(wall, world.ceiling_m))
    prisms.extend(_box_prism(box) for box in world.boxes)
    prisms.extend(_pillar_prism(pillar, world.ceiling_m) for pillar in world.pillars)
    prisms.extend(_person_prism(person) for person in world.people)
    for piece in world.furniture:
        prisms.extend(_furniture_prisms(piece))
    return tuple(prisms)


def wall_prisms(wall: Wall, ceiling_m: float) -> tuple[Prism, ...]:
    """Return a wall's solid parts: those between its openings, and the lintels above them."""
    foot_m = wall.bottom_m
    top_m = ceiling_m if wall.height_m is None else min(foot_m + wall.height_m, ceiling_m)
    parts: list[Prism] = []
    reached_m = 0.0
    for opening in sorted(wall.openings, key=lambda opening: opening.at_m):
        begin_m, end_m = opening.at_m - opening.width_m / 2, opening.at_m + opening.width_m / 2
        if begin_m - reached_m > 1e-6:
            parts.append(_wall_part(wall, reached_m, begin_m, foot_m, top_m))
        if foot_m + opening.height_m < top_m - 1e-6:
            parts.append(_wall_part(wall, begin_m, end_m, foot_m + opening.height_m, top_m))
        reached_m = end_m
    if wall.length_m - reached_m > 1e-6:
        parts.append(_wall_part(wall, reached_m, wall.length_m, foot_m, top_m))
    return tuple(parts)


def rectangle_m(
    centre_m: tuple[float, float], along_m: float, across_m: float, yaw_rad: float
) -> NDArray[np.float64]:
    """Return a rectangle's corners, (4, 2) [north, east], clockwise as seen from above.

    Parameters
    ----------
    centre_m
        [north, east].
    along_m, across_m
        Its length along its heading, and its width.
    yaw_rad
        Azimuth of its heading.
    """
    half = np.array([[1.0, -1.0], [1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0]]) * (along_m / 2, across_m / 2)
    return _placed(half, centre_m, yaw_rad)


def ellipse_m(
    centre_m: tuple[float, float], along_m: float, across_m: float, yaw_rad: float, sides: int
) -> NDArray[np.float64]:
    """Return a polygon that just contains an ellipse, (sides, 2) [north, east], clockwise as seen from above.

    Parameters
    ----------
    centre_m
        [north, east].
    along_m, across_m
        Its diameters along its heading and across it.
    yaw_rad
        Azimuth of its heading.
    sides
        Number of corners.
    """
    angle = 2.0 * math.pi * np.arange(sides) / sides
    # A regular polygon whose sides touch the unit circle, and the affine map that makes the circle the ellipse.
    corners = np.column_stack([np.cos(angle), np.sin(angle)]) / math.cos(math.pi / sides)
    return _placed(corners * (along_m / 2, across_m / 2), centre_m, yaw_rad)


def _placed(
    corners: NDArray[np.float64], centre_m: tuple[float, float], yaw_rad: float
) -> NDArray[np.float64]:
    cosine, sine = math.cos(yaw_rad), math.sin(yaw_rad)
    return np.asarray(corners @ np.array([[cosine, sine], [-sine, cosine]]) + np.array(centre_m))


def _wall_part(wall: Wall, begin_m: float, end_m: float, bottom_m: float, top_m: float) -> Prism:
    north, east = (b - a for a, b in zip(wall.from_m, wall.to_m, strict=True))
    middle = (begin_m + end_m) / 2 / wall.length_m
    centre = (wall.from_m[0] + middle * north, wall.from_m[1] + middle * east)
    outline = rectangle_m(centre, end_m - begin_m, wall.thickness_m, math.atan2(east, north))
    return Prism(outline, bottom_m, top_m, "wall")


def _box_prism(box: Box) -> Prism:
    along_m, across_m, height_m = box.size_m
    outline = rectangle_m(box.centre_m, along_m, across_m, math.radians(box.yaw_deg))
    return Prism(outline, box.bottom_m, box.bottom_m + height_m, "box")


def _pillar_prism(pillar: Pillar, ceiling_m: float) -> Prism:
    diameter_m = 2.0 * pillar.radius_m
    outline = ellipse_m(pillar.centre_m, diameter_m, diameter_m, 0.0, _PILLAR_SIDES)
    return Prism(outline, 0.0, ceiling_m if pillar.height_m is None else pillar.height_m, "pillar")


def _person_prism(person: Person) -> Prism:
    along_m, across_m = person.shoulders_m
    yaw_rad = math.radians(person.yaw_deg)
    outline = ellipse_m(person.centre_m, along_m, across_m, yaw_rad, _PERSON_SIDES)
    return Prism(outline, 0.0, person.height_m, "person")


def _furniture_prisms(piece: Furniture) -> tuple[Prism, ...]:
    if piece.kind not in LAYERS:
        along_m, across_m, height_m = (piece.scale * size_m for size_m in MESHES[piece.kind].size_m)
        outline = rectangle_m(piece.centre_m, along_m, across_m, math.radians(piece.yaw_deg))
        return (Prism(outline, 0.0, height_m, "furniture"),)
    yaw_rad = math.radians(piece.yaw_deg)
    ahead = np.array([math.cos(yaw_rad), math.sin(yaw_rad)])
    right = np.array([-ahead[1], ahead[0]])
    return tuple(
        Prism(
            np.array(piece.centre_m) + piece.scale * (np.array(outline) @ np.stack([ahead, right])),
            piece.scale * bottom_m,
            piece.scale * top_m,
            "furniture",
        )
        for bottom_m, top_m, outline in LAYERS[piece.kind]
    )

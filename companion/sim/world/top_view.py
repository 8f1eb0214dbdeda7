"""The plan of a world as a picture: north up, east right, things cut at the height of flight told from lower and higher ones."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from companion.sim.world.clearance import VEHICLE_HALF_HEIGHT_M
from companion.sim.world.model import World
from companion.sim.world.prisms import prisms_of

Colour = tuple[int, int, int]
"""Blue, green, red; 0 to 255."""

_FLOOR: Final[Colour] = (250, 250, 248)
_OUTLINE: Final[Colour] = (70, 70, 70)
_INK: Final[Colour] = (60, 60, 60)
_START: Final[Colour] = (60, 150, 40)
_GOAL: Final[Colour] = (40, 40, 210)
_PATH: Final[Colour] = (200, 130, 40)
_OF_KIND: Final[Mapping[str, Colour]] = MappingProxyType(
    {
        "wall": (95, 95, 95),
        "box": (110, 150, 190),
        "pillar": (150, 150, 150),
        "person": (190, 120, 160),
        "furniture": (150, 185, 150),
    }
)
_SHIFT: Final = 4  # binary digits of a pixel's fraction in OpenCV's drawing


@dataclass(frozen=True, eq=False)
class TopView:
    """A plan and its scale.

    Attributes
    ----------
    image
        (height, width, 3) uint8, blue, green, red.
    px_per_m
        Scale.
    north_m, west_m
        Of the middle of the upper left pixel.
    """

    image: NDArray[np.uint8]
    px_per_m: float
    north_m: float
    west_m: float

    def pixels(self, points_m: ArrayLike) -> NDArray[np.float64]:
        """Return where places [north, east], (n, 2) or more columns, are in the image: (n, 2) [x, y] px."""
        points = np.asarray(points_m, dtype=np.float64).reshape(-1, np.shape(points_m)[-1])
        x_px = (points[:, 1] - self.west_m) * self.px_per_m
        y_px = (self.north_m - points[:, 0]) * self.px_per_m
        return np.column_stack([x_px, y_px])

    def draw_path(self, points_m: ArrayLike, colour: Colour = _PATH, thickness_px: int = 2) -> None:
        """Draw a line through places [north, east], (n, 2) or more columns, into the image."""
        cv2.polylines(
            self.image, [_fixed(self.pixels(points_m))], False, colour, thickness_px, cv2.LINE_AA, _SHIFT
        )

    def draw_disc(self, point_m: ArrayLike, radius_m: float, colour: Colour, thickness_px: int = -1) -> None:
        """Draw a disc (or with a thickness a circle) around a place [north, east] into the image."""
        x, y = _fixed(self.pixels(np.atleast_2d(np.asarray(point_m, dtype=np.float64))))[0].tolist()
        radius = max(round(radius_m * self.px_per_m * (1 << _SHIFT)), 1 << _SHIFT)
        cv2.circle(self.image, (x, y), radius, colour, thickness_px, cv2.LINE_AA, _SHIFT)


def top_view(
    world: World, *, px_per_m: float = 40.0, margin_m: float = 0.4, with_reference_path: bool = True
) -> TopView:
    """Draw the plan of a world.

    What the vehicle would meet at the start's height is filled; what is lower or higher is an outline only
    (a lintel, a cone). Start (with its heading) and goal are marked, and the reference path where there is one.

    Parameters
    ----------
    world
        What to draw.
    px_per_m
        Scale.
    margin_m
        Around everything.
    with_reference_path
        Draw ``World.reference_path_m``.
    """
    prisms = sorted(prisms_of(world), key=lambda prism: prism.top_m)
    start, goal = (world.start.north_m, world.start.east_m), (world.goal.north_m, world.goal.east_m)
    everything = np.concatenate([np.array([start, goal]), *(prism.outline_m for prism in prisms)])
    south, west = everything.min(axis=0) - margin_m
    north, east = everything.max(axis=0) + margin_m
    height, width = round((north - south) * px_per_m) + 1, round((east - west) * px_per_m) + 1
    view = TopView(np.full((height, width, 3), _FLOOR, dtype=np.uint8), px_per_m, float(north), float(west))
    low_m = world.start.height_m - VEHICLE_HALF_HEIGHT_M
    high_m = world.start.height_m + VEHICLE_HALF_HEIGHT_M
    for prism in prisms:
        corners = _fixed(view.pixels(prism.outline_m))
        if prism.bottom_m < high_m and prism.top_m > low_m:
            cv2.fillConvexPoly(view.image, corners, _OF_KIND[prism.kind], cv2.LINE_AA, _SHIFT)
        line = _OF_KIND[prism.kind] if prism.kind == "wall" else _OUTLINE
        cv2.polylines(view.image, [corners], True, line, 1, cv2.LINE_AA, _SHIFT)
    if with_reference_path and world.reference_path_m:
        view.draw_path(world.reference_path_m)
    _mark_start(view, world)
    view.draw_disc(goal, 0.3, _GOAL)
    return view


def _mark_start(view: TopView, world: World) -> None:
    start = np.array([world.start.north_m, world.start.east_m])
    yaw_rad = np.radians(world.start.yaw_deg)
    ahead = np.array([np.cos(yaw_rad), np.sin(yaw_rad)])
    view.draw_disc(start, 0.2, _START)
    tip, tail = _fixed(view.pixels([start + 0.6 * ahead, start])).tolist()
    cv2.line(view.image, tail, tip, _START, 2, cv2.LINE_AA, _SHIFT)


def plan_sheet(worlds: tuple[World, ...], *, px_per_m: float, columns: int) -> NDArray[np.uint8]:
    """Draw several plans beside each other, each with its name.

    Parameters
    ----------
    worlds
        At least one.
    px_per_m
        Scale of all.
    columns
        Plans in a row.

    Returns
    -------
    (height, width, 3) uint8, blue, green, red.
    """
    plans = [top_view(world, px_per_m=px_per_m).image for world in worlds]
    label_px = 20
    tile_width = max(110, *(plan.shape[1] for plan in plans)) + 10
    rows = []
    for first in range(0, len(plans), columns):
        row_plans = plans[first : first + columns]
        row_height = max(plan.shape[0] for plan in row_plans) + label_px
        row = np.full((row_height, columns * tile_width, 3), 255, dtype=np.uint8)
        for index, plan in enumerate(row_plans):
            left = index * tile_width + (tile_width - plan.shape[1]) // 2
            row[label_px : label_px + plan.shape[0], left : left + plan.shape[1]] = plan
            place = (index * tile_width + 6, 14)
            name = worlds[first + index].name
            cv2.putText(row, name, place, cv2.FONT_HERSHEY_SIMPLEX, 0.42, _INK, 1, cv2.LINE_AA)
        rows.append(row)
    return np.vstack(rows)


def _fixed(pixels: NDArray[np.float64]) -> NDArray[np.int32]:
    """Return pixels as OpenCV's fixed-point numbers."""
    return np.asarray(np.round(pixels * (1 << _SHIFT)), dtype=np.int32)

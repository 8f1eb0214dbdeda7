"""A way from start to goal, searched on a grid: whether there is one, and how long it is."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from companion.sim.world.clearance import VEHICLE_HALF_HEIGHT_M, VEHICLE_RADIUS_M, Obstacles
from companion.sim.world.model import World
from companion.sim.world.prisms import prisms_of

_MARGIN_M: Final = 2.0
"""Of free floor around everything, so that a way may lead around a wall that nothing encloses."""

_STEPS: Final = ((0, 1), (1, 0), (1, 1), (1, -1), (1, 2), (2, 1), (1, -2), (2, -1))
"""Half of the sixteen directions of a step; the others are their reverses."""


@dataclass(frozen=True, eq=False)
class Route:
    """A way that a vehicle can fly on the level.

    Attributes
    ----------
    points_m
        (n, 2) float64, corners [north, east] from start to goal.
    length_m
        Along them.
    """

    points_m: NDArray[np.float64]
    length_m: float


def find_route(
    world: World,
    radius_m: float = VEHICLE_RADIUS_M,
    *,
    half_height_m: float = VEHICLE_HALF_HEIGHT_M,
    grid_m: float = 0.1,
) -> Route | None:
    """Return the shortest way from start to goal at the start's height, or None when there is none.

    Things are drawn on a grid and widened by the radius; the shortest way over its free cells (steps to 16
    neighbours) is then pulled straight, checked against the exact shapes.

    Parameters
    ----------
    world
        Where.
    radius_m, half_height_m
        Of the vehicle's cylinder; add a margin to the radius for a way that need not be flown to the centimetre.
    grid_m
        Side of a cell. A gap that is not wider than the vehicle by two cells may be missed.
    """
    grid = _Grid.of(world, radius_m, half_height_m, grid_m)
    start, goal = (world.start.north_m, world.start.east_m), (world.goal.north_m, world.goal.east_m)
    first, last = grid.cell(start), grid.cell(goal)
    if not (grid.free[first] and grid.free[last]):
        return None
    cells = _shortest(grid.free, first, last)
    if cells is None:
        return None
    points = np.vstack([start, grid.points_m(cells), goal])
    straight = _pulled_straight(points, Obstacles.of(world), -world.start.height_m, radius_m, half_height_m)
    if straight is None:
        return None
    return Route(straight, float(np.hypot(*np.diff(straight, axis=0).T).sum()))


def point_route(route: Route, spacing_m: float) -> NDArray[np.float64]:
    """Return points [north, east] along a route, (n, 2), ``spacing_m`` apart at most, its corners among them."""
    legs = [route.points_m[:1]]
    for begin, end in zip(route.points_m[:-1], route.points_m[1:], strict=True):
        count = max(1, math.ceil(math.dist(begin, end) / spacing_m))
        legs.append(begin + (np.arange(1, count + 1) / count)[:, None] * (end - begin))
    return np.concatenate(legs)


@dataclass(frozen=True, eq=False)
class _Grid:
    """Cells of a floor, rows along north; ``free`` (rows, columns) where the vehicle's middle may be."""

    free: NDArray[np.bool_]
    corner_m: NDArray[np.float64]
    side_m: float

    @classmethod
    def of(cls, world: World, radius_m: float, half_height_m: float, side_m: float) -> _Grid:
        height_m = world.start.height_m
        outlines = [
            prism.outline_m
            for prism in prisms_of(world)
            if prism.bottom_m < height_m + half_height_m and prism.top_m > height_m - half_height_m
        ]
        ends = [(world.start.north_m, world.start.east_m), (world.goal.north_m, world.goal.east_m)]
        everything = np.concatenate([np.array(ends), *outlines])
        corner = everything.min(axis=0) - _MARGIN_M
        rows, columns = (
            np.ceil((everything.max(axis=0) + _MARGIN_M - corner) / side_m).astype(int) + 1
        ).tolist()
        # Corners in eighths of a cell (three binary digits).
        taken = np.zeros((rows, columns), dtype=np.uint8)
        for outline in outlines:
            pixels = np.round((outline - corner)[:, ::-1] / side_m * 8.0).astype(np.int32)
            cv2.fillConvexPoly(taken, pixels, 1, lineType=cv2.LINE_8, shift=3)
        distance = cv2.distanceTransform(1 - taken, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        # A thing may reach half a cell beyond the middle of a cell that is drawn.
        return cls(distance * side_m > radius_m + 0.5 * side_m, corner, side_m)

    def cell(self, point_m: tuple[float, float]) -> tuple[int, int]:
        row, column = np.round((np.array(point_m) - self.corner_m) / self.side_m).astype(int).tolist()
        return row, column

    def points_m(self, cells: NDArray[np.intp]) -> NDArray[np.float64]:
        return np.asarray(self.corner_m + self.side_m * cells)


def _shortest(
    free: NDArray[np.bool_], first: tuple[int, int], last: tuple[int, int]
) -> NDArray[np.intp] | None:
    """Return the cells (n, 2) of the shortest way, or None."""
    rows, columns = free.shape
    number = np.arange(free.size).reshape(free.shape)
    begins, ends, lengths = [], [], []
    for down, right in _STEPS:
        here = (slice(0, rows - down), slice(max(-right, 0), columns - max(right, 0)))
        there = (slice(down, rows), slice(max(right, 0), columns - max(-right, 0)))
        open_ = free[here] & free[there]
        begins.append(number[here][open_])
        ends.append(number[there][open_])
        lengths.append(np.full(begins[-1].size, math.hypot(down, right)))
    begin, end, length = np.concatenate(begins), np.concatenate(ends), np.concatenate(lengths)
    graph = coo_array((length, (begin, end)), shape=(free.size, free.size)).tocsr()
    source, target = int(number[first]), int(number[last])
    distances, before = dijkstra(graph, directed=False, indices=source, return_predecessors=True)
    if not np.isfinite(distances[target]):
        return None
    path = [target]
    while path[-1] != source:
        path.append(int(before[path[-1]]))
    return np.column_stack(np.unravel_index(path[::-1], free.shape))


def _pulled_straight(
    points: NDArray[np.float64], obstacles: Obstacles, down_m: float, radius_m: float, half_height_m: float
) -> NDArray[np.float64] | None:
    """Return the points left when each is followed by the farthest that can be flown to; None where none can."""
    kept = [0]
    while kept[-1] < len(points) - 1:
        here = points[kept[-1]]
        others = points[kept[-1] + 1 :] - here
        ways = np.hypot(others[:, 0], others[:, 1])
        free = obstacles.free_distances_m(
            (float(here[0]), float(here[1]), down_m),
            np.arctan2(others[:, 1], others[:, 0]),
            radius_m=radius_m,
            half_height_m=half_height_m,
            limit_m=float(ways.max()) + 1.0,
        )
        direct = np.flatnonzero(free >= ways)
        if not direct.size:
            return None
        kept.append(kept[-1] + 1 + int(direct[-1]))
    return points[kept]

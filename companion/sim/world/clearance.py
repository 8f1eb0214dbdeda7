"""How near things are to a vehicle, and how far it could go: exact, from the prisms of a world.

The vehicle is an upright cylinder. Between a cylinder and a prism, both upright, the distance is that of a disc and a
polygon in the plane and of two intervals in height, taken together.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from companion.sim.world.model import World
from companion.sim.world.prisms import Prism, prisms_of

VEHICLE_RADIUS_M: Final = 0.35
VEHICLE_HALF_HEIGHT_M: Final = 0.2
FREE_LIMIT_M: Final = 30.0

_PARALLEL = 1e-12
_Vector3 = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Obstacles:
    """The prisms of a world as arrays, one row an edge; make it with ``of``.

    Attributes
    ----------
    begin_m, along, length_m
        (n, 2), (n, 2), (n,): an edge's first corner, unit direction and length.
    outward
        (n, 2): unit normal, away from the prism.
    first_edge
        (m,): each prism's first row.
    bottom_m, top_m
        (m,): each prism's heights.
    ceiling_m
        Height of the ceiling, the one thing more that can be touched in flight.
    """

    begin_m: NDArray[np.float64]
    along: NDArray[np.float64]
    length_m: NDArray[np.float64]
    outward: NDArray[np.float64]
    first_edge: NDArray[np.intp]
    bottom_m: NDArray[np.float64]
    top_m: NDArray[np.float64]
    ceiling_m: float

    @classmethod
    def of(cls, world: World) -> Obstacles:
        """Return those of a world."""
        return cls.of_prisms(prisms_of(world), world.ceiling_m)

    @classmethod
    def of_prisms(cls, prisms: tuple[Prism, ...], ceiling_m: float = math.inf) -> Obstacles:
        """Return those of some prisms."""
        outlines = [prism.outline_m for prism in prisms]
        begin = np.concatenate([np.empty((0, 2)), *outlines])
        end = np.concatenate([np.empty((0, 2)), *(np.roll(outline, -1, axis=0) for outline in outlines)])
        length = np.hypot(*(end - begin).T)
        along = (end - begin) / length[:, None]
        counts = np.array([len(outline) for outline in outlines], dtype=np.intp)
        return cls(
            begin_m=begin,
            along=along,
            length_m=length,
            # Corners go clockwise as seen from above, so the outside is to the left.
            outward=np.column_stack([along[:, 1], -along[:, 0]]),
            first_edge=np.asarray(np.cumsum(counts) - counts, dtype=np.intp),
            bottom_m=np.array([prism.bottom_m for prism in prisms], dtype=np.float64),
            top_m=np.array([prism.top_m for prism in prisms], dtype=np.float64),
            ceiling_m=ceiling_m,
        )

    def clearance_m(
        self,
        position_ned_m: _Vector3,
        *,
        radius_m: float = VEHICLE_RADIUS_M,
        half_height_m: float = VEHICLE_HALF_HEIGHT_M,
    ) -> float:
        """Return the distance from the vehicle's hull to the nearest prism or the ceiling.

        Parameters
        ----------
        position_ned_m
            The vehicle's middle, local NED.
        radius_m, half_height_m
            Of the vehicle's cylinder.

        Returns
        -------
        Metres; 0 or less where it touches, then the least way out. Infinite where there is nothing.
        The floor does not count: a vehicle stands on it.
        """
        height_m = -position_ned_m[2]
        under_ceiling_m = self.ceiling_m - height_m - half_height_m
        if not self.first_edge.size:
            return under_ceiling_m
        beside_m = self._horizontal_m(position_ned_m) - radius_m
        above_m = np.maximum(self.bottom_m - height_m, height_m - self.top_m) - half_height_m
        apart_m = np.hypot(np.maximum(beside_m, 0.0), np.maximum(above_m, 0.0))
        both = np.maximum(beside_m, above_m)
        return min(float(np.where(both > 0.0, apart_m, both).min()), under_ceiling_m)

    def collides(
        self,
        position_ned_m: _Vector3,
        *,
        radius_m: float = VEHICLE_RADIUS_M,
        half_height_m: float = VEHICLE_HALF_HEIGHT_M,
    ) -> bool:
        """Return whether the vehicle touches a prism or the ceiling; parameters as for ``clearance_m``."""
        return self.clearance_m(position_ned_m, radius_m=radius_m, half_height_m=half_height_m) <= 0.0

    def free_distances_m(
        self,
        position_ned_m: _Vector3,
        azimuths_rad: ArrayLike,
        *,
        radius_m: float = VEHICLE_RADIUS_M,
        half_height_m: float = VEHICLE_HALF_HEIGHT_M,
        limit_m: float = FREE_LIMIT_M,
    ) -> NDArray[np.float64]:
        """Return how far the vehicle could go level and straight ahead until it touches something.

        Parameters
        ----------
        position_ned_m
            The vehicle's middle, local NED.
        azimuths_rad
            (k,), directions, clockwise from north.
        radius_m, half_height_m
            Of the vehicle's cylinder.
        limit_m
            The most that is answered.

        Returns
        -------
        (k,) float64, m. All 0 where it touches a prism already.
        """
        azimuths = np.asarray(azimuths_rad, dtype=np.float64)
        height_m = -position_ned_m[2]
        # What lies wholly above or below cannot be touched on the level.
        tall = (self.bottom_m < height_m + half_height_m) & (self.top_m > height_m - half_height_m)
        if not tall.any():
            return np.full(azimuths.shape, limit_m)
        if float(self._horizontal_m(position_ned_m)[tall].min()) <= radius_m:
            return np.zeros(azimuths.shape)
        rows = np.repeat(tall, np.diff(self.first_edge, append=self.length_m.size))
        # Beyond the limit nothing matters; a corner of every edge near enough is within its length more.
        offset = self.begin_m - np.array(position_ned_m[:2])
        rows &= np.hypot(offset[:, 0], offset[:, 1]) <= limit_m + radius_m + self.length_m
        directions = np.column_stack([np.cos(azimuths), np.sin(azimuths)])
        hit = np.minimum(
            _sides_m(
                offset[rows], self.along[rows], self.length_m[rows], self.outward[rows], directions, radius_m
            ),
            _corners_m(offset[rows], directions, radius_m),
        )
        return np.asarray(np.minimum(hit, limit_m))

    def free_distance_m(
        self,
        position_ned_m: _Vector3,
        azimuth_rad: float,
        *,
        radius_m: float = VEHICLE_RADIUS_M,
        half_height_m: float = VEHICLE_HALF_HEIGHT_M,
        limit_m: float = FREE_LIMIT_M,
    ) -> float:
        """Return ``free_distances_m`` in one direction."""
        free = self.free_distances_m(
            position_ned_m, [azimuth_rad], radius_m=radius_m, half_height_m=half_height_m, limit_m=limit_m
        )
        return float(free[0])

    def _horizontal_m(self, position_ned_m: _Vector3) -> NDArray[np.float64]:
        """Return (m,) signed distances in plan from a point to each prism's outline, negative inside."""
        offset = np.array(position_ned_m[:2]) - self.begin_m
        reach = np.clip((offset * self.along).sum(axis=1), 0.0, self.length_m)
        to_edge = np.hypot(*(offset - reach[:, None] * self.along).T)
        outside = np.maximum.reduceat((offset * self.outward).sum(axis=1), self.first_edge)
        nearest = np.minimum.reduceat(to_edge, self.first_edge)
        return np.asarray(np.where(outside > 0.0, nearest, outside))


def _sides_m(
    offset: NDArray[np.float64],
    along: NDArray[np.float64],
    length_m: NDArray[np.float64],
    outward: NDArray[np.float64],
    directions: NDArray[np.float64],
    radius_m: float,
) -> NDArray[np.float64]:
    """Return (k,) the least way until the disc touches the inside of an edge; infinite where it never does."""
    approach = -(directions @ outward.T)  # (k, n): above 0 where the disc comes nearer
    gap = -(offset * outward).sum(axis=1) - radius_m  # (n,): from the disc to the edge's line
    with np.errstate(divide="ignore", invalid="ignore"):
        way = gap / approach
        foot = way * (directions @ along.T) - (offset * along).sum(axis=1)
    touches = (approach > _PARALLEL) & (gap >= 0.0) & (foot >= 0.0) & (foot <= length_m)
    return np.asarray(np.where(touches, way, math.inf).min(axis=1, initial=math.inf))


def _corners_m(
    offset: NDArray[np.float64], directions: NDArray[np.float64], radius_m: float
) -> NDArray[np.float64]:
    """Return (k,) the least way until the disc touches a corner; infinite where it never does."""
    ahead = directions @ offset.T  # (k, n)
    inside = ahead**2 - (offset**2).sum(axis=1) + radius_m**2
    touches = (ahead > 0.0) & (inside >= 0.0)
    way = ahead - np.sqrt(np.where(touches, inside, 0.0))
    return np.asarray(np.where(touches, way, math.inf).min(axis=1, initial=math.inf))

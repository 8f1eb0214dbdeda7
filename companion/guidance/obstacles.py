"""Obstacles seen nearby, remembered in local NED: what has left the camera's view is still there."""

from __future__ import annotations

import math
from dataclasses import dataclass

from companion.guidance.coordinates import wrap_rad
from companion.guidance.observation import DetectionReport, Pose

_CELL_M = 0.2
_SIGHTINGS = 2
"""Reports that must have seen a cell: one alone may have followed a wrong point."""
_MOST_SIGHTINGS = 4
"""More are not counted: what was seen wrongly for a while can be seen to be free again."""
_THROUGH_RAD = math.radians(2.0)
_BEYOND_M = 0.4
_SEEN_WHOLE_M = 1.2
"""Nearer than this the camera sees a part of a thing at most, and past it: that says nothing of the rest."""
_FORGET_M = 5.0
_FORGET_NS = 60_000_000_000
_CLOSING = 0.9
"""A way that brings the vehicle no nearer than this share of the present distance does not approach."""


_AHEAD_M = 1.5
_ROOM_M = 0.8
_SIDESTEP_RAD = math.radians(3.0)
_ROOM_PER_RAD_M = 0.4
"""A deviation of one radian must bring this much more room."""


@dataclass(slots=True)
class _Cell:
    north_m: float
    east_m: float
    sightings: int
    seen_ns: int


class NearObstacles:
    """Cells of 0.2 m in which something was seen within a few metres.

    A camera loses what it passes: the edge of a wall beside the vehicle is out of view just when it matters. A cell
    is forgotten after a minute, or when the vehicle is 5 m away (the estimate drifts).

    Parameters
    ----------
    half_width_m
        Half of what must fit between two cells.
    """

    def __init__(self, half_width_m: float) -> None:
        self._half_width_m = half_width_m
        self._cells: dict[tuple[int, int], _Cell] = {}

    def clear(self) -> None:
        """Forget everything."""
        self._cells.clear()

    def add(self, report: DetectionReport) -> None:
        """Take what one report saw nearby; a cell in the middle of a way that it measured free loses a sighting."""
        seen: set[tuple[int, int]] = set()
        for north_m, east_m in report.obstacles:
            key = (math.floor(north_m / _CELL_M), math.floor(east_m / _CELL_M))
            seen.add(key)
            cell = self._cells.get(key)
            sightings = 1 if cell is None else min(cell.sightings + 1, _MOST_SIGHTINGS)
            self._cells[key] = _Cell(north_m, east_m, sightings, report.frame_ns)
        if report.pose is None:
            return
        for key, cell in list(self._cells.items()):
            if key not in seen and _sees_through(report, report.pose, cell):
                cell.sightings -= 1
                if cell.sightings <= 0:
                    del self._cells[key]

    def free_m(self, azimuth_rad: float, pose: Pose, now_ns: int) -> float | None:
        """Return how far the vehicle can go along an azimuth before it meets a remembered obstacle.

        None where none stands in the way. An obstacle that the vehicle is already beside does not count unless the
        way leads nearer to it.
        """
        self._forget(pose, now_ns)
        cos, sin = math.cos(azimuth_rad), math.sin(azimuth_rad)
        nearest: float | None = None
        for cell in self._cells.values():
            if cell.sightings < _SIGHTINGS:
                continue
            north_m, east_m = cell.north_m - pose.north_m, cell.east_m - pose.east_m
            along_m = north_m * cos + east_m * sin
            beside_m = abs(east_m * cos - north_m * sin)
            if along_m <= 0.0 or beside_m >= self._half_width_m:
                continue
            if beside_m >= _CLOSING * math.hypot(north_m, east_m):
                continue
            nearest = along_m if nearest is None else min(nearest, along_m)
        return nearest

    def clearer(self, azimuth_rad: float, pose: Pose, now_ns: int) -> tuple[float, float]:
        """Return the azimuth near a wanted one that keeps most room beside remembered obstacles, and that room.

        A doorway's frame is out of view while the vehicle passes it; between two remembered edges this is the middle.

        Parameters
        ----------
        azimuth_rad
            The wanted one.
        pose
            The vehicle's.
        now_ns
            Our monotonic time.

        Returns
        -------
        The azimuth (rad), at most 21 degrees from the wanted one, and the least distance (m) from its line to an obstacle
        within the next 1.5 m, at most 0.8 m.
        """
        self._forget(pose, now_ns)
        near = [
            (cell.north_m - pose.north_m, cell.east_m - pose.east_m)
            for cell in self._cells.values()
            if cell.sightings >= _SIGHTINGS
            and math.hypot(cell.north_m - pose.north_m, cell.east_m - pose.east_m) <= _AHEAD_M + _ROOM_M
        ]

        def room_m(azimuth: float) -> float:
            cos, sin = math.cos(azimuth), math.sin(azimuth)
            least = _ROOM_M
            for north_m, east_m in near:
                along_m = north_m * cos + east_m * sin
                if 0.0 < along_m <= _AHEAD_M:
                    least = min(least, abs(east_m * cos - north_m * sin))
            return least

        wanted_m = room_m(azimuth_rad)
        if wanted_m >= _ROOM_M:
            return azimuth_rad, wanted_m
        offers = [
            azimuth_rad + math.copysign(step * _SIDESTEP_RAD, side)
            for step in range(1, 8)
            for side in (1, -1)
        ]
        rooms = [(wanted_m, azimuth_rad), *((room_m(offer), offer) for offer in offers)]
        # The nearest azimuth wins unless another gives clearly more room for its deviation.
        best_m, best = max(rooms, key=lambda r: r[0] - _ROOM_PER_RAD_M * abs(r[1] - azimuth_rad))
        return best, best_m

    def _forget(self, pose: Pose, now_ns: int) -> None:
        here = (pose.north_m, pose.east_m)
        self._cells = {
            key: cell
            for key, cell in self._cells.items()
            if now_ns - cell.seen_ns <= _FORGET_NS
            and math.dist(here, (cell.north_m, cell.east_m)) <= _FORGET_M
        }


def _sees_through(report: DetectionReport, pose: Pose, cell: _Cell) -> bool:
    """Whether a report measured the way free to clearly beyond a cell."""
    north_m, east_m = cell.north_m - pose.north_m, cell.east_m - pose.east_m
    distance_m, azimuth = math.hypot(north_m, east_m), math.atan2(east_m, north_m)
    return distance_m >= _SEEN_WHOLE_M and any(
        abs(wrap_rad(bearing.azimuth_rad - azimuth)) <= _THROUGH_RAD
        and bearing.distance_m - bearing.spread_m >= distance_m + _BEYOND_M
        for bearing in report.bearings
    )

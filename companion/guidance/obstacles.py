"""Obstacles seen nearby, remembered in local NED: what has left the camera's view is still there."""

from __future__ import annotations

import math
from dataclasses import dataclass

from companion.guidance.observation import DetectionReport, Pose

_CELL_M = 0.2
_SIGHTINGS = 2
"""Reports that must have seen a cell: one alone may have followed a wrong point."""
_FORGET_M = 5.0
_FORGET_NS = 60_000_000_000
_CLOSING = 0.9
"""A way that brings the vehicle no nearer than this share of the present distance does not approach."""


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
        """Take what one report saw nearby."""
        for north_m, east_m in report.obstacles:
            key = (math.floor(north_m / _CELL_M), math.floor(east_m / _CELL_M))
            cell = self._cells.get(key)
            sightings = 1 if cell is None else cell.sightings + 1
            self._cells[key] = _Cell(north_m, east_m, sightings, report.frame_ns)

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

    def _forget(self, pose: Pose, now_ns: int) -> None:
        here = (pose.north_m, pose.east_m)
        self._cells = {
            key: cell
            for key, cell in self._cells.items()
            if now_ns - cell.seen_ns <= _FORGET_NS
            and math.dist(here, (cell.north_m, cell.east_m)) <= _FORGET_M
        }

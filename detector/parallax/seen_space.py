"""The floor plan of what was looked through: a place is flown into only where several pairs in a row saw past it, or where the vehicle has been.

The void map says how far the vehicle's disc gets before it meets something that was *measured*. Two things it cannot say: what stands beside the picture's edge, where the disc's
shoulder would touch it, and what stands where nothing was measured at all (a plain wall beside a doorway). Here every pair marks the places that it surely looked past, in cells of
the local frame; the disc is then swept through the cells, and its way ends where it would cover more of what nobody looked through than half of a thing that must show.
"""

from __future__ import annotations

import math
from typing import Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from detector.parallax.coverage import looked_past
from detector.parallax.samples import RangedSamples
from detector.parallax.void_map import VoidMapParams

_Kind = TypeVar("_Kind", bound=np.generic)

CELL_M: Final = 0.1
"""A quarter of the narrowest vehicle's radius: the disc's edge is known to half of it."""
HALF_WIDTH_M: Final = 4.0
"""What is further from the vehicle is forgotten: a minute's flight drifts by less than a cell on the way there."""
LOOKS: Final = 3
"""Pairs in a row that must have looked past a place: fine, even texture near by matches at a wrong place, but hardly thrice."""
LOOK_APART_S: Final = 0.15
"""Pairs nearer in time than this are one look: they share nearly all of their pictures."""
KEPT_S: Final = 60.0
"""As obstacles seen nearby: by then the local frame has drifted by a cell."""
_BEEN_SHARE: Final = 0.8
"""Of the swept radius: where the vehicle itself has been. The rest of it is the margin."""
WAYS: Final = 120
"""Azimuths that are told, three degrees apart, from the level frame's x axis."""
_ZONES: Final = 3
_SIDE_FACTOR: Final = 1.4
"""Beside the way so much more may be unseen: a camera of 75 degrees never sees the two crescents that the disc sweeps right beside it as it sets off (0.03 m^2 each)."""


class SeenSpace:
    """Cells of one local frame that were looked through; all in metres.

    Parameters
    ----------
    params
        The vehicle, and what could be hidden.
    """

    def __init__(self, params: VoidMapParams) -> None:
        self._params = params
        self._radius_m = params.radius_m + 0.5 * CELL_M
        self._cells = 2 * round(HALF_WIDTH_M / CELL_M)
        self._corner = (0, 0)
        self._looks = np.zeros((self._cells, self._cells), np.int8)
        self._seen_s = np.full((self._cells, self._cells), -math.inf)
        self._looked_s = -math.inf
        self._most_cells = 0.5 * math.pi * (0.5 * params.hidden_width_m / CELL_M) ** 2
        self._sweep, self._zone_starts, self._steps = _sweep(
            self._cells, self._radius_m, params.covered_m, 0.5 * params.hidden_width_m
        )

    def forget(self) -> None:
        """Forget everything: the local frame is another one."""
        self._looks[:] = 0
        self._seen_s[:] = -math.inf
        self._looked_s = -math.inf

    def been(self, position_m: tuple[float, float], time_s: float) -> None:
        """Take note of where the vehicle is: nothing else stands there."""
        self._recentre(position_m)
        here = self._away_m(position_m) <= _BEEN_SHARE * self._params.radius_m
        self._looks[here] = LOOKS
        self._seen_s[here] = time_s

    def missed(self) -> None:
        """Take a pair that should have shown something and did not: what was about to be known is not."""
        self._looks[self._looks < LOOKS] = 0

    def look(self, samples: RangedSamples, position_m: tuple[float, float], time_s: float) -> None:
        """Take one pair.

        Parameters
        ----------
        samples
            In metres, in the level frame.
        position_m
            North and east of the later camera.
        time_s
            Of the later frame, any origin.
        """
        if time_s - self._looked_s < LOOK_APART_S:
            return
        self._looked_s = time_s
        self._recentre(position_m)
        params = self._params
        most_m = params.covered_m + self._radius_m + 2 * CELL_M
        rings_m = np.asarray(np.arange(1, math.ceil(most_m / CELL_M) + 1) * CELL_M, np.float64)
        past = looked_past(samples, rings_m, params.hidden_width_m, params.half_height_m)
        north_m, east_m = self._offsets_m(position_m)
        away_m = np.hypot(north_m, east_m)
        ring = np.minimum(np.asarray(away_m / CELL_M, np.intp), len(rings_m) - 1)
        fine = past.shape[1]
        azimuth = np.asarray(np.rint(np.arctan2(east_m, north_m) * fine / math.tau), np.intp) % fine
        seen = (away_m < most_m) & past[ring, azimuth]
        self._looks[seen] = np.minimum(self._looks[seen] + 1, LOOKS)
        self._seen_s[seen] = time_s

    def reach_m(self, position_m: tuple[float, float], time_s: float) -> NDArray[np.float64]:
        """Return how far (``WAYS``,) the disc can be moved along each azimuth through places that were looked through.

        No more than ``covered_m``, which stands for "at least so far".
        """
        self._recentre(position_m)
        seen = (self._looks >= LOOKS) & (time_s - self._seen_s <= KEPT_S)
        # The sweep begins at the middle of the vehicle's cell; where its disc is already, it does not come.
        middle = tuple((math.floor(place / CELL_M) + 0.5) * CELL_M for place in position_m)
        unseen = ~seen & (self._away_m((middle[0], middle[1])) > self._radius_m + 0.5 * CELL_M)
        hidden = np.add.reduceat(unseen.ravel()[self._sweep], self._zone_starts, dtype=np.intp)
        most = self._most_cells * np.array([_SIDE_FACTOR, _SIDE_FACTOR, 1.0])
        blocked = np.any(np.asarray(hidden).reshape(WAYS, self._steps, _ZONES) > most, axis=2)
        first = np.where(blocked.any(axis=1), np.argmax(blocked, axis=1), self._steps)
        return np.asarray(first * CELL_M, np.float64)

    def _offsets_m(self, position_m: tuple[float, float]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return (N, 1) and (1, N): north and east of the cells' middles from a place."""
        middles = (np.arange(self._cells) + 0.5) * CELL_M
        north_m = middles + self._corner[0] * CELL_M - position_m[0]
        east_m = middles + self._corner[1] * CELL_M - position_m[1]
        return np.asarray(north_m[:, None], np.float64), np.asarray(east_m[None, :], np.float64)

    def _away_m(self, position_m: tuple[float, float]) -> NDArray[np.float64]:
        return np.asarray(np.hypot(*self._offsets_m(position_m)))

    def _recentre(self, position_m: tuple[float, float]) -> None:
        """Move the window along with the vehicle, by whole cells."""
        half = self._cells // 2
        corner = (math.floor(position_m[0] / CELL_M) - half, math.floor(position_m[1] / CELL_M) - half)
        north, east = corner[0] - self._corner[0], corner[1] - self._corner[1]
        if north == 0 and east == 0:
            return
        self._corner = corner
        if max(abs(north), abs(east)) >= self._cells:
            self._looks[:] = 0
            self._seen_s[:] = -math.inf
            return
        self._looks = _moved(self._looks, north, east, 0)
        self._seen_s = _moved(self._seen_s, north, east, -math.inf)


def _sweep(
    cells: int, radius_m: float, most_m: float, half_hidden_m: float
) -> tuple[NDArray[np.intp], NDArray[np.intp], int]:
    """Return the cells that the disc covers at each step of each way from the window's middle, by zone.

    Returns
    -------
    cells
        Indices into the window, flat; those of one zone (left of the way, right of it, its middle) follow each other.
    starts
        (``WAYS`` * steps * 3,) where each zone begins.
    steps
        Of one cell each.
    """
    azimuth = np.arange(WAYS) * (math.tau / WAYS)
    steps = round(most_m / CELL_M)
    reach = math.ceil(radius_m / CELL_M) + 1
    near = np.arange(-reach, reach + 1)
    offset = np.stack(np.meshgrid(near, near, indexing="ij"), axis=-1).reshape(-1, 2)
    found: list[NDArray[np.intp]] = []
    for heading in np.column_stack([np.cos(azimuth), np.sin(azimuth)]):
        for step in range(1, steps + 1):
            middle = step * heading
            cell = np.rint(middle) + offset
            off = (cell - middle) * CELL_M
            beside_m = off[:, 1] * heading[0] - off[:, 0] * heading[1]
            inside = np.hypot(off[:, 0], off[:, 1]) <= radius_m
            flat = np.asarray((cell[:, 0] + cells // 2) * cells + cell[:, 1] + cells // 2, np.intp)
            found += [
                flat[inside & zone]
                for zone in (beside_m > 0.0, beside_m < 0.0, np.abs(beside_m) <= half_hidden_m)
            ]
    sizes = np.array([len(one) for one in found])
    return np.concatenate(found), np.asarray(np.cumsum(sizes) - sizes, np.intp), steps


def _moved(cells: NDArray[_Kind], north: int, east: int, nothing: float) -> NDArray[_Kind]:
    """Return the window after its corner went north and east by so many cells; what came in is ``nothing``."""
    moved = np.full_like(cells, nothing)
    rows, columns = cells.shape
    moved[max(0, -north) : rows - max(0, north), max(0, -east) : columns - max(0, east)] = cells[
        max(0, north) : rows - max(0, -north), max(0, east) : columns - max(0, -east)
    ]
    return moved

"""What of the map may be flown: beside the map that answers, one of what was really looked through.

The furthest direction is chosen on the whole map: ways with a gap between their samples are mostly free. But something near could stand in such a gap
(a smooth pillar, the plain end of a wall), and what was seen there before is no longer measured when it comes near the edge of the picture. So a way counts
no further than it was looked through, and where a profile did not look through a direction, one that did is remembered.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from detector.parallax.coverage import uncovered_from_m
from detector.parallax.map_memory import MapMemory, MapMemoryParams
from detector.parallax.samples import RangedSamples
from detector.parallax.void_map import BINS, VoidMap, VoidMapParams


class SureMap:
    """Remembers the profiles of what was looked through; all in one local frame, in metres.

    Parameters
    ----------
    map_params
        The vehicle, and what could be hidden.
    memory_params
        How long profiles count.
    """

    def __init__(self, map_params: VoidMapParams, memory_params: MapMemoryParams | None = None) -> None:
        self._params = map_params
        self._memory = MapMemory(memory_params)

    def forget(self) -> None:
        """Forget everything: the local frame is another one, or the scene is."""
        self._memory.forget()

    def add(
        self,
        measured: VoidMap,
        samples: RangedSamples,
        remembered: VoidMap,
        position_m: tuple[float, float],
        time_s: float,
    ) -> VoidMap:
        """Take one pair and return what may be flown.

        Parameters
        ----------
        measured, samples
            The map of the pair and what it was made from.
        remembered
            What the last pairs say together, gaps or no gaps.
        position_m, time_s
            As :meth:`detector.parallax.map_memory.MapMemory.add` takes them.

        Returns
        -------
        In view, the whole map's distance, but no further than this pair looked through the direction, or an earlier one did: what that saw there counts
        until it is looked through again. Out of view, what was looked through. A limit has the distance's uncertainty added, for that is taken off again before a
        way is flown.
        """
        limit_m = looked_through_m(samples, self._params)
        self._memory.add(measured.where(measured.free_m <= limit_m), position_m, time_s)
        before = self._memory.remembered(position_m, time_s).found
        in_view = remembered.known & measured.known
        sigma_m = np.where(remembered.known, remembered.sigma_m, 0.0)
        sure_m = np.where(before.known, before.free_m - before.sigma_m, -np.inf)
        whole = in_view & (remembered.free_m - sigma_m <= np.maximum(sure_m, limit_m))
        limited = in_view & ~whole & (sure_m < limit_m)
        return VoidMap(
            before.azimuth_rad,
            np.where(whole, remembered.free_m, np.where(limited, limit_m + sigma_m, before.free_m)),
            np.where(whole | limited, remembered.count, before.count),
            np.where(whole | limited, remembered.sigma_m, before.sigma_m),
            np.asarray(before.known | in_view, np.bool_),
        )


def looked_through_m(samples: RangedSamples, params: VoidMapParams) -> NDArray[np.float64]:
    """Return how far each direction (M,) can be flown before something could stand in the way unseen, infinite where nothing could.

    Parameters
    ----------
    samples
        In metres.
    params
        ``hidden_width_m``, ``covered_m`` and the vehicle.
    """
    if params.covered_m == 0.0:
        return np.full(BINS, np.inf)
    hidden_from_m = uncovered_from_m(
        samples,
        VoidMap.unknown().azimuth_rad,
        params.radius_m,
        params.hidden_width_m,
        params.covered_m,
        math.radians(params.known_elevation_deg),
    )
    return np.asarray(hidden_from_m - params.radius_m)

"""What of the map may be flown: what was seen near is still there when it shows no longer, and steps are short where nothing was looked through.

The furthest direction is chosen on the whole map: ways with a gap between their samples are mostly free. But something near could stand in such a gap
(a smooth pillar, the plain end of a wall), and what was seen there before is no longer measured when it comes near the edge of the picture. So near things are remembered
until a pair looks through the place where they stood. And where most of the picture is plain (``plain_share``, off by default), no direction is told further than the last pair looked
through: there, what stands in a gap shows nowhere else either. What several pairs looked through, and limits each step, is in :mod:`detector.parallax.seen_space`.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from detector.parallax.coverage import uncovered_from_m
from detector.parallax.map_memory import MapMemory, MapMemoryParams
from detector.parallax.samples import RangedSamples
from detector.parallax.void_map import BINS, VoidMap, VoidMapParams, bin_of

_AGREE: Final = 1.25
"""What is remembered as near must not be much nearer than the last pairs say together: one of them may be wild."""
_SURE_SHARE: Final = 0.25
"""Of its distance: what is known less well is not remembered as near."""


class SureMap:
    """Remembers what was seen near; all in one local frame, in metres.

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
            What the last pairs say together.
        position_m, time_s
            As :meth:`detector.parallax.map_memory.MapMemory.add` takes them.

        Returns
        -------
        The remembered map, shortened to what was seen near there before and not looked through since; and in view, where the picture is plain, to what this pair looked through.
        To that limit the distance's uncertainty is added, for it is taken off again before a way is flown.
        """
        looked_m = looked_through_m(samples, self._params)
        is_near = measured.free_m <= np.minimum(looked_m, self._params.covered_m)
        is_near &= measured.sigma_m <= _SURE_SHARE * (measured.free_m + self._params.radius_m)
        is_near &= remembered.free_m <= _AGREE * measured.free_m
        self._memory.add(measured.where(is_near), position_m, time_s)
        near = self._memory.remembered(position_m, time_s).found

        in_view = remembered.known & measured.known
        sigma_m = np.where(remembered.known, remembered.sigma_m, 0.0)
        most_m = looked_m if self._is_plain(measured, samples) else np.full(BINS, np.inf)
        shortened = np.where(in_view, np.minimum(remembered.free_m, most_m + sigma_m), remembered.free_m)
        refuted = in_view & (looked_m > near.free_m)
        low_m = np.where(remembered.known, shortened - sigma_m, np.inf)
        stands = near.known & ~refuted & (near.free_m - np.where(near.known, near.sigma_m, 0.0) < low_m)
        return VoidMap(
            remembered.azimuth_rad,
            np.where(stands, near.free_m, shortened),
            np.where(stands, near.count, remembered.count),
            np.where(stands, near.sigma_m, remembered.sigma_m),
            np.asarray(remembered.known | stands, np.bool_),
        )

    def _is_plain(self, measured: VoidMap, samples: RangedSamples) -> bool:
        """Return whether less than the wanted share of the directions in the picture is known."""
        rays = samples.rays_level
        level = np.abs(rays[:, 2]) <= math.sin(math.radians(self._params.known_elevation_deg))
        seen = np.unique(bin_of(np.arctan2(rays[level, 1], rays[level, 0])))
        return seen.size > 0 and float(measured.known[seen].mean()) < self._params.plain_share


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

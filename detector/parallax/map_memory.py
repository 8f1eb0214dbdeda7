"""Memory of void maps: the last profiles, carried along by the pose, so that one bad pair does not swing the vehicle and a turn does not forget.

Each profile is the border of what the vehicle's middle could reach from where it was measured. Seen from another place the same border lies at other
azimuths and distances, so its points are moved, not its numbers. What several profiles say of a bin is settled by the weighted median
of the *inverse* distances: those have a normal error, and one wild profile does not move a median. A profile weighs less the farther the vehicle has flown since, and
the older it is; a turn alone takes nothing from it, because azimuths are those of the world.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Annotated, Final

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from detector.parallax.void_map import (
    BINS,
    Gap,
    VoidMap,
    VoidMapParams,
    bin_azimuths_rad,
    bin_of,
    choose_gap,
    gap_about,
    smoothed_profile,
)

_LEAST_WEIGHT: Final = 0.05
_NEAREST_M: Final = 0.05
"""Distances below this count as this: their inverse would be without bounds."""
_SPLAT_GAP: Final = 3
"""Neighbouring points of a border that move apart by up to so many bins still hold together."""


class MapMemoryParams(BaseModel):
    """How long profiles count, and how firmly an answer is kept."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    profiles: Annotated[
        int,
        Field(
            ge=1,
            le=50,
            description="Newest profiles whose median is taken. Larger: steadier, slower to notice.",
        ),
    ] = 4
    kept: Annotated[
        int,
        Field(
            ge=1,
            le=500,
            description="Profiles kept for directions that the newest ones did not see. Larger: a turn forgets less.",
        ),
    ] = 24
    fade_distance_m: Annotated[
        float,
        Field(
            gt=0,
            le=50,
            description="A profile weighs 1/e after the vehicle has flown so far. Larger: older views count more, and so does the drift of the pose.",
        ),
    ] = 1.5
    fade_s: Annotated[
        float,
        Field(gt=0, le=600, description="The same for its age. Larger: what moves is noticed later."),
    ] = 8.0
    apart_m: Annotated[
        float,
        Field(
            ge=0,
            le=5,
            description="A profile taken nearer than this to the last one kept, with the same view, replaces it in what is kept for long. Larger: longer memory, coarser.",
        ),
    ] = 0.1
    same_share: Annotated[
        float,
        Field(
            gt=0,
            le=1,
            description="Profiles agree on a direction where their distances differ by less than this share. Larger: more agreement, less meaning.",
        ),
    ] = 0.25
    keep_share: Annotated[
        float,
        Field(
            gt=0,
            le=1,
            description="The last answer is kept while it is free for this share of the furthest. Smaller: steadier, further from the best.",
        ),
    ] = 0.8
    same_gap_deg: Annotated[
        float,
        Field(
            gt=0,
            le=90,
            description="A new middle within this angle of the last answer is the same gap: it is followed at once.",
        ),
    ] = 12.0


@dataclass(frozen=True, slots=True)
class RememberedMap:
    """What the profiles say together.

    Attributes
    ----------
    found
        The map from where the vehicle is now. ``sigma_m`` holds the scatter between the profiles too.
    profiles
        (M,) how many of the newest profiles know each bin.
    agreeing
        (M,) how many of them agree with the median.
    """

    found: VoidMap
    profiles: NDArray[np.intp]
    agreeing: NDArray[np.intp]


@dataclass(frozen=True, slots=True)
class _Profile:
    found: VoidMap
    north_m: float
    east_m: float
    time_s: float


class MapMemory:
    """Keeps the last profiles; all in one local frame.

    Parameters
    ----------
    params
        How long they count.
    """

    def __init__(self, params: MapMemoryParams | None = None) -> None:
        self._params = params or MapMemoryParams()
        self._newest: deque[_Profile] = deque(maxlen=self._params.profiles)
        self._older: deque[_Profile] = deque(maxlen=self._params.kept)
        self._answer_rad: float | None = None

    def forget(self) -> None:
        """Forget everything: the local frame is another one, or the scene is."""
        self._newest.clear()
        self._older.clear()
        self._answer_rad = None

    def __len__(self) -> int:
        return len(self._newest) + len(self._older)

    def add(self, found: VoidMap, position_m: tuple[float, float], time_s: float) -> None:
        """Take the map of one pair.

        Parameters
        ----------
        found
            In metres; its azimuths are those of the local frame.
        position_m
            North and east of the camera, the later frame's.
        time_s
            Of the later frame, any origin.
        """
        if not found.metric:
            raise ValueError("expected a map in metres: without the scale it cannot be carried along")
        if not found.known.any():
            return
        if len(self._newest) == self._newest.maxlen:
            self._retire(self._newest[0])
        self._newest.append(_Profile(found, *position_m, time_s))

    def _retire(self, profile: _Profile) -> None:
        def is_another(other: _Profile) -> bool:
            near = math.dist((other.north_m, other.east_m), (profile.north_m, profile.east_m))
            shared = np.count_nonzero(other.found.known & profile.found.known)
            known = np.count_nonzero(other.found.known)
            return near >= self._params.apart_m or bool(shared < 0.8 * known)

        kept = [other for other in self._older if is_another(other)]
        self._older.clear()
        self._older.extend([*kept, profile])

    def remembered(self, position_m: tuple[float, float], time_s: float) -> RememberedMap:
        """Return what the profiles say together, from a place at a time.

        Parameters
        ----------
        position_m
            North and east, where the vehicle is.
        time_s
            Now, as :meth:`add` takes it.
        """
        newest = [self._carried(profile, position_m, time_s) for profile in self._newest]
        merged = _merged(
            [(found, weight) for found, weight in newest if weight >= _LEAST_WEIGHT], self._params
        )
        missing = ~merged.found.known
        # What the newest views do not show was there when it was last seen, the newest first.
        for profile in reversed(self._older):
            if not missing.any():
                break
            found, weight = self._carried(profile, position_m, time_s)
            if weight < _LEAST_WEIGHT:
                continue
            take = missing & found.known
            merged = RememberedMap(
                _overlaid(merged.found, found, take),
                np.where(take, 1, merged.profiles),
                np.where(take, 1, merged.agreeing),
            )
            missing &= ~take
        return merged

    def answer(self, found: VoidMap, params: VoidMapParams, *, wanted_rad: float | None = None) -> Gap | None:
        """Return the gap to fly to, with hysteresis: the last one while it is still nearly the best.

        Parameters
        ----------
        found
            What is remembered.
        params
            Of the choice.
        wanted_rad
            As :func:`detector.parallax.void_map.choose_gap` takes it.
        """
        best = choose_gap(found, params, wanted_rad=wanted_rad)
        last = self._answer_rad
        if best is not None and last is not None and params.preference == "furthest":
            apart = abs((best.azimuth_rad - last + math.pi) % math.tau - math.pi)
            if apart > math.radians(self._params.same_gap_deg):
                smooth = smoothed_profile(found, params)
                index = found.at(last)
                if smooth[index] >= self._params.keep_share * float(smooth.max()):
                    best = gap_about(found, index, smooth, params)
        self._answer_rad = None if best is None else best.azimuth_rad
        return best

    def _carried(
        self, profile: _Profile, position_m: tuple[float, float], time_s: float
    ) -> tuple[VoidMap, float]:
        north_m, east_m = position_m[0] - profile.north_m, position_m[1] - profile.east_m
        moved_m, age_s = math.hypot(north_m, east_m), max(0.0, time_s - profile.time_s)
        weight = math.exp(-moved_m / self._params.fade_distance_m - age_s / self._params.fade_s)
        return carried(profile.found, north_m, east_m), weight


def carried(found: VoidMap, north_m: float, east_m: float) -> VoidMap:
    """Return a map as it is from another place: the border of its free area, moved.

    Parameters
    ----------
    found
        In metres.
    north_m, east_m
        From where it was measured to the other place, along the level frame's x and y.

    Returns
    -------
    The map from there. Where borders overlap, the nearest counts; what is hidden behind one is unknown.
    """
    if north_m == 0.0 and east_m == 0.0:
        return found
    x = found.free_m * np.cos(found.azimuth_rad) - north_m
    y = found.free_m * np.sin(found.azimuth_rad) - east_m
    # A border that the vehicle has passed is behind it, at its new azimuth; one that it has run into is at distance nothing.
    distance = np.hypot(x, y)
    bins = bin_of(np.arctan2(y, x))
    reached = np.full(BINS, np.inf)
    source = np.full(BINS, -1, np.intp)
    known = np.flatnonzero(found.known)
    neighbour = (known + 1) % BINS
    held = found.known[neighbour]
    # Between two neighbouring points of the border the bins that they moved apart by are filled too.
    span = (bins[neighbour] - bins[known] + BINS // 2) % BINS - BINS // 2
    for index, other, steps, holds in zip(known, neighbour, span, held, strict=True):
        last = int(steps) if holds and 1 < steps <= _SPLAT_GAP else 1
        for step in range(last):
            at = (bins[index] + step) % BINS
            metres = distance[index] if step == 0 else min(distance[index], distance[other])
            if metres < reached[at]:
                reached[at], source[at] = metres, index
    seen = source >= 0
    origin = np.maximum(source, 0)
    return VoidMap(
        found.azimuth_rad,
        np.where(seen, reached, 0.0),
        np.where(seen, found.count[origin], 0),
        np.where(seen, found.sigma_m[origin], np.inf),
        seen,
        found.metric,
    )


def _merged(profiles: list[tuple[VoidMap, float]], params: MapMemoryParams) -> RememberedMap:
    nothing = np.zeros(BINS, np.intp)
    if not profiles:
        return RememberedMap(VoidMap.unknown(), nothing, nothing)
    known = np.array([found.known for found, _ in profiles])
    inverse = 1.0 / np.maximum(np.array([found.free_m for found, _ in profiles]), _NEAREST_M)
    weight = np.where(known, np.array([weight for _, weight in profiles])[:, None], 0.0)
    order = np.argsort(np.where(known, inverse, np.inf), axis=0)
    inverse_sorted = np.take_along_axis(inverse, order, axis=0)
    weight_sorted = np.take_along_axis(weight, order, axis=0)
    heavier = np.cumsum(weight_sorted, axis=0)
    # Between two equal halves the nearer one counts: the lower distance, the greater inverse.
    at = np.argmax(heavier > 0.5 * heavier[-1] - 1e-12, axis=0)
    at = np.where(heavier[-1] > 0.0, at, 0)
    median = inverse_sorted[at, np.arange(BINS)]
    tied = np.abs(heavier[at, np.arange(BINS)] - 0.5 * heavier[-1]) < 1e-9
    following = np.minimum(at + 1, len(profiles) - 1)
    median = np.where(
        tied & (weight_sorted[following, np.arange(BINS)] > 0.0),
        inverse_sorted[following, np.arange(BINS)],
        median,
    )
    some = known.any(axis=0)
    free = np.where(some, 1.0 / median, 0.0)
    agreeing = known & (np.abs(inverse / median[None, :] - 1.0) <= params.same_share)
    own = np.array([np.where(found.known, found.sigma_m, 0.0) for found, _ in profiles])
    count = np.array([found.count for found, _ in profiles])
    n = np.maximum(known.sum(axis=0), 1)
    scatter = np.sqrt((np.where(known, inverse - median[None, :], 0.0) ** 2).sum(axis=0) / n) * free**2
    sigma = np.hypot(own.sum(axis=0) / n, scatter)
    return RememberedMap(
        VoidMap(
            bin_azimuths_rad(),
            free,
            np.asarray(count.sum(axis=0), np.intp),
            np.where(some, sigma, np.inf),
            np.asarray(some, np.bool_),
        ),
        np.asarray(known.sum(axis=0), np.intp),
        np.asarray(agreeing.sum(axis=0), np.intp),
    )


def _overlaid(base: VoidMap, other: VoidMap, take: NDArray[np.bool_]) -> VoidMap:
    return VoidMap(
        base.azimuth_rad,
        np.where(take, other.free_m, base.free_m),
        np.where(take, other.count, base.count),
        np.where(take, other.sigma_m, base.sigma_m),
        np.asarray(base.known | take, np.bool_),
        base.metric,
    )

"""The void map: how far the vehicle, with its own size, could fly level along each azimuth, from the samples of one pair.

The vehicle is an upright cylinder. It is swept along azimuths one degree apart through the ranged samples; the first place where three of them agree is
where it would touch something. Samples above or below the vehicle at their own place (floor and ceiling, mostly) are no obstacles: what counts is their
metric height there, not their elevation. A direction in which too little was measured is unknown, and unknown is not free.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Final, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from detector.parallax.coverage import reach_in_rad
from detector.parallax.samples import RangedSamples

BINS: Final = 360
"""A full circle, one degree each; bin 0 points along the level frame's x axis, and azimuths grow to the right."""
_HIT_SAMPLES: Final = 3
_BIN_RAD: Final = math.tau / BINS
_MEDIAN_HALF_BINS: Final = 1
_SEEN_THROUGH: Final = 0.6
"""Quantile (of the inverse ranges about a direction, by weight) that is looked through to: a little nearer than the middle."""


class VoidMapParams(BaseModel):
    """The vehicle's size, and what is believed. Metres are baselines where the scale is not known: see :func:`void_map`."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    radius_m: Annotated[
        float,
        Field(gt=0, le=5, description="Of the vehicle with its margin. Larger: fewer gaps are wide enough."),
    ] = 0.35
    half_height_m: Annotated[
        float,
        Field(
            gt=0,
            le=5,
            description="Half of the vehicle's height with its margin. Larger: floor and ceiling come into the way.",
        ),
    ] = 0.3
    limit_m: Annotated[
        float,
        Field(gt=0, le=100, description="Nothing is called free further than this. Larger: bolder."),
    ] = 15.0
    hit_share: Annotated[
        float,
        Field(
            gt=0,
            le=1,
            description="Three samples within this share of their distance are a surface. Larger: more noise counts as one.",
        ),
    ] = 0.10
    resolved_share: Annotated[
        float,
        Field(
            gt=0,
            le=1,
            description="A sample whose range is less sure than this share of it is no obstacle by itself. Larger: more false ones.",
        ),
    ] = 0.35
    known_half_deg: Annotated[
        float,
        Field(
            gt=0,
            le=30,
            description="A direction is known by samples within this angle of it. Larger: more is known, and less surely.",
        ),
    ] = 4.0
    known_samples: Annotated[
        int, Field(ge=1, le=100, description="So many of them are needed. Larger: less is known.")
    ] = 3
    known_elevation_deg: Annotated[
        float,
        Field(
            gt=0,
            le=60,
            description="Samples further above or below the horizon say nothing of the way at flight height.",
        ),
    ] = 10.0
    bridged_deg: Annotated[
        float,
        Field(
            ge=0,
            le=45,
            description="Unknown gaps up to this width between known directions are bridged. Larger: bolder where there is little texture.",
        ),
    ] = 8.0
    hidden_width_m: Annotated[
        float,
        Field(
            gt=0,
            le=5,
            description="A way was looked through up to where something so wide could stand in it between the samples, unseen. Larger: bolder where there is little texture.",
        ),
    ] = 0.3
    covered_m: Annotated[
        float,
        Field(
            ge=0,
            le=20,
            description="How far ahead that is asked (m); 0 asks it nowhere. Larger: shorter ways where there is little texture.",
        ),
    ] = 2.0
    plain_share: Annotated[
        float,
        Field(
            ge=0,
            le=1,
            description="Where less than this share of the directions in the picture is known, no way is told further than the last pair looked through. Larger: more careful where there is little texture; 0: never (what several pairs looked through limits each step anyway).",
        ),
    ] = 0.0
    plateau: Annotated[
        float,
        Field(
            gt=0,
            le=1,
            description="The answer is the middle of the directions that are free at least this share of the furthest. Larger: nearer to the furthest one.",
        ),
    ] = 0.95
    smooth_deg: Annotated[
        float,
        Field(
            ge=0,
            le=15,
            description="Half width over which the profile is smoothed to find the furthest direction. Larger: single bins matter less, narrow gaps are lost.",
        ),
    ] = 4.0
    preference: Annotated[
        Literal["furthest", "least_deviation"],
        Field(
            description="furthest: the furthest gap (the paper's aim). least_deviation: the planner's own direction, or the one nearest to it that is free far enough."
        ),
    ] = "furthest"
    free_enough_m: Annotated[
        float,
        Field(
            gt=0,
            le=50,
            description="least_deviation: a direction that is free this far is free enough. Larger: more detours.",
        ),
    ] = 4.0


@dataclass(frozen=True, slots=True)
class VoidMap:
    """Free distances by azimuth in the level frame (local NED where the pose is known), all round.

    Attributes
    ----------
    azimuth_rad
        (M,) middle of each bin, in (-pi, pi], 0 along x, growing to the right (clockwise from north).
    free_m
        (M,) how far the vehicle's cylinder can move before it touches; 0 where not ``known``.
    count
        (M,) samples that the direction is known by; 0 where it was bridged or is not known.
    sigma_m
        (M,) standard deviation of ``free_m``; infinite where not ``known``.
    known
        (M,) whether the direction was measured. Unknown is not free.
    metric
        Whether distances are in metres; else in baselines.
    """

    azimuth_rad: NDArray[np.float64]
    free_m: NDArray[np.float64]
    count: NDArray[np.intp]
    sigma_m: NDArray[np.float64]
    known: NDArray[np.bool_]
    metric: bool = True

    def __post_init__(self) -> None:
        shape = np.shape(self.azimuth_rad)
        for name in ("free_m", "count", "sigma_m", "known"):
            found = np.shape(getattr(self, name))
            if len(shape) != 1 or found != shape:
                raise ValueError(f"{name}: expected {shape}, got {found}")

    @staticmethod
    def unknown(*, metric: bool = True) -> VoidMap:
        """Return the map of nothing."""
        return VoidMap(
            bin_azimuths_rad(),
            np.zeros(BINS),
            np.zeros(BINS, np.intp),
            np.full(BINS, np.inf),
            np.zeros(BINS, np.bool_),
            metric,
        )

    def where(self, keep: NDArray[np.bool_]) -> VoidMap:
        """Return the map of the bins that a mask (M,) names; the others are unknown."""
        known = self.known & keep
        return VoidMap(
            self.azimuth_rad,
            np.where(known, self.free_m, 0.0),
            np.where(known, self.count, 0),
            np.where(known, self.sigma_m, np.inf),
            known,
            self.metric,
        )

    def at(self, azimuth_rad: float) -> int:
        """Return the index of the bin of an azimuth."""
        return int(bin_of(np.array([azimuth_rad]))[0])


@dataclass(frozen=True, slots=True)
class Gap:
    """The answer of a map.

    Attributes
    ----------
    azimuth_rad
        Of the level frame.
    free_m, sigma_m
        Along it.
    width_rad
        Of the run of directions that are free nearly as far.
    count
        Samples that this direction is known by, the most within the gap's middle.
    """

    azimuth_rad: float
    free_m: float
    sigma_m: float
    width_rad: float
    count: int


def bin_azimuths_rad() -> NDArray[np.float64]:
    """Return the (M,) azimuths of all bins, in (-pi, pi]."""
    degrees = np.arange(BINS) * (360.0 / BINS)
    return np.asarray(np.radians(np.where(degrees > 180.0, degrees - 360.0, degrees)))


def bin_of(azimuths_rad: NDArray[np.float64]) -> NDArray[np.intp]:
    """Return the (N,) bins of azimuths."""
    return np.asarray(np.rint(np.asarray(azimuths_rad) / _BIN_RAD), np.intp) % BINS


def void_map(samples: RangedSamples, params: VoidMapParams, *, baseline_m: float | None = None) -> VoidMap:
    """Return the free distances that one pair's samples tell.

    Parameters
    ----------
    samples
        In the level frame.
    params
        The vehicle and the rules.
    baseline_m
        Where the samples are not metric: what the baseline is taken to be, to give the vehicle a size. A wrong one makes the vehicle too large or too small by
        as much, and the answer bears that (a quarter more or less costs nothing). None: 0.25 m.

    Returns
    -------
    In metres for metric samples, else in baselines.
    """
    unit_m = 1.0 if samples.metric else (0.25 if baseline_m is None else baseline_m)
    radius, half_height, limit = (
        length_m / unit_m for length_m in (params.radius_m, params.half_height_m, params.limit_m)
    )
    told = samples.where(samples.informative)
    if len(told) == 0:
        return VoidMap.unknown(metric=samples.metric)
    azimuth = np.arctan2(told.rays_level[:, 1], told.rays_level[:, 0])
    level = np.hypot(told.rays_level[:, 0], told.rays_level[:, 1])

    vouched, vouched_sigma, count = _vouched(azimuth, told, level, limit, params)
    hidden, near = params.hidden_width_m / unit_m, params.covered_m / unit_m
    hit, hit_sigma = _first_hits(azimuth, told, level, radius, half_height, limit, hidden, near, params)
    known = count >= params.known_samples
    # The disc's front touches before its middle is there, and so it is with what was only looked through.
    free = np.minimum(np.where(known, np.maximum(vouched - radius, 0.0), 0.0), hit)
    sigma = np.where(hit <= vouched - radius, hit_sigma, vouched_sigma)
    free, sigma, known = _bridged(free, sigma, known, hit, params)
    return VoidMap(
        bin_azimuths_rad(),
        np.where(known, np.minimum(free, limit), 0.0),
        np.where(count >= params.known_samples, count, 0),
        np.where(known, sigma, np.inf),
        known,
        samples.metric,
    )


def choose_gap(
    found: VoidMap, params: VoidMapParams, *, wanted_rad: float | None = None, unit_m: float = 1.0
) -> Gap | None:
    """Return the direction to fly, or None where nothing is known.

    Parameters
    ----------
    found
        The map. Its bins are free for the whole vehicle already, so every one of them is a gap that is wide enough; the middle of a run of them
        leaves most room for error.
    params
        Rules.
    wanted_rad
        The planner's direction in the level frame; needed for ``least_deviation``, which is ``furthest`` without it.
    unit_m
        Metres that the map's unit stands for: 1, or the assumed baseline.
    """
    if not found.known.any():
        return None
    smooth = _smoothed(found, params)
    if params.preference == "least_deviation" and wanted_rad is not None:
        enough = found.known & (np.minimum(found.free_m, smooth) * unit_m >= params.free_enough_m)
        if enough.any():
            off = np.abs(_wrapped(found.azimuth_rad - wanted_rad))
            best = int(np.argmin(np.where(enough, off, np.inf)))
            first, last = _run(enough, best)
            return _gap(found, best, first, last)
    best = int(np.argmax(smooth))
    return gap_about(found, best, smooth, params)


def gap_about(found: VoidMap, best: int, smooth: NDArray[np.float64], params: VoidMapParams) -> Gap:
    """Return the gap whose furthest bin is ``best``: the middle of the run about it that is free nearly as far in the smoothed profile."""
    nearly = found.known & (smooth >= params.plateau * smooth[best])
    first, last = _run(nearly, best)
    return _gap(found, (first + last) // 2, first, last)


def smoothed_profile(found: VoidMap, params: VoidMapParams) -> NDArray[np.float64]:
    """Return the (M,) profile in which the furthest direction is looked for: smoothed over neighbouring bins, 0 where unknown."""
    return _smoothed(found, params)


def _smoothed(found: VoidMap, params: VoidMapParams) -> NDArray[np.float64]:
    """Return the profile without single wild bins (a median), rounded off, so that the middle of a gap stands out before its edges."""
    free = np.where(found.known, found.free_m, 0.0)
    half = round(params.smooth_deg * BINS / 360.0)
    if half == 0:
        return free
    free = np.median(free[_neighbours(min(half, _MEDIAN_HALF_BINS))], axis=1)
    weight = half + 1.0 - np.abs(np.arange(-half, half + 1))
    rounded = free[_neighbours(half)] @ (weight / weight.sum())
    return np.where(found.known, rounded, 0.0)


def _neighbours(half: int) -> NDArray[np.intp]:
    return np.asarray((np.arange(BINS)[:, None] + np.arange(-half, half + 1)[None, :]) % BINS, np.intp)


def _vouched(
    azimuth: NDArray[np.float64],
    told: RangedSamples,
    level: NDArray[np.float64],
    limit: float,
    params: VoidMapParams,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.intp]]:
    """Return how far the samples about each azimuth look through near the horizon, its standard deviation, and their number, (M,) each.

    What they see may be several surfaces: this is a weighted quantile, a little nearer than the median, and the hits tell where the near ones are. It is no further than what the noise can
    tell from infinity.
    """
    vouched, spread, count = np.zeros(BINS), np.full(BINS, np.inf), np.zeros(BINS, np.intp)
    near_horizon = np.flatnonzero(
        np.abs(told.rays_level[:, 2]) <= math.sin(math.radians(params.known_elevation_deg))
    )
    if near_horizon.size == 0:
        return vouched, spread, count
    inverse = told.inverse_range[near_horizon] / level[near_horizon]
    order = np.argsort(inverse)
    mine, inverse = near_horizon[order], inverse[order]
    weight = (level[mine] / told.sigma[mine]) ** 2
    reach = params.known_half_deg * BINS / 360.0
    place = azimuth[mine] / _BIN_RAD
    bins = (
        np.unique(bin_of(azimuth[mine])[:, None] + np.arange(-math.ceil(reach), math.ceil(reach) + 1)) % BINS
    )
    bins = np.unique(bins)
    apart = np.abs((place[None, :] - bins[:, None] + BINS / 2) % BINS - BINS / 2)
    within = apart <= reach
    count[bins] = within.sum(axis=1)
    heavier = np.cumsum(np.where(within, weight[None, :], 0.0), axis=1)
    total = heavier[:, -1]
    seen = total > 0.0
    heavier, total, bins = heavier[seen], total[seen], bins[seen]
    middle = inverse[np.argmax(heavier >= _SEEN_THROUGH * total[:, None], axis=1)]
    pooled = 1.0 / np.sqrt(total)
    near = np.maximum(np.maximum(middle + pooled, 2.0 * pooled), 1.0 / limit)
    vouched[bins], spread[bins] = 1.0 / near, pooled / near**2
    return vouched, spread, count


def _first_hits(
    azimuth: NDArray[np.float64],
    told: RangedSamples,
    level: NDArray[np.float64],
    radius: float,
    half_height: float,
    limit: float,
    hidden: float,
    near: float,
    params: VoidMapParams,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return how far the disc moves along each azimuth until it touches a surface, (M,), infinite where none; and the standard deviation."""
    hits, spread = np.full(BINS, np.inf), np.full(BINS, np.inf)
    sure = told.sigma <= params.resolved_share * told.inverse_range
    with np.errstate(divide="ignore", invalid="ignore"):
        away = level / told.inverse_range
        in_height = np.abs(told.rays_level[:, 2] / told.inverse_range) <= half_height
    inside = np.flatnonzero(sure & in_height & (away <= limit + radius))
    if inside.size < _HIT_SAMPLES:
        return hits, spread
    away, bearing = away[inside], azimuth[inside]
    sigma = told.sigma[inside] / told.inverse_range[inside] * away
    # Each sample stands in the way of the azimuths within its reach: one row for each of them.
    reach = np.arcsin(np.minimum(radius / np.maximum(away, radius), 1.0)) / _BIN_RAD
    left, right = reach_in_rad(told, bearing, away, hidden, near, math.radians(params.known_elevation_deg))
    first = np.asarray(np.ceil((bearing - left) / _BIN_RAD - reach), np.intp)
    rows = np.maximum(np.asarray(np.floor((bearing + right) / _BIN_RAD + reach), np.intp) - first + 1, 0)
    member = np.repeat(np.arange(inside.size), rows)
    within_rows = np.arange(member.size) - np.repeat(np.cumsum(rows) - rows, rows)
    bin_number = first[member] + within_rows
    # Of what a surface may reach to on either side, the nearest to the way counts.
    off = bearing[member] - bin_number * _BIN_RAD
    off = off - np.clip(off, -right[member], left[member])
    beside = away[member] * np.sin(off)
    distance = away[member] * np.cos(off) - np.sqrt(np.maximum(radius**2 - beside**2, 0.0))
    bin_number %= BINS
    distance = np.maximum(distance, 0.0)
    order = np.argsort(bin_number * (2.0 * (limit + radius)) + distance)  # by bin, then by distance
    bin_number, distance, member = bin_number[order], distance[order], member[order]
    # Agreement is judged by where the surface is, not by what is left to the hull, which may be nothing.
    centre = distance + radius
    last = _HIT_SAMPLES - 1
    agree = (bin_number[last:] == bin_number[:-last]) & (
        centre[last:] <= (1.0 + params.hit_share) * centre[:-last]
    )
    met, at = np.unique(bin_number[:-last][agree], return_index=True)
    nearest = np.flatnonzero(agree)[at]
    # The first three are the nearest of many with noise: the surface is the middle of those about them.
    row_ends = np.searchsorted(bin_number, met, "right")
    about = [
        np.searchsorted(centre[begin:end], (1.0 + params.hit_share) * centre[begin], "right")
        for begin, end in zip(nearest, row_ends, strict=True)
    ]
    middle = nearest + np.asarray(about, np.intp) // 2
    hits[met] = distance[middle]
    spread[met] = sigma[member[middle]] / math.sqrt(_HIT_SAMPLES)
    return hits, spread


def _bridged(
    free: NDArray[np.float64],
    sigma: NDArray[np.float64],
    known: NDArray[np.bool_],
    hit: NDArray[np.float64],
    params: VoidMapParams,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Close narrow unknown gaps with the nearer one of their two sides, or with what the disc meets in them."""
    most = math.floor(params.bridged_deg * BINS / 360.0)
    free, sigma, filled = free.copy(), sigma.copy(), known.copy()
    starts = np.flatnonzero(known & ~np.roll(known, -1))
    if not known.any() or known.all():
        return free, sigma, filled
    for left in starts:
        width = 1
        while not known[(left + width + 1) % BINS]:
            width += 1
            if width > most:
                break
        if width > most:
            continue
        right = (left + width + 1) % BINS
        nearer = left if free[left] <= free[right] else right
        between = (left + 1 + np.arange(width)) % BINS
        free[between] = np.minimum(free[nearer], hit[between])
        sigma[between] = max(sigma[left], sigma[right])
        filled[between] = True
    return free, sigma, filled


def _gap(found: VoidMap, index: int, first: int, last: int) -> Gap:
    index %= BINS
    around = (index + np.arange(-2, 3)) % BINS
    return Gap(
        azimuth_rad=float(found.azimuth_rad[index]),
        free_m=float(found.free_m[index]),
        sigma_m=float(found.sigma_m[index]),
        width_rad=(last - first + 1) * _BIN_RAD,
        count=int(found.count[around].max()),
    )


def _run(flags: NDArray[np.bool_], index: int) -> tuple[int, int]:
    """Return the ends of the run of set flags about one that is set; the first may be negative and the last beyond the end."""
    first = last = index
    while last - first < BINS - 1 and flags[(first - 1) % BINS]:
        first -= 1
    while last - first < BINS - 1 and flags[(last + 1) % BINS]:
        last += 1
    return first, last


def _wrapped(angle_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray((angle_rad + math.pi) % math.tau - math.pi)

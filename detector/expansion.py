"""What the expansion of the image says: focus of expansion, time to contact, metric ranges.

Tracks are pairs of (N, 2) arrays, ``start_px`` in the earlier frame and ``end_px`` in the later one, with the rotation already
removed: the starts are where the points would have been seen from the earlier place with the *later* camera's orientation.
Then all flow comes from the translation, and it lies on lines through one point, the focus of expansion. That is not the
vanishing point (from lines in the scene) and not the void (what the detector chooses).

All results refer to the instant of the later frame. Points must be those of an image without distortion
(:func:`ideal_px`), except where a function takes the camera itself.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from detector.camera_model import CameraModel
from detector.results import TimeToContact
from detector.rotation import rotation_matrix, rotation_vector

FLOW_SIGMA_PX: Final = 0.3
"""Standard deviation of one track's flow on each axis, as measured for Lucas-Kanade on sharp frames."""

_MIN_TRACKS: Final = 12
_HYPOTHESES: Final = 256
_MIN_INLIER_SHARE: Final = 0.5
_MAX_FOCUS_SIGMA: Final = 0.06  # of the tracks' extent: beyond it the focus is a guess
_REFINEMENTS: Final = 12

_MIN_CONTACT_SAMPLES: Final = 5
_RESOLVED_INVERSE_CONTACT: Final = 0.06  # a sample must tell one step in 16 from none
_CONTACT_QUANTILE: Final = 0.75  # of the inverse: the low side of the time

_RESOLVED_SHARE: Final = 0.35  # of the range: a sample less sure than this has no place, only a lower bound
_KNOWN_HALF_ANGLE_RAD: Final = math.radians(4.0)
_KNOWN_SAMPLES: Final = 3
_HIT_SAMPLES: Final = 3
_ONE_SURFACE_SCATTER: Final = 1.6  # times the noise: beyond it the samples see several depths
_HIT_SHARE: Final = 0.10
_COVER_HALF_HEIGHT: Final = math.sin(math.radians(14.0))
_COVER_STEP: Final = 0.85
_NEAREST_COVER_M: Final = 0.7
_COVER_SLACK: Final = 1.3  # what stands a little nearer than the distance covers it too: it is met itself
_BEHIND: Final = 1.25
"""What is surely this much farther away is behind a thing, not it."""
_GRAZE_M: Final = 0.06
_LEAST_COVER_M: Final = 0.25


@dataclass(frozen=True, slots=True)
class MetricRange:
    """Free distance along a direction, from the later camera.

    Attributes
    ----------
    distance_m
        To the nearest surface that the vehicle, moved along the direction, would meet; or, where it would meet none,
        as far as the samples vouch for.
    spread_m
        Standard deviation of the samples behind it.
    samples
        Their number.
    """

    distance_m: float
    spread_m: float
    samples: int


@dataclass(frozen=True)
class RangeSamples:
    """Triangulated tracks. Parallax measures the inverse of the range, so that is what is kept: it has a normal error, and zero means far.

    Attributes
    ----------
    rays
        (N, 3) unit vectors in the later camera frame.
    inverse_per_m, sigma_per_m
        (N,) inverse range, which noise may make negative, and its standard deviation.
    """

    rays: NDArray[np.float64]
    inverse_per_m: NDArray[np.float64]
    sigma_per_m: NDArray[np.float64]

    def __post_init__(self) -> None:
        n = len(self.rays)
        if self.rays.shape != (n, 3) or self.inverse_per_m.shape != (n,) or self.sigma_per_m.shape != (n,):
            raise ValueError(
                f"expected (N, 3), (N,) and (N,), got {self.rays.shape}, {self.inverse_per_m.shape}, {self.sigma_per_m.shape}"
            )

    def __len__(self) -> int:
        return len(self.rays)

    def joined(self, others: RangeSamples) -> RangeSamples:
        """Return these samples and others of the same camera."""
        return RangeSamples(
            np.concatenate([self.rays, others.rays]),
            np.concatenate([self.inverse_per_m, others.inverse_per_m]),
            np.concatenate([self.sigma_per_m, others.sigma_per_m]),
        )

    @cached_property
    def is_resolved(self) -> NDArray[np.bool_]:
        """(N,) whether the range is known to 35 %."""
        resolved: NDArray[np.bool_] = self.sigma_per_m <= _RESOLVED_SHARE * self.inverse_per_m
        return resolved

    @cached_property
    def points_m(self) -> NDArray[np.float64]:
        """(N, 3) in the later camera frame; NaN where the range is not resolved."""
        with np.errstate(divide="ignore", invalid="ignore"):
            points: NDArray[np.float64] = self.rays / self.inverse_per_m[:, None]
        points[~self.is_resolved] = np.nan
        return points


def ideal_px(camera: CameraModel, points_px: ArrayLike) -> NDArray[np.float64]:
    """Return where points would lie in the image of the same camera without its distortion, (N, 2)."""
    points = np.asarray(points_px, dtype=np.float64)
    if not camera.is_distorted:
        return points
    rays = camera.pixel_to_ray(points)
    ideal: NDArray[np.float64] = rays[:, :2] / rays[:, 2:3] * (camera.fx_px, camera.fy_px) + (
        camera.cx_px,
        camera.cy_px,
    )
    return ideal


def focus_of_expansion_from_translation(
    camera: CameraModel, translation_later: ArrayLike
) -> NDArray[np.float64] | None:
    """Return the focus of expansion of a known motion.

    Parameters
    ----------
    camera
        Its distortion is left out: the point belongs to the ideal image.
    translation_later
        (3,) from the earlier to the later camera position, in the later camera's axes; only its direction matters.

    Returns
    -------
    (2,) px, perhaps outside the image; None when the motion is sideways (there is none) or zero. When the camera moves backwards it is
    the point that the flow runs into.
    """
    translation = _vector(translation_later)
    length = float(np.linalg.norm(translation))
    if not math.isfinite(length) or abs(translation[2]) <= 0.02 * length:
        return None
    return np.array(
        [
            camera.cx_px + camera.fx_px * translation[0] / translation[2],
            camera.cy_px + camera.fy_px * translation[1] / translation[2],
        ]
    )


def fit_focus_of_expansion(
    start_px: ArrayLike, end_px: ArrayLike, *, flow_sigma_px: float = FLOW_SIGMA_PX, seed: int = 0
) -> NDArray[np.float64] | None:
    """Estimate the focus of expansion from the tracks alone.

    The cost of a track is the part of its flow across the line from the focus, in px, so that short flow says little, as it should. Random
    pairs of lines give the start, iteratively reweighted least squares (Cauchy weights) the answer.

    Parameters
    ----------
    start_px, end_px
        (N, 2) each.
    flow_sigma_px
        Noise of the flow.
    seed
        Of the random pairs.

    Returns
    -------
    (2,) px, perhaps outside the image; None when the tracks do not determine it: too few, no flow, flow that does not
    run through one point (a rotation was not removed), sideways motion, or contraction.
    """
    start, end = _tracks(start_px, end_px)
    flow = end - start
    sigma = flow_sigma_px
    moving = np.linalg.norm(flow, axis=1) > 2.0 * sigma
    if int(moving.sum()) < _MIN_TRACKS:
        return None
    start, end, flow = start[moving], end[moving], flow[moving]
    middle = 0.5 * (start + end)

    focus = _best_hypothesis(middle, flow, sigma, seed)
    if focus is None:
        return None
    normal_matrix = np.eye(2)
    for _ in range(_REFINEMENTS):
        residual, jacobian = _across(middle, flow, focus)
        weight = 1.0 / (1.0 + (residual / (2.0 * sigma)) ** 2)
        normal_matrix = jacobian.T @ (jacobian * weight[:, None])
        if np.linalg.cond(normal_matrix) > 1e8:
            return None
        step = np.linalg.solve(normal_matrix, jacobian.T @ (weight * residual))
        focus = focus - step
        if float(np.linalg.norm(step)) < 1e-3:
            break
    residual, _ = _across(middle, flow, focus)
    inliers = np.abs(residual) < 3.0 * sigma
    outward = np.einsum("ij,ij->i", flow, middle - focus)[inliers] > 0.0
    if inliers.mean() < _MIN_INLIER_SHARE or outward.size < _MIN_TRACKS or outward.mean() < 0.8:
        return None
    extent_px = float(np.linalg.norm(np.ptp(middle, axis=0)))
    scatter = max(sigma, 1.4826 * float(np.median(np.abs(residual[inliers]))))
    sigma_focus_px = scatter / math.sqrt(float(np.linalg.eigvalsh(normal_matrix)[0]))
    if not np.isfinite(focus).all() or sigma_focus_px > _MAX_FOCUS_SIGMA * extent_px:
        return None
    return np.asarray(focus, dtype=np.float64)


def time_to_contact_along(
    start_px: ArrayLike,
    end_px: ArrayLike,
    focus_px: ArrayLike,
    towards_px: ArrayLike,
    gate_px: float,
    *,
    flow_sigma_px: float = FLOW_SIGMA_PX,
) -> TimeToContact | None:
    """Return the time to contact of what is seen about a direction: r / |flow| about the focus of expansion.

    With depths Z in the later and Z + T in the earlier frame, a point's distance from the focus grows from r to r (Z + T) / Z, so
    r / flow = Z / T with the r of the *start*: steps of the pair's length that are left at the instant of the later frame.

    Parameters
    ----------
    start_px, end_px
        (N, 2) each.
    focus_px
        (2,) focus of expansion.
    towards_px
        (2,) the direction.
    gate_px
        Tracks that end within this distance of it are used.
    flow_sigma_px
        Noise of the flow. Tracks so near to the focus that it would drown their flow are left out; by their place and
        not by their flow, since otherwise far things would be left out and near ones not.

    Returns
    -------
    The low side (first quartile of the times) of what lies there, never more than the noise lets one tell; None with fewer than five usable tracks.
    """
    start, end = _tracks(start_px, end_px)
    focus, towards = np.asarray(focus_px, dtype=np.float64), np.asarray(towards_px, dtype=np.float64)
    sigma = flow_sigma_px
    offset = start - focus
    radius = np.linalg.norm(offset, axis=1)
    near_direction = np.linalg.norm(end - towards, axis=1) <= gate_px
    usable = near_direction & (radius > sigma / _RESOLVED_INVERSE_CONTACT)
    if int(usable.sum()) < _MIN_CONTACT_SAMPLES:
        return None
    offset, radius, flow = offset[usable], radius[usable], (end - start)[usable]
    outward = offset / radius[:, None]
    radial = np.einsum("ij,ij->i", flow, outward)
    across = np.abs(flow[:, 0] * outward[:, 1] - flow[:, 1] * outward[:, 0])
    consistent = (across < 3.0 * sigma + 0.35 * np.abs(radial)) & (radial > -3.0 * sigma)
    # Where most of the flow does not run from the focus, the focus is wrong, and so would the time be.
    if int(consistent.sum()) < max(_MIN_CONTACT_SAMPLES, 0.5 * consistent.size):
        return None
    inverse = radial[consistent] / radius[consistent]
    inverse_sigma = sigma / radius[consistent]
    quantile = _weighted_quantile(inverse, 1.0 / inverse_sigma**2, _CONTACT_QUANTILE)
    floor = float(np.median(inverse_sigma))
    value = max(quantile, floor)
    scatter = 1.4826 * float(np.median(np.abs(inverse - np.median(inverse))))
    frames = 1.0 / value
    return TimeToContact(
        frames=frames,
        spread_frames=frames * frames * max(scatter, floor / math.sqrt(inverse.size)),
        samples=int(inverse.size),
    )


def plane_share(
    start_px: ArrayLike,
    end_px: ArrayLike,
    focus_px: ArrayLike,
    *,
    flow_sigma_px: float = FLOW_SIGMA_PX,
    seed: int = 0,
) -> float | None:
    """Return the share of tracks that one plane explains.

    The inverse depth of a plane is linear in the pixel, whatever its slant, and so is flow over distance from the focus of expansion, which is
    inverse depth times the motion. So this is a fit of three numbers, and free of scale. On ray-cast scenes at 0.25 m steps it was above
    0.94 for walls that fill the view at 1 to 6 m and 0 to 30 degrees, 0.8 to 0.85 where a wall at 4 m fills half of it, and
    below 0.76 in corridors and empty rooms.

    Parameters
    ----------
    start_px, end_px
        (N, 2) each.
    focus_px
        (2,) focus of expansion.
    flow_sigma_px
        Noise of the flow. Tracks so near to the focus that it would drown their flow are left out.
    seed
        Of the random triples that the fit starts from.

    Returns
    -------
    In [0, 1]; None with fewer than twelve usable tracks.
    """
    start, end = _tracks(start_px, end_px)
    offset = start - np.asarray(focus_px, dtype=np.float64)
    radius = np.linalg.norm(offset, axis=1)
    usable = radius > flow_sigma_px / _RESOLVED_INVERSE_CONTACT
    count = int(usable.sum())
    if count < _MIN_TRACKS:
        return None
    offset, radius, start, end = offset[usable], radius[usable], start[usable], end[usable]
    inverse = np.einsum("ij,ij->i", end - start, offset) / radius**2
    # Three standard deviations of the flow, and what a slightly wrong focus leaves.
    limit = 3.0 * flow_sigma_px / radius + 0.05 * np.abs(inverse)
    scale_px = max(float(np.std(end)), 1e-6)
    terms = np.column_stack((np.ones(count), (end - end.mean(axis=0)) / scale_px))
    triples = np.random.default_rng(seed).integers(0, count, (_HYPOTHESES, 3))
    solvable = np.abs(np.linalg.det(terms[triples])) > 1e-3
    if not solvable.any():
        return None
    triples = triples[solvable]
    planes = np.linalg.solve(terms[triples], inverse[triples][:, :, None])[:, :, 0]
    inliers = np.abs(planes @ terms.T - inverse) < limit
    kept = inliers[int(np.argmax(inliers.sum(axis=1)))]
    plane, *_ = np.linalg.lstsq(terms[kept] * radius[kept, None], inverse[kept] * radius[kept], rcond=None)
    return float(max(kept.mean(), (np.abs(terms @ plane - inverse) < limit).mean()))


def refine_rotation(
    camera: CameraModel,
    start_px: ArrayLike,
    end_px: ArrayLike,
    translation_later: ArrayLike,
    *,
    prior_sigma_rad: float,
    flow_sigma_px: float = FLOW_SIGMA_PX,
) -> NDArray[np.float64]:
    """Estimate the small rotation that is still in the tracks, from how they miss their epipolar lines.

    An attitude that is wrong by 0.1 degrees moves points as far as the parallax of something far away does. With the direction of motion
    known, the part of the flow across the epipolar lines comes from that error alone: three unknowns, one equation a track, solved by
    reweighted least squares about the prior "no error".

    Parameters
    ----------
    camera, start_px, end_px
        The tracks, as seen by the camera (distortion and all).
    translation_later
        (3,) from the earlier to the later position, in the later camera's axes.
    prior_sigma_rad
        How far the attitude may be wrong, one standard deviation.
    flow_sigma_px
        Noise of the flow.

    Returns
    -------
    (3, 3) rotation to apply to the start rays.
    """
    a, b = camera.pixel_to_ray(start_px), camera.pixel_to_ray(end_px)
    translation = _vector(translation_later)
    sigma = flow_sigma_px / camera.fx_px
    rotation = np.eye(3)
    for _ in range(8):
        turned = a @ rotation.T
        plane = np.cross(translation, turned)
        length = np.linalg.norm(plane, axis=1)
        good = length > 0.03 * float(
            np.linalg.norm(translation)
        )  # nearly on the focus, the line's direction is noise
        good &= np.isfinite(b).all(axis=1)
        if int(good.sum()) < _MIN_TRACKS:
            return np.eye(3)
        plane, turned_good, end = plane[good] / length[good, None], turned[good], b[good]
        residual = np.einsum("ij,ij->i", end, plane)
        # Turning the start by w moves it by w x a; seen across the line that is w . (a x plane), and the end should follow it.
        jacobian = -np.cross(turned_good, plane)
        weight = 1.0 / (1.0 + (residual / (2.0 * sigma)) ** 2) / sigma**2
        already = rotation_vector(rotation)
        step = np.linalg.solve(
            jacobian.T @ (jacobian * weight[:, None]) + np.eye(3) / prior_sigma_rad**2,
            -(jacobian.T @ (weight * residual)) - already / prior_sigma_rad**2,
        )
        rotation = rotation_matrix(step) @ rotation
        if float(np.linalg.norm(step)) < 1e-6:
            break
    return rotation


def ranges_m(
    camera: CameraModel,
    start_px: ArrayLike,
    end_px: ArrayLike,
    translation_later_m: ArrayLike,
    *,
    later_from_start: ArrayLike | None = None,
    flow_sigma_px: float = FLOW_SIGMA_PX,
) -> RangeSamples:
    """Triangulate tracks with the known translation; forward, sideways or backward, all the same.

    Parameters
    ----------
    camera, start_px, end_px
        The tracks, as seen by the camera (distortion and all).
    translation_later_m
        (3,) from the earlier to the later position, in the later camera's axes.
    later_from_start
        (3, 3) what rotation is left in the starts (:func:`refine_rotation`); none when not given.
    flow_sigma_px
        Noise of the flow, one figure.

    Returns
    -------
    The samples, from the later camera; without the tracks that do not fit the motion (a moving object, a bad track)
    or lie on the focus.
    """
    a, b = camera.pixel_to_ray(start_px), camera.pixel_to_ray(end_px)
    if later_from_start is not None:
        a = a @ np.asarray(later_from_start, dtype=np.float64).T
    translation = _vector(translation_later_m)
    sigma = flow_sigma_px / camera.fx_px
    # The earlier camera stands at -t. A point at b * range is seen from there along a: a x (b range + t) = 0.
    baseline = np.cross(translation, a)
    reach_m = np.linalg.norm(baseline, axis=1)  # of the baseline, across the line of sight
    with np.errstate(divide="ignore", invalid="ignore"):
        plane = baseline / reach_m[:, None]
        parallax = np.einsum("ij,ij->i", np.cross(a, b), plane)
        across = np.abs(np.einsum("ij,ij->i", b, plane))
        inverse, inverse_sigma = parallax / reach_m, sigma / reach_m
    fits = (across <= 3.0 * sigma + 0.25 * np.abs(parallax)) & (parallax >= -3.0 * sigma)
    fits &= np.isfinite(inverse) & (reach_m > 1e-6)
    return RangeSamples(b[fits], inverse[fits], inverse_sigma[fits])


def free_range_along(
    samples: RangeSamples,
    ray_camera: ArrayLike,
    *,
    half_width_m: float,
    half_height_m: float,
    up_camera: ArrayLike | None = None,
    hidden_width_m: float = math.inf,
) -> MetricRange | None:
    """Return how far the vehicle could move along a ray before it meets something that was seen.

    Its cross section is swept along the ray; the first place where three points inside agree within 10 % is a surface. Unknown is
    never free: without three samples within 4 degrees of the ray there is no answer, and where nothing is met, the answer ends at
    what those samples vouch for together: their common inverse range with two standard deviations on the near side,
    or their near quartile where they do not agree on one. A sample that is less sure than 35 % of its range is not taken for an obstacle by itself.

    Parameters
    ----------
    samples
        From :func:`ranges_m`.
    ray_camera
        (3,) the direction, any length.
    half_width_m, half_height_m
        Of the vehicle, with its margin.
    up_camera
        (3,) up, in the camera's axes; (0, -1, 0) when not given, which is right for a level camera.
    hidden_width_m
        The answer ends where something so wide could stand in the way between the samples, unseen: a pillar without texture has none,
        and what is seen to its left and right says nothing of it.
    """
    ray = _vector(ray_camera)
    ray = ray / np.linalg.norm(ray)
    up = np.array([0.0, -1.0, 0.0]) if up_camera is None else _vector(up_camera)
    side = _cross(ray, up)
    if float(np.linalg.norm(side)) < 1e-3 * float(np.linalg.norm(up)):
        raise ValueError("the ray is vertical: the vehicle's width and height have no meaning across it")
    side /= np.linalg.norm(side)
    vertical = _cross(side, ray)

    near_ray = samples.rays @ ray > math.cos(_KNOWN_HALF_ANGLE_RAD)
    if np.count_nonzero(near_ray) < _KNOWN_SAMPLES:
        return None
    vouched = _vouched(samples.inverse_per_m[near_ray], samples.sigma_per_m[near_ray])
    covered_m = _covered_m(samples, ray, side, vertical, half_width_m, hidden_width_m, vouched.distance_m)
    if covered_m < vouched.distance_m:
        # The parallax is as sure as before; nearer it means fewer metres.
        spread_m = vouched.spread_m * (covered_m / vouched.distance_m) ** 2
        vouched = MetricRange(covered_m, spread_m, vouched.samples)

    along_m, beside_m, above_m = np.stack((ray, side, vertical)) @ samples.points_m.T
    ahead = samples.is_resolved & (along_m > 0.0) & (np.abs(above_m) <= half_height_m)
    inside = ahead & (np.abs(beside_m) <= half_width_m)
    if math.isfinite(hidden_width_m):
        beyond = ahead & ~inside & (np.abs(beside_m) <= half_width_m + hidden_width_m)
        inside |= _may_reach_in(samples, ray, side, vertical, along_m, beside_m, beyond, half_width_m)
    hits_m = np.sort(along_m[inside])
    triples = np.flatnonzero(hits_m[_HIT_SAMPLES - 1 :] <= (1.0 + _HIT_SHARE) * hits_m[: 1 - _HIT_SAMPLES])
    if triples.size == 0 or hits_m[triples[0] + 1] >= vouched.distance_m:
        return vouched
    hit_m = float(hits_m[triples[0] + 1])
    of_surface = inside & (np.abs(along_m - hit_m) <= 2.0 * _HIT_SHARE * hit_m)
    surface_m = along_m[of_surface]
    scatter_m = 1.4826 * float(np.median(np.abs(surface_m - np.median(surface_m))))
    single_m = float(np.median(samples.sigma_per_m[of_surface])) * hit_m**2
    return MetricRange(hit_m, max(scatter_m, single_m / math.sqrt(surface_m.size)), int(surface_m.size))


def _covered_m(
    samples: RangeSamples,
    ray: NDArray[np.float64],
    side: NDArray[np.float64],
    vertical: NDArray[np.float64],
    half_width_m: float,
    hidden_width_m: float,
    most_m: float,
) -> float:
    """Return how far the vehicle's width is looked through without a gap in which something could hide."""
    if not math.isfinite(hidden_width_m):
        return most_m
    forward, beside, above = np.stack((ray, side, vertical)) @ samples.rays.T
    level = (np.abs(above) <= _COVER_HALF_HEIGHT) & (forward > 0.0)
    azimuth_rad = np.arctan2(beside[level], forward[level])
    # Surely no nearer than this: a sample that cannot tell far from near covers nothing.
    nearest_per_m = samples.inverse_per_m[level] + 2.0 * samples.sigma_per_m[level]
    order = np.argsort(azimuth_rad)
    azimuth_rad, nearest_per_m = azimuth_rad[order], nearest_per_m[order]
    covered_m = _LEAST_COVER_M
    for distance_m in (*_ladder(_NEAREST_COVER_M, most_m), most_m):
        half_rad = math.atan2(half_width_m, distance_m)
        seen_rad = azimuth_rad[nearest_per_m * distance_m < _COVER_SLACK]
        first, last = np.searchsorted(seen_rad, (-half_rad, half_rad))
        # A gap counts whole where it only begins in the way: what hides in it may stand at its edge. Beyond the picture nothing is known.
        left = seen_rad[first - 1 : first] if first else (-half_rad,)
        right = seen_rad[last : last + 1] if last < len(seen_rad) else (half_rad,)
        gaps_rad = np.diff(np.concatenate([left, seen_rad[first:last], right]))
        if float(gaps_rad.max()) * distance_m > hidden_width_m:
            return covered_m
        covered_m = distance_m
    return covered_m


def _ladder(first_m: float, most_m: float) -> list[float]:
    """Return distances from the first to below the last, each a step beyond the one before."""
    steps = math.ceil(math.log(most_m / first_m) / -math.log(_COVER_STEP)) if most_m > first_m else 0
    return [first_m / _COVER_STEP**step for step in range(max(0, steps))]


def _may_reach_in(
    samples: RangeSamples,
    ray: NDArray[np.float64],
    side: NDArray[np.float64],
    vertical: NDArray[np.float64],
    along_m: NDArray[np.float64],
    beside_m: NDArray[np.float64],
    beyond: NDArray[np.bool_],
    half_width_m: float,
) -> NDArray[np.bool_]:
    """Return which of the samples just beside the way may belong to something that reaches into it.

    A smooth pillar is seen at one textured side of it only. It ends, at the latest, where the next sample toward the way is surely
    seen through to farther away.

    Returns
    -------
    (N,) bool, a part of ``beyond``.
    """
    found = np.zeros(len(beyond), np.bool_)
    if not beyond.any():
        return found
    forward, to_side, above = np.stack((ray, side, vertical)) @ samples.rays.T
    level = (np.abs(above) <= _COVER_HALF_HEIGHT) & (forward > 0.0)
    azimuth_rad = np.arctan2(to_side, forward)
    nearest_per_m = samples.inverse_per_m + 2.0 * samples.sigma_per_m
    index = np.flatnonzero(beyond)
    looked = np.flatnonzero(level)
    sign = np.where(beside_m[index] < 0.0, 1.0, -1.0)  # toward the way
    inward = sign[:, None] * (azimuth_rad[looked][None, :] - azimuth_rad[index][:, None])
    through = (inward > 0.0) & (nearest_per_m[looked][None, :] * (_BEHIND * along_m[index][:, None]) < 1.0)
    next_rad = sign * azimuth_rad[index] + np.where(through, inward, math.pi).min(axis=1, initial=math.pi)
    # Measured from the way's middle toward the other side: the least reach is minus half the width.
    reach_m = along_m[index] * np.tan(np.clip(next_rad, -1.4, 1.4))
    found[index] = reach_m > -half_width_m + _GRAZE_M
    return found


def _vouched(inverse: NDArray[np.float64], sigma: NDArray[np.float64]) -> MetricRange:
    """Return the distance that samples about one direction vouch for."""
    weight = 1.0 / sigma**2
    pooled_sigma = 1.0 / math.sqrt(float(weight.sum()))
    middle = _weighted_quantile(inverse, weight, 0.5)
    scatter = float(np.median(np.abs(inverse - middle) / sigma)) / 0.6745
    if scatter <= _ONE_SURFACE_SCATTER:
        agreeing = np.abs(inverse - middle) <= 3.0 * max(1.0, scatter) * sigma
        mean = float((weight * inverse)[agreeing].sum() / weight[agreeing].sum())
        pooled_sigma *= max(1.0, scatter)
        near = max(mean, middle) + 2.0 * pooled_sigma
    else:
        near = max(_weighted_quantile(inverse, weight, 0.75), float(np.quantile(inverse, 0.75)))
        pooled_sigma *= scatter
    near = max(near, 2.0 * pooled_sigma)  # no farther than the parallax can resolve
    return MetricRange(1.0 / near, pooled_sigma / near**2, inverse.size)


def _best_hypothesis(
    middle: NDArray[np.float64], flow: NDArray[np.float64], sigma: float, seed: int
) -> NDArray[np.float64] | None:
    """Return the intersection of two tracks' lines that most tracks agree with (truncated squares)."""
    rng = np.random.default_rng(seed)
    first, second = rng.integers(0, len(middle), (2, _HYPOTHESES))
    normal = np.column_stack((-flow[:, 1], flow[:, 0]))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    offset = np.einsum("ij,ij->i", normal, middle)
    determinant = normal[first, 0] * normal[second, 1] - normal[first, 1] * normal[second, 0]
    crossing = np.abs(determinant) > 0.02
    first, second, determinant = first[crossing], second[crossing], determinant[crossing]
    if determinant.size == 0:
        return None
    x = (offset[first] * normal[second, 1] - normal[first, 1] * offset[second]) / determinant
    y = (normal[first, 0] * offset[second] - offset[first] * normal[second, 0]) / determinant
    dx, dy = middle[None, :, 0] - x[:, None], middle[None, :, 1] - y[:, None]
    across = (flow[None, :, 0] * dy - flow[None, :, 1] * dx) / np.maximum(np.hypot(dx, dy), 1e-9)
    cost = np.minimum((across / sigma) ** 2, 9.0).sum(axis=1)
    best = int(np.argmin(cost))
    return np.array([x[best], y[best]])


def _across(
    middle: NDArray[np.float64], flow: NDArray[np.float64], focus: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the flow across the line from the focus, (N,) px, and its derivative by the focus, (N, 2)."""
    offset = middle - focus
    radius = np.maximum(np.linalg.norm(offset, axis=1), 1e-6)
    outward = offset / radius[:, None]
    residual = flow[:, 0] * outward[:, 1] - flow[:, 1] * outward[:, 0]
    radial = np.einsum("ij,ij->i", flow, outward)
    # Moving the focus by d turns the outward direction by (d x outward) / r.
    jacobian = np.column_stack((outward[:, 1], -outward[:, 0])) * (radial / radius)[:, None]
    return residual, jacobian


def _cross(first: NDArray[np.float64], second: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the cross product of two (3,) vectors, without the generality of numpy's, which costs 30 times as much."""
    (a, b, c), (x, y, z) = first, second
    return np.array((b * z - c * y, c * x - a * z, a * y - b * x))


def _weighted_quantile(values: NDArray[np.float64], weights: NDArray[np.float64], share: float) -> float:
    order = np.argsort(values)
    cumulative = np.cumsum(weights[order])
    position = (cumulative - 0.5 * weights[order]) / cumulative[-1]
    return float(np.interp(share, position, values[order]))


def _tracks(start_px: ArrayLike, end_px: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    start, end = np.asarray(start_px, dtype=np.float64), np.asarray(end_px, dtype=np.float64)
    if start.ndim != 2 or start.shape[1] != 2 or start.shape != end.shape:
        raise ValueError(f"expected two arrays (N, 2), got {start.shape} and {end.shape}")
    finite = np.isfinite(start).all(axis=1) & np.isfinite(end).all(axis=1)
    return start[finite], end[finite]


def _vector(values: ArrayLike) -> NDArray[np.float64]:
    vector = np.asarray(values, dtype=np.float64)
    if vector.shape != (3,):
        raise ValueError(f"expected (3,), got {vector.shape}")
    return vector

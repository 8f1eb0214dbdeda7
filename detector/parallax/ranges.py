"""Ranges of the samples from the motion: inverse depth with its uncertainty, and the time to contact about a direction.

A sample can only have moved along its epipolar line, so its flow is read along that line, with the information that the picture holds *there*: an
upright edge seen by a camera that climbs says nothing, and must not read as "infinitely far".
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from detector.camera_model import CameraModel
from detector.parallax.egomotion import Egomotion, plane_points
from detector.parallax.flow_field import FlowField
from detector.parallax.params import ParallaxParams
from detector.parallax.samples import RangedSamples
from detector.parallax.speckles import lonely
from detector.results import TimeToContact
from detector.rotation import rotation_matrix

CAMERA_LEVEL: Final = ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
"""Level frame from camera axes where the attitude is not known: the camera is taken to be level."""

_HORIZON_MARGIN_RAD: Final = math.radians(5.0)
"""Less than this of the picture beyond the horizon, and flight height is not seen."""

_OFF_LINE_SIGMAS: Final = 4.0
_BACKWARDS_SIGMAS: Final = 3.0
_NEAREST_SHARE: Final = 0.05
"""What the flow leaves of a point's distance from the focus is not taken for less than this share of it."""
_UNKNOWN_SIGMA: Final = 1e3
_CONTACT_LEAST: Final = 5
_CONTACT_QUANTILE: Final = 0.75


@dataclass(frozen=True, slots=True)
class InverseDepths:
    """Samples about the later camera, in units of 1/baseline.

    Attributes
    ----------
    rays
        (N, 3) unit vectors in the later camera's axes.
    inverse_range
        (N,) 1/baseline along the ray.
    sigma
        (N,) its standard deviation: the flow's noise and that of the motion.
    informative
        (N,) whether flow along the epipolar line was measured.
    pixels_px
        (N, 2).
    """

    rays: NDArray[np.float64]
    inverse_range: NDArray[np.float64]
    sigma: NDArray[np.float64]
    informative: NDArray[np.bool_]
    pixels_px: NDArray[np.float64]


def inverse_depths(field: FlowField, motion: Egomotion, params: ParallaxParams) -> InverseDepths:
    """Return the inverse range of every sample of the field.

    Samples that do not fit the motion (something that moves, a wrong match) are left out; those whose flow along the epipolar line could not be measured
    are there, and say that they know nothing.

    Parameters
    ----------
    field
        The flow.
    motion
        How the camera moved.
    params
        Settings.
    """
    camera = field.camera
    focal_px = 0.5 * (camera.fx_px + camera.fy_px)
    end, start = plane_points(camera, field.later_px), plane_points(camera, field.earlier_px)
    turned = np.column_stack([start, np.ones(len(start))]) @ motion.correction.T
    ahead = np.isfinite(turned).all(axis=1) & np.isfinite(end).all(axis=1)
    ahead &= np.nan_to_num(turned[:, 2]) > 1e-3
    believed = field.believed & ahead
    with np.errstate(divide="ignore", invalid="ignore"):
        flow_px = focal_px * (turned[:, :2] / turned[:, 2:] - end)
    flow_px[~believed] = 0.0
    end = np.nan_to_num(end)

    towards = motion.direction_later
    line = towards[:2] - end * towards[2]  # where points move on the way back to the earlier frame
    length = np.maximum(np.linalg.norm(line, axis=1), 1e-9)
    along = line / length[:, None]
    weight = np.einsum("ni,nij,nj->n", along, field.information, along)
    moved_px = np.einsum("ni,nij,nj->n", along, field.information, flow_px) / weight
    variance_px2 = 1.0 / weight
    off = np.einsum("ni,nij,nj->n", flow_px, field.information, flow_px) - moved_px**2 * weight
    fits = off <= _OFF_LINE_SIGMAS**2 * max(1.0, motion.scatter) ** 2

    shared_px2 = _shared_variance(end, along, length, moved_px, motion, focal_px)
    sigma_px = np.sqrt(variance_px2 + shared_px2)
    moved = moved_px / focal_px
    left = np.maximum(length - moved * towards[2], _NEAREST_SHARE * length)
    depth_to_range = 1.0 / np.sqrt(1.0 + np.einsum("ni,ni->n", end, end))
    inverse = moved / left * depth_to_range
    sigma = sigma_px / focal_px * length / left**2 * depth_to_range

    informative = believed & (variance_px2 < params.informative_sigma_px**2 + params.flow_sigma_px**2)
    backwards = moved_px < -_BACKWARDS_SIGMAS * sigma_px
    kept = ~(informative & (~fits | backwards)) & np.isfinite(inverse)
    rays = np.column_stack([end, np.ones(len(end))])
    if field.swept is not None:
        # What the flow could not tell the planes may: there each place was asked for its whole neighbourhood.
        depth, margin = field.swept.at(rays)
        clear = ~informative & np.isfinite(field.later_px).all(axis=1) & (margin >= params.swept_margin)
        inverse = np.where(clear, depth * depth_to_range, inverse)
        sigma = np.where(clear, field.swept.sigma * depth_to_range, sigma)
        informative = informative | clear
        kept = kept & np.isfinite(inverse)
    kept &= ~lonely(field.later_px, np.nan_to_num(inverse), informative & kept, focal_px)
    informative = informative[kept]
    rays = rays[kept] * depth_to_range[kept, None]
    return InverseDepths(
        rays,
        np.where(informative, inverse[kept], 0.0),
        np.where(informative, sigma[kept], _UNKNOWN_SIGMA),
        informative,
        field.later_px[kept],
    )


def ranged_samples(
    depths: InverseDepths, *, baseline_m: float | None, frame_from_later: NDArray[np.float64]
) -> RangedSamples:
    """Return the samples in the frame that they are swept in, in metres where the baseline is known.

    Parameters
    ----------
    depths
        From :func:`inverse_depths`.
    baseline_m
        Between the two camera positions.
    frame_from_later
        (3, 3) rotation from the later camera's axes, as :func:`flight_frame` returns it.
    """
    scale = 1.0 if baseline_m is None else 1.0 / baseline_m
    return RangedSamples(
        rays_level=depths.rays @ frame_from_later.T,
        inverse_range=depths.inverse_range * scale,
        sigma=depths.sigma * scale,
        pixels_px=depths.pixels_px,
        metric=baseline_m is not None,
        informative=depths.informative,
    )


def flight_frame(
    level_from_later: NDArray[np.float64] | None, camera: CameraModel
) -> tuple[NDArray[np.float64], bool]:
    """Return the frame that ranges are swept in, (3, 3) from the later camera's axes, and whether it is level.

    It is the level frame, as long as the picture holds the horizon. A camera that looks down (or up) past it sees nothing of what lies at flight height;
    then the frame is tipped forward until the optical axis lies in it, so that what is swept is what is seen. Floors count as obstacles there: that errs
    on the careful side.

    Parameters
    ----------
    level_from_later
        (3, 3) of the level frame; None takes the camera to be level.
    camera
        For its field of view.
    """
    if level_from_later is None:
        return np.array(CAMERA_LEVEL), False
    axis = level_from_later[:, 2]
    tilt_rad = math.asin(max(-1.0, min(1.0, float(axis[2]))))
    if abs(tilt_rad) <= 0.5 * camera.vfov_rad - _HORIZON_MARGIN_RAD:
        return level_from_later, True
    across = np.array([-axis[1], axis[0], 0.0])
    size = float(np.linalg.norm(across))
    if size < 1e-6:
        return np.array(CAMERA_LEVEL), False
    # About the axis to the right a positive angle lifts the view: what was the optical axis becomes level.
    return rotation_matrix(across / size * tilt_rad) @ level_from_later, False


def contact_about(
    depths: InverseDepths, motion: Egomotion, ray_later: NDArray[np.float64], gate_rad: float
) -> TimeToContact | None:
    """Return the time to contact of what is seen about a direction: depth along the motion over the motion, in steps of the pair's length.

    Parameters
    ----------
    depths, motion
        Of the pair.
    ray_later
        (3,) unit vector, the direction in the later camera's axes.
    gate_rad
        Samples within this angle of it count.

    Returns
    -------
    The low side (first quartile of the times); None with fewer than five samples there, or where they are not ahead.
    """
    near = depths.informative & (depths.rays @ ray_later > np.cos(gate_rad))
    forward = depths.rays[near] @ motion.direction_later
    near_count = int(np.count_nonzero(forward > 0.1))
    if near_count < _CONTACT_LEAST:
        return None
    ahead = forward > 0.1
    # Along the motion a point is range * cos away: the inverse grows by 1 / cos.
    inverse = depths.inverse_range[near][ahead] / forward[ahead]
    sigma = depths.sigma[near][ahead] / forward[ahead]
    floor = float(np.median(sigma))
    value = max(float(np.quantile(inverse, _CONTACT_QUANTILE)), floor)
    scatter = 1.4826 * float(np.median(np.abs(inverse - np.median(inverse))))
    return TimeToContact(
        frames=1.0 / value,
        spread_frames=max(scatter, floor / near_count**0.5) / value**2,
        samples=near_count,
    )


def _shared_variance(
    end: NDArray[np.float64],
    along: NDArray[np.float64],
    length: NDArray[np.float64],
    moved_px: NDArray[np.float64],
    motion: Egomotion,
    focal_px: float,
) -> NDArray[np.float64]:
    """Return the variance (N,) px^2 of the flow along the epipolar lines that the motion's uncertainty brings."""
    x, y = end.T
    zero = np.zeros_like(x)
    u, v = along.T
    # A rotation w moves a point of the plane at depth 1 by B w (Longuet-Higgins & Prazdny 1980).
    turn = focal_px * np.column_stack(
        [
            u * (-x * y) + v * (-(1.0 + y * y)),
            u * (1.0 + x * x) + v * (x * y),
            u * (-y) + v * x,
        ]
    )
    across = motion.tangent[None, :2, :] - end[:, :, None] * motion.tangent[None, 2:, :]
    aim = -(moved_px / length)[:, None] * np.einsum("ni,nij->nj", along, across)
    slopes = np.hstack([turn, aim])
    variance: NDArray[np.float64] = np.einsum("ni,ij,nj->n", slopes, motion.covariance, slopes) + zero
    return variance

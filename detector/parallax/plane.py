"""Does one plane explain the flow, or does it take a scene with depth? And if a plane: its normal and its time to contact.

A homography (eight numbers, two equations a sample) against epipolar geometry (five numbers, one equation a sample), by the geometric robust
information criterion GRIC (Torr 1998). The time to contact comes from the homography's determinant, without decomposing it: on a plane rotation and
translation mix, so that the focus of expansion wanders by 50 px, and the time to contact does not.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from detector.parallax.egomotion import Egomotion, plane_points
from detector.parallax.flow_field import FlowField
from detector.parallax.params import ParallaxParams
from detector.results import TimeToContact

_MOST_SAMPLES: Final = 1000
_ROUNDS: Final = 8
_RANSAC_PX: Final = 2.0
_CAUCHY: Final = 2.3
_INLIER_SIGMAS: Final = 3.0
_LEAST_CLOSING: Final = 1e-3
"""Of the distance, in a pair: a plane that nears more slowly has no time to contact."""
_SURE_CONTACT: Final = 0.25
_GRIC_LIMIT: Final = 2.0
_GRIC_SPACE: Final = 4.0


@dataclass(frozen=True, slots=True)
class PlaneFit:
    """One plane through all that is seen.

    Attributes
    ----------
    preferred
        Whether GRIC prefers it to a scene with depth.
    share
        Of the samples, those that it explains.
    gric_plane, gric_scene
        The two figures; the lower one wins.
    normal_later
        (3,) unit normal, from the camera to the plane, in the later camera's axes; None where it could not be told.
    contact
        Time to contact in steps of the pair's length, from the later frame; None for a plane that does not come nearer.
    """

    preferred: bool
    share: float
    gric_plane: float
    gric_scene: float
    normal_later: NDArray[np.float64] | None
    contact: TimeToContact | None


def fit_plane(
    field: FlowField,
    params: ParallaxParams,
    *,
    motion: Egomotion | None = None,
    epipolar_residuals: NDArray[np.float64] | None = None,
) -> PlaneFit | None:
    """Fit a plane to the flow and compare it with a scene of free depth.

    Parameters
    ----------
    field
        The flow.
    params
        Settings.
    motion
        How the camera moved; gives the normal, and the scene's residuals.
    epipolar_residuals
        (N,) of the believed samples over their noise, in place of those of ``motion``.

    Returns
    -------
    None where there are too few samples.
    """
    used = field.where(field.believed)
    if len(used) < params.least_informative:
        return None
    if len(used) > _MOST_SAMPLES:
        chosen = np.linspace(0, len(used) - 1, _MOST_SAMPLES).astype(np.intp)
        used = used.where(chosen)
        epipolar_residuals = None if epipolar_residuals is None else epipolar_residuals[chosen]
    camera = used.camera
    end, start = plane_points(camera, used.later_px), plane_points(camera, used.earlier_px)
    good = np.isfinite(end).all(axis=1) & np.isfinite(start).all(axis=1)
    end, start = end[good], start[good]
    focal_px = 0.5 * (camera.fx_px + camera.fy_px)
    information = used.information[good] * focal_px**2
    fitted = _homography(end, start, information, focal_px)
    if fitted is None:
        return None
    homography, covariance = fitted
    missed = start - _mapped(homography, end)
    plane_residual2 = np.einsum("ni,nij,nj->n", missed, information, missed)
    if epipolar_residuals is None:
        if motion is None:
            return None
        scene_residual2 = _epipolar_residual2(end, start, information, motion)
    else:
        scene_residual2 = epipolar_residuals[good] ** 2
    # The noise that both models meet in this pair: what the freer one leaves.
    scale2 = max(1.0, float(np.median(scene_residual2)) / 0.455)
    count = len(end)
    gric_plane = _gric(plane_residual2 / scale2, count, dimension=2, parameters=8)
    gric_scene = _gric(scene_residual2 / scale2, count, dimension=3, parameters=5)
    inside = plane_residual2 <= _INLIER_SIGMAS**2 * scale2
    return PlaneFit(
        preferred=gric_plane < gric_scene,
        share=float(inside.mean()),
        gric_plane=gric_plane,
        gric_scene=gric_scene,
        normal_later=None if motion is None else _normal(homography, motion),
        contact=_contact(homography, covariance * scale2 * params.correlated_samples, int(inside.sum())),
    )


def plane_is_wall(fit: PlaneFit, params: ParallaxParams) -> bool:
    """Return whether one plane fills the view and surely comes nearer: GRIC prefers it, and it explains nearly everything.

    What is far all over is a plane too, at infinity: there the time to contact is lost in its own uncertainty.
    """
    contact = fit.contact
    if contact is None or contact.spread_frames > _SURE_CONTACT * contact.frames:
        return False
    return fit.preferred and fit.share >= params.plane_share


def distance_along_axis_m(fit: PlaneFit, motion: Egomotion, baseline_m: float) -> float | None:
    """Return the distance of the plane along the optical axis; None where it is not known or the axis does not meet it."""
    if fit.contact is None or fit.normal_later is None or fit.normal_later[2] < 0.1:
        return None
    closing_m = float(fit.normal_later @ motion.direction_later) * baseline_m
    distance_m = fit.contact.frames * closing_m / float(fit.normal_later[2])
    return distance_m if distance_m > 0.0 else None


def _homography(
    end: NDArray[np.float64], start: NDArray[np.float64], information: NDArray[np.float64], focal_px: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Return the (3, 3) homography from later to earlier points and the (8, 8) covariance of its first eight entries (the last is 1)."""
    begin, _ = cv2.findHomography(end, start, cv2.USAC_MAGSAC, _RANSAC_PX / focal_px, maxIters=300)
    if begin is None or abs(begin[2, 2]) < 1e-9:
        begin = np.eye(3)
    entries = (np.asarray(begin, np.float64) / begin[2, 2]).ravel()[:8]
    ones, zeros = np.ones(len(end)), np.zeros(len(end))
    x, y = end.T
    matrix = np.eye(8)
    for _ in range(_ROUNDS):
        homography = np.append(entries, 1.0).reshape(3, 3)
        mapped = np.column_stack([end, ones]) @ homography.T
        w = mapped[:, 2]
        if not np.all(np.abs(w) > 1e-6):
            return None
        u, v = mapped[:, 0] / w, mapped[:, 1] / w
        slopes = np.stack(
            [
                np.column_stack([x, y, ones, zeros, zeros, zeros, -u * x, -u * y]) / w[:, None],
                np.column_stack([zeros, zeros, zeros, x, y, ones, -v * x, -v * y]) / w[:, None],
            ],
            axis=1,
        )
        missed = start - np.column_stack([u, v])
        size2 = np.einsum("ni,nij,nj->n", missed, information, missed)
        weighted = information / (1.0 + size2 / _CAUCHY**2)[:, None, None]
        toward = np.matmul(weighted, slopes)
        matrix = np.tensordot(slopes, toward, axes=([0, 1], [0, 1]))
        right = np.tensordot(toward, missed, axes=([0, 1], [0, 1]))
        if np.linalg.cond(matrix) > 1e14:
            return None
        step = np.linalg.solve(matrix, right)
        entries = entries + step
        if float(np.abs(step).max()) < 1e-7:
            break
    return np.append(entries, 1.0).reshape(3, 3), np.asarray(np.linalg.inv(matrix), np.float64)


def _mapped(homography: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    mapped = np.column_stack([points, np.ones(len(points))]) @ homography.T
    flat: NDArray[np.float64] = mapped[:, :2] / mapped[:, 2:]
    return flat


def _epipolar_residual2(
    end: NDArray[np.float64],
    start: NDArray[np.float64],
    information: NDArray[np.float64],
    motion: Egomotion,
) -> NDArray[np.float64]:
    one = np.ones((len(end), 1))
    later = np.hstack([end, one])
    normal = np.cross(later, motion.direction_later) @ motion.correction
    missed = np.einsum("ni,ni->n", np.hstack([start, one]), normal)
    spread = np.einsum("ni,nij,nj->n", normal[:, :2], np.linalg.inv(information), normal[:, :2])
    residual2: NDArray[np.float64] = missed**2 / np.maximum(spread, 1e-15)
    return residual2


def _gric(residual2: NDArray[np.float64], count: int, *, dimension: int, parameters: int) -> float:
    """Return Torr's criterion for a model of a dimension (of the manifold in the space of four) and its number of parameters."""
    limit = _GRIC_LIMIT * (_GRIC_SPACE - dimension)
    return (
        float(np.minimum(residual2, limit).sum())
        + math.log(_GRIC_SPACE) * dimension * count
        + math.log(_GRIC_SPACE * count) * parameters
    )


def _closing(homography: NDArray[np.float64]) -> float:
    """Return by which share of its distance the plane came nearer in the pair, from the homography later -> earlier.

    Scaled so that its middle singular value is 1 it is R (I + t n^T / d), with the determinant 1 + n.t / d = earlier over later distance.
    """
    middle = float(np.linalg.svd(homography, compute_uv=False)[1])
    return abs(float(np.linalg.det(homography / middle))) - 1.0


def _contact(
    homography: NDArray[np.float64], covariance: NDArray[np.float64], samples: int
) -> TimeToContact | None:
    closing = _closing(homography)
    if closing < _LEAST_CLOSING:
        return None
    slopes = np.empty(8)
    step = 1e-6
    for index in range(8):
        moved = homography.copy()
        moved.flat[index] += step
        slopes[index] = (_closing(moved) - closing) / step
    sigma = math.sqrt(max(0.0, float(slopes @ covariance @ slopes)))
    frames = 1.0 / closing
    return TimeToContact(frames=frames, spread_frames=frames * frames * sigma, samples=samples)


def _normal(homography: NDArray[np.float64], motion: Egomotion) -> NDArray[np.float64] | None:
    """Return the unit normal of the plane: of the homography's decompositions, the one with the rotation nearest to the motion's."""
    count, rotations, translations, normals = cv2.decomposeHomographyMat(homography, np.eye(3))
    best: NDArray[np.float64] | None = None
    least = math.inf
    for index in range(count):
        normal = np.asarray(normals[index], np.float64).reshape(3)
        towards = np.asarray(translations[index], np.float64).reshape(3)
        away = rotations[index] @ motion.correction
        angle = math.acos(max(-1.0, min(1.0, 0.5 * (float(np.trace(away)) - 1.0))))
        # In the earlier frame's axes the translation of later -> earlier points is the motion itself.
        size = float(np.linalg.norm(towards))
        if size > 1e-9:
            along = float(motion.direction_later @ (motion.correction @ towards)) / size
            if normal[2] < 0.0:
                normal, along = -normal, -along
            angle += 0.2 * (1.0 - along)
        if angle < least:
            best, least = normal, angle
    return best

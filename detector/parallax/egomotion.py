"""How the camera moved between two frames: rotation, direction of travel, and how sure that is.

Minimised is the distance of each sample from its epipolar line, over the noise that the picture leaves across that line (Sampson's, with all the
noise in one of the two points), with Cauchy's
robust cost: Levenberg-Marquardt over the rotation (3) and the direction of travel (2). A given attitude and a given velocity are *priors*: an
attitude that is 0.2 degrees wrong, taken as exact, costs 20 points of right directions; as a prior it costs none.

Without a prior for the direction, several starts and an essential matrix (MAGSAC) go before: the cost has more than one hollow.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from detector.camera_model import CameraModel
from detector.parallax.flow_field import FlowField
from detector.parallax.params import ParallaxParams
from detector.rotation import fit_rotation, rotation_matrix, rotation_vector

_ROUNDS: Final = 12
_START_ROUNDS: Final = 6
_START_SAMPLES: Final = 400
_CONVERGED_RAD: Final = 1e-6
_FREE_ROTATION_RAD: Final = math.radians(5.0)
"""Weak prior where no attitude is given: the coarse rotation is better than this."""
_STARTS: Final = ((0.0, 0.0, 1.0), (0.7, 0.0, 0.7), (-0.7, 0.0, 0.7), (0.0, 0.7, 0.7), (0.0, -0.7, 0.7))
_STILL_SIGMAS: Final = 2.0
_STILL_PERCENTILE: Final = 80.0


class RotationSource(StrEnum):
    """Where the rotation between two frames came from."""

    ATTITUDE = "attitude"
    """Given, and left as it was: there was too little texture to refine it."""
    ATTITUDE_REFINED = "attitude_refined"
    """Given, and refined from the flow."""
    FLOW = "flow"
    """From the flow alone."""


@dataclass(frozen=True, slots=True)
class Egomotion:
    """The motion between two frames.

    Attributes
    ----------
    correction
        (3, 3) rotation that is left in the flow field: it takes rays of the turned earlier frame to the later camera's axes.
    later_from_earlier
        (3, 3) the whole rotation.
    direction_later
        (3,) unit vector from the earlier to the later position, in the later camera's axes.
    covariance
        (5, 5) of the correction's rotation vector (rad) and the direction along the two columns of ``tangent`` (rad).
    tangent
        (3, 2) unit vectors across the direction.
    source
        Of the rotation.
    inlier_share
        Of the samples, those within three standard deviations of their epipolar lines.
    scatter
        Robust standard deviation of the residuals, over what the noise explains: near 1 where all is well.
    """

    correction: NDArray[np.float64]
    later_from_earlier: NDArray[np.float64]
    direction_later: NDArray[np.float64]
    covariance: NDArray[np.float64]
    tangent: NDArray[np.float64]
    source: RotationSource
    inlier_share: float
    scatter: float

    @property
    def direction_sigma_rad(self) -> float:
        """Standard deviation of the direction along its less certain axis."""
        return math.sqrt(float(np.linalg.eigvalsh(self.covariance[3:, 3:])[-1]))

    @property
    def rotation_sigma_rad(self) -> float:
        """Standard deviation of the rotation about its least certain axis."""
        return math.sqrt(float(np.linalg.eigvalsh(self.covariance[:3, :3])[-1]))


@dataclass(frozen=True, slots=True)
class FocusOfExpansion:
    """Where the camera is going, in the later frame without distortion.

    Attributes
    ----------
    x_px, y_px
        The point; perhaps outside the image.
    sigma_px
        Standard deviation along its less certain axis.
    """

    x_px: float
    y_px: float
    sigma_px: float


def plane_points(camera: CameraModel, points_px: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return points on the plane at depth 1, (N, 2); NaN where the lens has no inverse."""
    rays = camera.pixel_to_ray(points_px)
    points: NDArray[np.float64] = rays[:, :2] / rays[:, 2:]
    return points


def parallax_left_rad(field: FlowField) -> float:
    """Return the flow (80th percentile, as an angle) that the best rotation leaves of the believed samples: next to nothing where the camera stood still.

    Parameters
    ----------
    field
        The flow.
    """
    used = field.where(field.believed)
    start, end = (used.camera.pixel_to_ray(points) for points in (used.earlier_px, used.later_px))
    good = np.isfinite(start).all(axis=1) & np.isfinite(end).all(axis=1)
    if int(good.sum()) < 3:
        return 0.0
    # Across the edges only: along them the flow is not known, and its noise is no motion.
    start, end = start[good], end[good]
    turned = used.camera.ray_to_pixel(start @ fit_rotation(start, end).T)
    left_px = used.later_px[good] - turned
    values, axes = np.linalg.eigh(used.information[good])
    sharpest = axes[:, :, 1]
    known = np.abs(np.einsum("ni,ni->n", left_px, sharpest))
    both = values[:, 0] > 0.25 * values[:, 1]
    length_px = np.where(both, np.linalg.norm(left_px, axis=1), known)
    length_px = length_px[np.isfinite(length_px)]
    return float(np.percentile(length_px, _STILL_PERCENTILE)) / used.camera.fx_px if len(length_px) else 0.0


def still_limit_rad(camera: CameraModel, params: ParallaxParams) -> float:
    """Return the parallax below which there was no motion: the setting, or what the flow's own noise looks like where pixels are coarse."""
    reduction = max(1, round(camera.width_px / params.width_px))
    return max(params.still_rad, _STILL_SIGMAS * params.flow_sigma_px * reduction / camera.fx_px)


def estimate_egomotion(
    field: FlowField,
    params: ParallaxParams,
    *,
    attitude_given: bool,
    direction_prior: NDArray[np.float64] | None = None,
    start: Egomotion | None = None,
) -> Egomotion | None:
    """Estimate how the camera moved.

    Parameters
    ----------
    field
        The flow; its ``later_from_earlier`` is the prior of the rotation.
    params
        Settings.
    attitude_given
        Whether that rotation came from an attitude, and so is good to ``attitude_sigma_deg``.
    direction_prior
        (3,) from the earlier to the later position in the later camera's axes, any length; None where nothing is known.
    start
        Of the same pair, from a first look at it: where the search begins, and no prior.

    Returns
    -------
    None where there are too few samples; with an attitude and a direction given, those.
    """
    used = field.where(field.believed)
    if len(used) < params.least_informative:
        if attitude_given and direction_prior is not None:
            return _as_given(field, params, direction_prior)
        return None
    if len(used) > params.most_samples:
        used = used.where(np.linspace(0, len(used) - 1, params.most_samples).astype(np.intp))
    problem = _Problem.of(used, params, attitude_given=attitude_given, direction_prior=direction_prior)
    if start is not None:
        state = _minimised(problem, _State(start.correction, start.direction_later), _ROUNDS)
    elif direction_prior is not None:
        state = _minimised(problem, _State(np.eye(3), _unit(direction_prior)), _ROUNDS)
    else:
        state = _best_of_starts(problem, params)
        state = _forwards(problem, state)
    return _result(problem, state, field, attitude_given=attitude_given)


def cost_of_motion(
    field: FlowField, params: ParallaxParams, start: tuple[NDArray[np.float64], NDArray[np.float64]]
) -> tuple[float, tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Return the robust cost of the motion that explains a field best, near a start, without any prior.

    What the focal length does to it is how that can be estimated (:mod:`detector.parallax.focal`).

    Parameters
    ----------
    field
        Its believed samples are used; its camera is the one that is tried.
    params
        Settings.
    start
        Rotation (3, 3) and direction of travel (3,), as the result has them.
    """
    used = field.where(field.believed)
    problem = replace(
        _Problem.of(used, params, attitude_given=False, direction_prior=None), rotation_sigma_rad=math.inf
    )
    state = _minimised(problem, _State(*start), _ROUNDS)
    return problem.cost(state), (state.rotation, state.direction)


def focus_of_expansion(motion: Egomotion, camera: CameraModel) -> FocusOfExpansion | None:
    """Return the focus of expansion with its uncertainty; None where the motion is sideways or backwards, and there is none.

    Parameters
    ----------
    motion
        From :func:`estimate_egomotion`.
    camera
        Its distortion is left out.
    """
    x, y, z = motion.direction_later
    if z < 0.02:
        return None
    jacobian = np.array([[1.0, 0.0, -x / z], [0.0, 1.0, -y / z]]) / z @ motion.tangent
    jacobian *= np.array([[camera.fx_px], [camera.fy_px]])
    covariance_px = jacobian @ motion.covariance[3:, 3:] @ jacobian.T
    return FocusOfExpansion(
        float(camera.cx_px + camera.fx_px * x / z),
        float(camera.cy_px + camera.fy_px * y / z),
        math.sqrt(float(np.linalg.eigvalsh(covariance_px)[-1])),
    )


# ---------------------------------------------------------------------- the least squares


@dataclass(frozen=True, slots=True)
class _State:
    rotation: NDArray[np.float64]
    direction: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class _Problem:
    """Samples on the plane at depth 1 and the priors."""

    start: NDArray[np.float64]  # (N, 3)
    end: NDArray[np.float64]
    covariance: NDArray[np.float64]  # (N, 2, 2), px^2
    focal_px: float
    cauchy: float  # in standard deviations
    share: float  # of a sample, in weight: neighbours are not independent
    rotation_sigma_rad: float
    direction_prior: NDArray[np.float64] | None
    direction_sigma_rad: float

    @classmethod
    def of(
        cls,
        used: FlowField,
        params: ParallaxParams,
        *,
        attitude_given: bool,
        direction_prior: NDArray[np.float64] | None,
    ) -> _Problem:
        start = plane_points(used.camera, used.earlier_px)
        end = plane_points(used.camera, used.later_px)
        good = np.isfinite(start).all(axis=1) & np.isfinite(end).all(axis=1)
        one = np.ones((int(good.sum()), 1))
        return cls(
            np.hstack([start[good], one]),
            np.hstack([end[good], one]),
            np.asarray(np.linalg.inv(used.information[good]), np.float64),
            0.5 * (used.camera.fx_px + used.camera.fy_px),
            params.cauchy_px / params.flow_sigma_px,
            1.0 / params.correlated_samples,
            math.radians(params.attitude_sigma_deg) if attitude_given else _FREE_ROTATION_RAD,
            None if direction_prior is None else _unit(direction_prior),
            math.radians(params.velocity_sigma_deg),
        )

    def thinned(self, most: int) -> _Problem:
        """Return the problem with at most so many samples."""
        if len(self.start) <= most:
            return self
        kept = np.linspace(0, len(self.start) - 1, most).astype(np.intp)
        return replace(
            self,
            start=self.start[kept],
            end=self.end[kept],
            covariance=self.covariance[kept],
            share=self.share * len(self.start) / most,
        )

    def residuals(self, state: _State, *, slopes: bool) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the whitened distances from the epipolar lines (N,) and, if asked, their slopes (N, 5)."""
        turned = self.start @ state.rotation.T
        skew = _skew(state.direction)
        # The later point lies on the grid, exactly; the noise is the earlier point's, across its own epipolar line. So this is its distance itself.
        across = self.end @ skew  # end x direction
        normal = across @ state.rotation
        u, v = normal[:, 0], normal[:, 1]
        spread = u * u * self.covariance[:, 0, 0] + v * v * self.covariance[:, 1, 1]
        spread += 2.0 * u * v * self.covariance[:, 0, 1]
        scale = self.focal_px / np.sqrt(np.maximum(spread, 1e-15))
        residual = np.einsum("ni,ni->n", across, turned) * scale
        if not slopes:
            return residual, np.zeros((0, 5))
        by_rotation = _cross(turned, across)
        by_direction = _cross(turned, self.end) @ _tangent(state.direction)
        return residual, np.hstack([by_rotation, by_direction]) * scale[:, None]

    def cost(self, state: _State) -> float:
        residual, _ = self.residuals(state, slopes=False)
        robust = self.share * self.cauchy**2 * np.log1p((residual / self.cauchy) ** 2)
        cost = float(robust.sum()) + float(
            np.sum((rotation_vector(state.rotation) / self.rotation_sigma_rad) ** 2)
        )
        if self.direction_prior is not None:
            away = float(np.linalg.norm(state.direction - self.direction_prior))
            cost += (away / self.direction_sigma_rad) ** 2
        return cost

    def normal_equations(self, state: _State) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the (5, 5) matrix and the (5,) right-hand side, priors included."""
        residual, slope = self.residuals(state, slopes=True)
        weighted = self.share * slope / (1.0 + (residual / self.cauchy) ** 2)[:, None]
        matrix, right = weighted.T @ slope, -(weighted.T @ residual)
        matrix[:3, :3] += np.eye(3) / self.rotation_sigma_rad**2
        right[:3] -= rotation_vector(state.rotation) / self.rotation_sigma_rad**2
        if self.direction_prior is not None:
            towards = _tangent(state.direction).T @ self.direction_prior
            matrix[3:, 3:] += np.eye(2) / self.direction_sigma_rad**2
            right[3:] += towards / self.direction_sigma_rad**2
        return matrix, right


def _minimised(problem: _Problem, state: _State, rounds: int) -> _State:
    """Return the minimum next to a state: Levenberg-Marquardt."""
    damping, cost = 1e-3, problem.cost(state)
    for _ in range(rounds):
        matrix, right = problem.normal_equations(state)
        step = np.asarray(
            np.linalg.solve(matrix + damping * np.diag(np.diag(matrix) + 1e-9), right), np.float64
        )
        moved = _State(
            rotation_matrix(step[:3]) @ state.rotation,
            _unit(state.direction + _tangent(state.direction) @ step[3:]),
        )
        moved_cost = problem.cost(moved)
        if moved_cost < cost:
            gained = cost - moved_cost
            state, cost, damping = moved, moved_cost, max(0.1 * damping, 1e-9)
            if float(np.linalg.norm(step)) < _CONVERGED_RAD or gained < 1e-7 * cost:
                break
        else:
            damping *= 10.0
            if damping > 1e6:
                break
    return state


def _best_of_starts(problem: _Problem, params: ParallaxParams) -> _State:
    few = problem.thinned(_START_SAMPLES)
    starts = [_State(np.eye(3), _unit(np.array(start))) for start in _STARTS]
    essential = _by_essential(few, params)
    if essential is not None:
        starts.append(essential)
    reached = [_minimised(few, start, _START_ROUNDS) for start in starts]
    return _minimised(problem, min(reached, key=few.cost), _ROUNDS)


def _by_essential(problem: _Problem, params: ParallaxParams) -> _State | None:
    start, end = (np.ascontiguousarray(points[:, :2]) for points in (problem.start, problem.end))
    found, mask = cv2.findEssentialMat(
        start,
        end,
        np.eye(3),
        method=cv2.USAC_MAGSAC,
        prob=0.99,
        threshold=params.cauchy_px / problem.focal_px,
        maxIters=300,
    )
    if found is None or found.shape != (3, 3) or mask is None:
        return None
    essential = np.asarray(found, np.float64)
    _, rotation, direction, _ = cv2.recoverPose(essential, start, end, np.eye(3), mask=mask)
    # OpenCV's x_b = R x_a + t has the earlier camera at t.
    return _State(np.asarray(rotation, np.float64), -_unit(np.asarray(direction, np.float64).reshape(3)))


def _forwards(problem: _Problem, state: _State) -> _State:
    """Return the state with the sign of its direction that puts what is seen in front of the camera."""
    turned = problem.start @ state.rotation.T
    flow = turned[:, :2] / turned[:, 2:] - problem.end[:, :2]
    away = state.direction[:2] - problem.end[:, :2] * state.direction[2]
    # Going back to the earlier frame, points move towards the focus: along ``away``.
    information = np.linalg.inv(problem.covariance)
    along = np.einsum("ni,nij,nj->n", flow, information, away)
    size = np.sqrt(np.maximum(np.einsum("ni,nij,nj->n", away, information, away), 1e-15))
    votes = np.clip(along / size * problem.focal_px, -3.0, 3.0)
    return state if float(votes.sum()) >= 0.0 else _State(state.rotation, -state.direction)


def _result(problem: _Problem, state: _State, field: FlowField, *, attitude_given: bool) -> Egomotion:
    matrix, _ = problem.normal_equations(state)
    residual, _ = problem.residuals(state, slopes=False)
    size = np.abs(residual)
    scatter = float(np.median(size)) / 0.6745
    covariance = np.linalg.inv(matrix + 1e-6 * np.eye(5)) * max(scatter, 1.0) ** 2
    return Egomotion(
        correction=state.rotation,
        later_from_earlier=state.rotation @ field.later_from_earlier,
        direction_later=state.direction,
        covariance=np.asarray(covariance, np.float64),
        tangent=_tangent(state.direction),
        source=RotationSource.ATTITUDE_REFINED if attitude_given else RotationSource.FLOW,
        inlier_share=float(np.mean(size < 3.0)),
        scatter=scatter,
    )


def _as_given(field: FlowField, params: ParallaxParams, direction: NDArray[np.float64]) -> Egomotion:
    unit = _unit(direction)
    sigma_rad = [math.radians(params.attitude_sigma_deg)] * 3 + [math.radians(params.velocity_sigma_deg)] * 2
    return Egomotion(
        correction=np.eye(3),
        later_from_earlier=field.later_from_earlier,
        direction_later=unit,
        covariance=np.diag(np.square(sigma_rad)),
        tangent=_tangent(unit),
        source=RotationSource.ATTITUDE,
        inlier_share=0.0,
        scatter=1.0,
    )


def _unit(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    unit: NDArray[np.float64] = np.asarray(vector, np.float64) / np.linalg.norm(vector)
    return unit


def _skew(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (3, 3) matrix S with rows @ S = rows x vector, and S @ column = vector x column."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def _cross(first: NDArray[np.float64], second: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return row by row cross products, (N, 3), without the generality of numpy's."""
    a, b, c = first.T
    x, y, z = second.T
    return np.column_stack([b * z - c * y, c * x - a * z, a * y - b * x])


def _tangent(direction: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (3, 2) unit vectors across a unit vector and each other."""
    x, y, z = (float(value) for value in direction)
    least = min((abs(x), 0), (abs(y), 1), (abs(z), 2))[1]
    a, b, c = ((0.0, z, -y), (-z, 0.0, x), (y, -x, 0.0))[
        least
    ]  # direction x the axis that it points least along
    size = math.sqrt(a * a + b * b + c * c)
    a, b, c = a / size, b / size, c / size
    return np.array([[a, y * c - z * b], [b, z * a - x * c], [c, x * b - y * a]])

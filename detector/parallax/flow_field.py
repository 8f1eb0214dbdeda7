"""Flow on a grid of the later frame, each sample with the information that the picture holds about it.

The earlier frame is first turned into the later camera's orientation, as far as that is known. Dense inverse search (Kroeger et al. 2016)
both ways gives the flow, a Lucas-Kanade step its last tenths of a pixel. What the picture fixes is told by the structure tensor: its inverse
is the covariance of the flow, small across an edge and large along it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from detector.camera_model import CameraModel
from detector.dense_flow import turned_picture
from detector.parallax.depth_sweep import SweptDepth, resized
from detector.parallax.params import ParallaxParams
from detector.rotation import fit_rotation, rotation_matrix

LK_WINDOW_PX: Final = 9
"""Of the flow's last step, and so of what the picture is asked for."""
_LK_CRITERIA: Final = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 6, 0.02)
_LK_MOST_PX: Final = 1.5
"""Lucas-Kanade refines; where it goes farther than this it went astray."""
_SCHARR_NOISE: Final = 236.0 / 32.0**2
"""Variance of a Scharr gradient (scaled to grey values a pixel) over that of the pixels."""
_NOISE_KERNEL: Final = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
_COARSE_WIDTH_PX: Final = 320
_COARSE_STEP_PX: Final = 6
_SHIFT_LARGE_RAD: Final = 0.03
_SHIFT_WIDTH_PX: Final = 160
_SHIFT_GAIN: Final = 0.7
_COARSE_LEAST: Final = 30


@dataclass(frozen=True, slots=True)
class FlowField:
    """Samples of the flow from the later frame back to the earlier one.

    Attributes
    ----------
    later_px
        (N, 2) grid points of the later frame.
    earlier_px
        (N, 2) where they were in the earlier frame after that was turned by ``later_from_earlier``.
    information
        (N, 2, 2) inverse covariance of ``earlier_px``, 1/px^2.
    later_from_earlier
        (3, 3) rotation that is already taken out.
    textured
        (N,) whether the picture fixes the flow in one direction at least, believed or not: where it does not, nothing was to be had.
    believed
        (N,) textured, seen by both frames, and the way back ends at the start.
    camera
        The model that pixels belong to (full size).
    swept
        Depth from a sweep of planes, where there was one.
    """

    later_px: NDArray[np.float64]
    earlier_px: NDArray[np.float64]
    information: NDArray[np.float64]
    later_from_earlier: NDArray[np.float64]
    textured: NDArray[np.bool_]
    believed: NDArray[np.bool_]
    camera: CameraModel
    swept: SweptDepth | None = None

    @classmethod
    def of_reduced(
        cls,
        reduction: int,
        later_px: NDArray[np.floating],
        earlier_px: NDArray[np.floating],
        information: NDArray[np.float64],
        later_from_earlier: NDArray[np.float64],
        textured: NDArray[np.bool_],
        believed: NDArray[np.bool_],
        camera: CameraModel,
        swept: SweptDepth | None = None,
    ) -> FlowField:
        """Return the field of what was measured in pictures so many times smaller (:func:`reduced_pair`)."""
        offset = 0.5 * (reduction - 1)
        return cls(
            later_px=later_px.astype(np.float64) * reduction + offset,
            earlier_px=earlier_px.astype(np.float64) * reduction + offset,
            information=information / reduction**2,
            later_from_earlier=np.asarray(later_from_earlier, np.float64),
            textured=textured,
            believed=believed,
            camera=camera,
            swept=swept,
        )

    def __len__(self) -> int:
        return len(self.later_px)

    def where(self, keep: NDArray[np.bool_] | slice | NDArray[np.intp]) -> FlowField:
        """Return the samples that a mask, a slice or indices name."""
        return replace(
            self,
            later_px=self.later_px[keep],
            earlier_px=self.earlier_px[keep],
            information=self.information[keep],
            textured=self.textured[keep],
            believed=self.believed[keep],
        )


def measure_flow(
    earlier: NDArray[np.uint8],
    later: NDArray[np.uint8],
    camera: CameraModel,
    later_from_earlier: NDArray[np.float64] | None,
    params: ParallaxParams,
) -> FlowField:
    """Return the flow on a grid.

    Parameters
    ----------
    earlier, later
        (H, W) uint8, of the camera's size.
    camera
        Of both; assumed where it is not known.
    later_from_earlier
        (3, 3) rotation that takes coordinates of the earlier camera to those of the later one, from an attitude. None: a first estimate is made from the
        flow of much reduced images.
    params
        Settings.
    """
    before, now, small, reduction = reduced_pair(earlier, later, camera, params.width_px)
    turn = coarse_rotation(before, now, small) if later_from_earlier is None else later_from_earlier
    turned, seen = turned_picture(before, small, turn)

    search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
    back = np.asarray(search.calc(now, turned, None), np.float32)  # type: ignore[call-overload]  # no start is allowed
    forth = np.asarray(search.calc(turned, now, None), np.float32)  # type: ignore[call-overload]
    at = sample_grid((small.width_px, small.height_px), params.step_px)
    column, row = at.T.astype(np.intp)
    information, strongest = texture(now, column, row, grey_noise(now), params)
    textured = strongest > 1.0 / params.informative_sigma_px**2
    found = (at + back[row, column]).astype(np.float32)
    believed = np.zeros(len(at), np.bool_)
    if textured.any():
        # Where there is no texture there is nothing to refine, and nothing to believe.
        seeds, ends = at[textured], _refined(now, turned, at[textured], found[textured])
        found[textured] = ends
        home = cv2.remap(forth, ends[:, None, 0], ends[:, None, 1], cv2.INTER_LINEAR).reshape(-1, 2)
        inside = cv2.remap(seen, ends[:, None, 0], ends[:, None, 1], cv2.INTER_NEAREST, borderValue=0.0)
        missed = (ends - seeds + home).astype(np.float64)
        limit = (params.round_trip_px / params.flow_sigma_px) ** 2
        returned = np.einsum("ni,nij,nj->n", missed, information[textured], missed) < limit
        believed[textured] = returned & (inside.reshape(-1) > 0)
    return FlowField.of_reduced(reduction, at, found, information, turn, textured, believed, camera)


def reduced_pair(
    earlier: NDArray[np.uint8], later: NDArray[np.uint8], camera: CameraModel, width_px: int
) -> tuple[NDArray[np.uint8], NDArray[np.uint8], CameraModel, int]:
    """Return both pictures at about a width, their camera, and how many times smaller they are: a whole number, 1 where they are small enough."""
    reduction = max(1, round(later.shape[1] / width_px))
    if reduction == 1:
        return earlier, later, camera, 1
    size = (later.shape[1] // reduction, later.shape[0] // reduction)
    return resized(earlier, size), resized(later, size), camera.scaled_to(*size), reduction


def coarse_rotation(
    earlier: NDArray[np.uint8], later: NDArray[np.uint8], camera: CameraModel
) -> NDArray[np.float64]:
    """Return the rotation that explains most of the flow between two images, from much reduced ones: a start, good to about a degree.

    Parameters
    ----------
    earlier, later
        (H, W) uint8.
    camera
        Of both.

    Returns
    -------
    (3, 3) ``later_from_earlier``; none at all where there is too little texture.
    """
    before, now, small, _ = reduced_pair(earlier, later, camera, _COARSE_WIDTH_PX)
    at = sample_grid((small.width_px, small.height_px), _COARSE_STEP_PX)
    column, row = at.T.astype(np.intp)
    strength = cv2.cornerMinEigenVal(now, 7, ksize=3)[row, column]
    chosen = strength > np.quantile(strength, 0.4)
    at = at[chosen]
    if len(at) < _COARSE_LEAST:
        return np.eye(3)
    shifted = _by_shift(before, now, small)
    rotation, missed = _turned_by_flow(before, now, small, at, shifted)
    if float(np.abs(shifted - np.eye(3)).max()) > _SHIFT_LARGE_RAD:
        # Repeated bricks match a brick away nearly as well: a large turn has to explain the picture clearly better than a small one does.
        plain, missed_plain = _turned_by_flow(before, now, small, at, np.eye(3))
        if missed > _SHIFT_GAIN * missed_plain:
            rotation = plain
    return rotation


def _turned_by_flow(
    before: NDArray[np.uint8],
    now: NDArray[np.uint8],
    camera: CameraModel,
    at: NDArray[np.float32],
    rotation: NDArray[np.float64],
) -> tuple[NDArray[np.float64], float]:
    """Return a rotation after a round of flow from a start, and the grey difference that the flow leaves at its samples."""
    search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
    turned, seen = turned_picture(before, camera, rotation)
    back = np.asarray(search.calc(now, turned, None), np.float32)  # type: ignore[call-overload]  # no start is allowed
    column, row = at.T.astype(np.intp)
    start = at + back[row, column]
    inside = cv2.remap(seen, start[:, None, 0], start[:, None, 1], cv2.INTER_NEAREST, borderValue=0.0)
    found = cv2.remap(turned, start[:, None, 0], start[:, None, 1], cv2.INTER_LINEAR).reshape(-1)
    ends, rays = camera.pixel_to_ray(at), camera.pixel_to_ray(start)
    good = (inside.reshape(-1) > 0) & np.isfinite(rays).all(axis=1) & np.isfinite(ends).all(axis=1)
    if int(good.sum()) < _COARSE_LEAST:
        return rotation, math.inf
    missed = np.abs(now[row, column].astype(np.float64) - found)[good]
    return fit_rotation(rays[good], ends[good]) @ rotation, float(missed.mean())


def _by_shift(
    earlier: NDArray[np.uint8], later: NDArray[np.uint8], camera: CameraModel
) -> NDArray[np.float64]:
    """Return the yaw and pitch that shift one picture onto the other (phase correlation): a turn of 15 degrees is too far for flow."""
    reduction = max(1, round(later.shape[1] / _SHIFT_WIDTH_PX))
    size = (later.shape[1] // reduction, later.shape[0] // reduction)
    before, now = (resized(image, size).astype(np.float32) for image in (earlier, later))
    window = cv2.createHanningWindow(size, cv2.CV_32F)
    (right, down), _ = cv2.phaseCorrelate(before, now, window)
    middle = np.array([camera.cx_px, camera.cy_px])
    start, end = camera.pixel_to_ray(np.stack([middle, middle + np.array([right, down]) * reduction]))
    if not np.isfinite(end).all():
        return np.eye(3)
    axis = np.cross(start, end)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-6:
        return np.eye(3)
    return rotation_matrix(axis / sine * np.arcsin(min(1.0, sine)))


def _refined(
    now: NDArray[np.uint8],
    turned: NDArray[np.uint8],
    at: NDArray[np.float32],
    found: NDArray[np.float32],
) -> NDArray[np.float32]:
    """Return the flow's ends after a Lucas-Kanade step at full resolution, where it stayed nearby."""
    better, status, _ = cv2.calcOpticalFlowPyrLK(
        now,
        turned,
        at[:, None],
        found[:, None].copy(),
        winSize=(LK_WINDOW_PX, LK_WINDOW_PX),
        maxLevel=0,
        criteria=_LK_CRITERIA,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    better = np.asarray(better, np.float32).reshape(-1, 2)
    kept = (status.reshape(-1) > 0) & (np.linalg.norm(better - found, axis=1) < _LK_MOST_PX)
    return np.where(kept[:, None], better, found).astype(np.float32)


def texture(
    image: NDArray[np.uint8],
    column: NDArray[np.intp],
    row: NDArray[np.intp],
    noise_grey: float,
    params: ParallaxParams,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the (N, 2, 2) information about the flow, and the larger eigenvalue (N,) of it before noise that no texture removes is added.

    Lucas-Kanade's own: the sum of the gradients' products over the window, over the variance of the grey differences.
    """
    d_x = cv2.Scharr(image, cv2.CV_32F, 1, 0, scale=1.0 / 32.0)
    d_y = cv2.Scharr(image, cv2.CV_32F, 0, 1, scale=1.0 / 32.0)
    window = (LK_WINDOW_PX, LK_WINDOW_PX)
    xx, xy, yy = (
        cv2.boxFilter(product, cv2.CV_32F, window, normalize=False)[row, column].astype(np.float64)
        for product in (d_x * d_x, d_x * d_y, d_y * d_y)
    )
    # Noise has gradients too, the same in all directions: what is left without them is texture.
    noise = LK_WINDOW_PX**2 * _SCHARR_NOISE * noise_grey**2
    xx, xy, yy = _without(xx, xy, yy, params.noise_factor * noise)
    # Neighbouring pixels are not independent (the lens, the sensor's interpolation): a quarter of them are.
    scale = 0.25 / (2.0 * max(params.grey_sigma, noise_grey) ** 2)
    loose = 1.0 / params.loose_sigma_px**2
    a, b, c = xx * scale + loose, xy * scale, yy * scale + loose
    strongest = 0.5 * (a + c) + np.sqrt(0.25 * (a - c) ** 2 + b**2)
    # Add the floor to the covariance: (T^-1 + s^2 I)^-1 = (I + s^2 T)^-1 T.
    floor = params.flow_sigma_px**2
    determinant = (1.0 + floor * a) * (1.0 + floor * c) - (floor * b) ** 2
    t_determinant = a * c - b * b
    information = np.empty((len(a), 2, 2))
    information[:, 0, 0] = (a + floor * t_determinant) / determinant
    information[:, 1, 1] = (c + floor * t_determinant) / determinant
    information[:, 0, 1] = information[:, 1, 0] = b / determinant
    return information, strongest


def _without(
    xx: NDArray[np.float64], xy: NDArray[np.float64], yy: NDArray[np.float64], noise: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return structure tensors less the noise's share of both eigenvalues, which stay at 0 or above."""
    mean, half, root = 0.5 * (xx + yy), 0.5 * (xx - yy), np.sqrt(0.25 * (xx - yy) ** 2 + xy**2)
    large, small = np.maximum(mean + root - noise, 0.0), np.maximum(mean - root - noise, 0.0)
    stretch = np.divide(0.5 * (large - small), root, out=np.zeros_like(root), where=root > 0.0)
    middle = 0.5 * (large + small)
    return middle + stretch * half, stretch * xy, middle - stretch * half


def grey_noise(image: NDArray[np.uint8]) -> float:
    """Return the standard deviation of the noise, in grey values.

    From the median size of a difference of Laplacians (Immerkaer 1996), which a plane surface and a straight ramp leave at zero; every second pixel of
    every second row tells enough.
    """
    response = cv2.filter2D(image, cv2.CV_16S, _NOISE_KERNEL)[::2, ::2]
    return float(np.median(np.abs(response))) / (0.6745 * 6.0)


def sample_grid(size: tuple[int, int], step_px: int) -> NDArray[np.float32]:
    """Return the (N, 2) points that the flow is measured at."""
    half = step_px // 2
    columns, rows = np.meshgrid(np.arange(half, size[0], step_px), np.arange(half, size[1], step_px))
    return np.column_stack([columns.ravel(), rows.ravel()]).astype(np.float32)

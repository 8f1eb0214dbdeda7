"""Flow that starts from what a sweep of planes saw: the earlier picture is drawn as it must look from the later place, and what is left is measured.

After that nothing moves by more than a few pixels and nothing grows, near or far, so a Lucas-Kanade step there and back is enough, and follows what dense flow loses.
"""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from detector.camera_model import CameraModel
from detector.parallax.depth_sweep import SweptDepth, between_lattice
from detector.parallax.egomotion import Egomotion
from detector.parallax.flow_field import (
    LK_WINDOW_PX,
    FlowField,
    grey_noise,
    reduced_pair,
    sample_grid,
    texture,
)
from detector.parallax.params import ParallaxParams

_LATTICE_PX: Final = 8
_LEVELS: Final = 1
_BRIGHTNESS_PX: Final = 41
_CRITERIA: Final = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 5, 0.03)
_LEAST_AHEAD: Final = 0.1


def measure_guided_flow(
    earlier: NDArray[np.uint8],
    later: NDArray[np.uint8],
    camera: CameraModel,
    turn: NDArray[np.float64],
    motion: Egomotion,
    swept: SweptDepth,
    params: ParallaxParams,
) -> FlowField:
    """Return the flow on a grid, as :func:`detector.parallax.flow_field.measure_flow` does, starting from a swept depth.

    Parameters
    ----------
    earlier, later
        (H, W) uint8, of the camera's size.
    camera
        Of both.
    turn
        (3, 3) ``later_from_earlier`` that the field takes out; what ``motion`` corrects.
    motion, swept
        Of this pair, from a first look.
    params
        Settings.
    """
    before, now, small, reduction = reduced_pair(earlier, later, camera, params.width_px)
    size = (small.width_px, small.height_px)
    way = _expected(small, motion, swept)
    drawn = _brightened(
        cv2.remap(before, way[..., 0], way[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), now
    )
    at = sample_grid(size, params.step_px)
    column, row = at.T.astype(np.intp)
    information, strongest = texture(now, column, row, grey_noise(now), params)
    textured = strongest > 1.0 / params.informative_sigma_px**2
    found, believed = at.astype(np.float64), np.zeros(len(at), np.bool_)
    if textured.any():
        seeds = at[textured]
        ends, followed, unlike_grey = _followed(now, drawn, seeds)
        home, returned, _ = _followed(drawn, now, ends)
        alike = unlike_grey <= params.unlike_share * (_contrast(now)[row[textured], column[textured]] + 1.0)
        missed = (home - seeds).astype(np.float64)
        limit = (params.round_trip_px / params.flow_sigma_px) ** 2
        good = (
            followed
            & returned
            & alike
            & (np.einsum("ni,nij,nj->n", missed, information[textured], missed) < limit)
        )
        source = cv2.remap(
            way, ends[:, None, 0], ends[:, None, 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        ).reshape(-1, 2)
        source = np.asarray(source, np.float64)
        inside = (source >= 0.0).all(axis=1) & (source <= np.array(size) - 1.0).all(axis=1)
        turned = small.ray_to_pixel(np.nan_to_num(small.pixel_to_ray(source)) @ turn.T)
        seen = np.asarray(np.isfinite(turned).all(axis=1), np.bool_)
        found[textured] = np.where(seen[:, None], turned, found[textured])
        # What was out of the earlier picture has no match there, and a tile or a brick that looks like it is no match.
        lost = swept.further_unseen_at(small.pixel_to_ray(seeds.astype(np.float64)))
        believed[textured] = good & inside & seen & ~lost
    return FlowField.of_reduced(reduction, at, found, information, turn, textured, believed, camera, swept)


def _expected(camera: CameraModel, motion: Egomotion, swept: SweptDepth) -> NDArray[np.float32]:
    """Return where each pixel of the later picture is expected in the earlier one, (H, W, 2)."""
    width, height = camera.width_px, camera.height_px
    x = np.linspace(0.0, width - 1.0, max(2, width // _LATTICE_PX + 1))
    y = np.linspace(0.0, height - 1.0, max(2, height // _LATTICE_PX + 1))
    at = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    rays = camera.pixel_to_ray(at)
    rays /= rays[:, 2:]
    points = rays + swept.smooth_at(rays)[:, None] * motion.direction_later
    points[:, 2] = np.maximum(points[:, 2], _LEAST_AHEAD)
    source = camera.ray_to_pixel(points @ motion.later_from_earlier)
    offset = np.nan_to_num(source - at, nan=4.0 * width)
    return between_lattice(offset.reshape(len(y), len(x), 2), (width, height))


def _brightened(drawn: cv2.typing.MatLike, now: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a picture with the local mean of another: exposure changes from frame to frame, and Lucas-Kanade takes that for motion."""
    window = (_BRIGHTNESS_PX, _BRIGHTNESS_PX)
    ours, theirs = cv2.blur(drawn, window), cv2.blur(now, window)
    return np.asarray(
        cv2.subtract(cv2.add(drawn, cv2.subtract(theirs, ours)), cv2.subtract(ours, theirs)), np.uint8
    )


def _followed(
    start: NDArray[np.uint8], end: NDArray[np.uint8], at: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.bool_], NDArray[np.float32]]:
    """Return where points of one picture are in one nearly like it, whether they could be followed, and by how many grey values the two places differ."""
    found, status, unlike = cv2.calcOpticalFlowPyrLK(
        start,
        end,
        at[:, None],
        at[:, None].copy(),
        winSize=(LK_WINDOW_PX, LK_WINDOW_PX),
        maxLevel=_LEVELS,
        criteria=_CRITERIA,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    return (
        np.asarray(found, np.float32).reshape(-1, 2),
        np.asarray(status.reshape(-1) > 0),
        np.asarray(unlike, np.float32).reshape(-1),
    )


def _contrast(image: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return the standard deviation of the grey values about each pixel."""
    window = (LK_WINDOW_PX, LK_WINDOW_PX)
    grey = image.astype(np.float32)
    mean = cv2.blur(grey, window)
    return np.asarray(np.sqrt(np.maximum(cv2.blur(grey * grey, window) - mean * mean, 0.0)), np.float32)

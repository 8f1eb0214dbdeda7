"""Depth of a pair on a coarse grid by a sweep of planes: which distance makes the two pictures agree, asked of every place at once.

Flow follows a surface from frame to frame, and loses what is near: it moves by a hundred pixels and grows by half meanwhile. Once the motion is roughly known a
surface can only have moved as its distance says, growth included. So the earlier picture is drawn as it would look if everything lay on a plane across the line of sight, for planes from
far to near (Collins 1996), and each place takes the plane that fits. Plain walls fit any plane a little; neighbours decide there, by semi-global matching (Hirschmueller 2008): what is
cheapest along four lines through the grid, with a price on steps in depth.

What comes out is coarse (a plane is a few percent of the distance from the next), but it is there for nearly every place of the picture, and it says where it is not to be trusted.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from detector.camera_model import CameraModel
from detector.parallax.params import ParallaxParams

_WIDTH_PX: Final = 160
"""Of the pictures that are compared: what moves by a hundred pixels in the camera's image moves by a few planes here."""
_CELL_PX: Final = 2
_CONTRAST_PX: Final = 7
"""Window of the local mean and contrast that are taken out: pictures of one wall may differ in brightness."""
_LEAST_CONTRAST: Final = 3.0
"""Grey values. Contrast below it is noise rather than texture, and is not raised to full height."""
_WINDOW_PX: Final = 7
_MOST_COST: Final = 1.6
"""In units of the contrast: a place that fits not at all costs no more than this."""
_UNSEEN_COST: Final = 0.4 * _MOST_COST
"""Of a plane on which a place would not have been in the earlier picture: neither for nor against it."""
_STEP_COST: Final = 0.2
_JUMP_COST: Final = 1.6
_PATHS: Final = 4
_NEIGHBOURING: Final = 3
"""Planes so near to the best one are the same answer."""
_LATTICE_PX: Final = 16
_LEAST_AHEAD: Final = 0.25
"""A point is not looked for where it would have been nearer to the earlier camera than this share of its depth now (flying backwards)."""


@dataclass(frozen=True, slots=True)
class SweptDepth:
    """Inverse depth about the later camera, on a grid over a reduced picture without distortion.

    Attributes
    ----------
    camera
        Of the reduced picture.
    inverse_depth
        (h, w) 1/baseline, along the later camera's axis.
    margin
        (h, w) by how much the best plane fits better than any other that is not its neighbour, in units of the local contrast.
    sigma
        Standard deviation of ``inverse_depth`` where it is clear, 1/baseline.
    further_unseen
        (h, w) where the earlier picture does not hold all places that lie further away than ``inverse_depth`` says: the true one may be among them, and whatever else looks alike
        is taken for it.
    """

    camera: CameraModel
    inverse_depth: NDArray[np.float32]
    margin: NDArray[np.float32]
    sigma: float
    further_unseen: NDArray[np.bool_]

    def at(self, rays: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return inverse depth and margin (N,) in the cells of rays; margin 0 outside the picture.

        Parameters
        ----------
        rays
            (N, 3) in the later camera's axes, any length.
        """
        at_row, at_column, inside = self._nearest(rays)
        return (
            np.where(inside, self.inverse_depth[at_row, at_column], 0.0).astype(np.float64),
            np.where(inside, self.margin[at_row, at_column], 0.0).astype(np.float64),
        )

    def further_unseen_at(self, rays: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return ``further_unseen`` (N,) in the cells of rays (N, 3); outside the picture that of the nearest cell."""
        row, column, _ = self._nearest(rays)
        return np.asarray(self.further_unseen[row, column], np.bool_)

    def smooth_at(self, rays: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the inverse depth (N,) between the cells, a little smoothed: what the flow starts from, without steps."""
        cells = np.nan_to_num(self._cells(rays), nan=-1e4).astype(np.float32)
        smooth = cv2.GaussianBlur(self.inverse_depth, (0, 0), 1.0)
        found = cv2.remap(
            smooth, cells[:, None, 0], cells[:, None, 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        return np.asarray(found, np.float64).reshape(-1)

    def _nearest(
        self, rays: NDArray[np.float64]
    ) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.bool_]]:
        cells = np.nan_to_num(self._cells(rays), nan=-1.0)
        most = np.array(self.inverse_depth.shape[::-1]) - 1
        inside = ((cells > -0.5) & (cells < most + 0.5)).all(axis=1)
        column, row = np.clip(np.rint(cells), 0, most).astype(np.intp).T
        return row, column, np.asarray(inside, np.bool_)

    def _cells(self, rays: NDArray[np.float64]) -> NDArray[np.float64]:
        return (self.camera.ray_to_pixel(rays) - _CELL_PX // 2) / _CELL_PX


def sweep_depth(
    earlier: NDArray[np.uint8],
    later: NDArray[np.uint8],
    camera: CameraModel,
    later_from_earlier: NDArray[np.float64],
    direction_later: NDArray[np.float64],
    params: ParallaxParams,
) -> SweptDepth:
    """Return the depth of a pair whose motion is roughly known (the direction to some degrees, the rotation to some tenths).

    Parameters
    ----------
    earlier, later
        (H, W) uint8, of the camera's size.
    camera
        Of both.
    later_from_earlier
        (3, 3) rotation that takes coordinates of the earlier camera to those of the later one.
    direction_later
        (3,) unit vector from the earlier to the later position, in the later camera's axes.
    params
        Settings.
    """
    reduced = _reduced_camera(camera)
    before = _contrast(_seen_by(reduced, earlier, camera, later_from_earlier))
    now = _contrast(_seen_by(reduced, later, camera, np.eye(3)))
    # Equal steps of this figure are about equal steps of the flow: a place at x from the focus moves by x times it.
    closeness = np.linspace(0.0, params.sweep_nearest, params.sweep_planes)
    inverse = closeness / np.maximum(1.0 - closeness, 1e-6)
    inverse = inverse[1.0 + inverse * direction_later[2] > _LEAST_AHEAD]
    cost = np.stack([_plane_cost(now, before, reduced, direction_later, float(each)) for each in inverse])
    unseen = np.isnan(cost)
    cost[unseen] = _UNSEEN_COST
    total = _aggregated(cost)
    best = np.argmin(total, axis=0).astype(np.int16)
    place, count = np.arange(len(inverse), dtype=np.int16)[:, None, None], len(inverse)
    others = np.where(np.abs(place - best) > _NEIGHBOURING, total, np.inf)
    margin = others.min(axis=0) - total.min(axis=0)
    # Where a further plane was not in the earlier picture it may be the true one; and the least cost at the end of the range is no least.
    further_unseen = (unseen & (place < best)).any(axis=0)
    clear = np.isfinite(margin) & ~further_unseen & (best < count - 1)
    return SweptDepth(
        reduced,
        np.interp(_between(total, best), np.arange(count), inverse).astype(np.float32),
        np.where(clear, margin / _PATHS, 0.0).astype(np.float32),
        params.swept_sigma if count > 1 else np.inf,
        np.asarray(further_unseen, np.bool_),
    )


def _reduced_camera(camera: CameraModel) -> CameraModel:
    """Return the camera of the pictures that are compared: small, and without distortion, so that a plane's picture is only shifted and scaled."""
    reduction = max(1, round(camera.width_px / _WIDTH_PX))
    small = camera.scaled_to(camera.width_px // reduction, camera.height_px // reduction)
    return CameraModel(small.width_px, small.height_px, small.fx_px, small.fy_px, small.cx_px, small.cy_px)


def _seen_by(
    reduced: CameraModel, image: NDArray[np.uint8], camera: CameraModel, turn: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Return an image as the reduced camera would have seen it after a turn; NaN where nothing was seen."""
    size = (reduced.width_px, reduced.height_px)
    if not camera.is_distorted and np.array_equal(turn, np.eye(3)):
        return resized(image, size).astype(np.float32)
    # Turned at the double size: at the small one the turn's own smoothing would take texture off one of the two pictures.
    double = (2 * size[0], 2 * size[1])
    if image.shape[1] < double[0]:
        double = size
    source, target = camera.scaled_to(*double), reduced.scaled_to(*double)
    x, y = (np.linspace(0.0, side - 1.0, max(2, side // _LATTICE_PX + 1)) for side in double)
    lattice = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    at = np.nan_to_num(source.ray_to_pixel(target.pixel_to_ray(lattice) @ turn) - lattice, nan=-1e4)
    way = between_lattice(at.reshape(len(y), len(x), 2), double)
    turned = cv2.remap(
        resized(image, double).astype(np.float32),
        way[..., 0],
        way[..., 1],
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=np.nan,
    )
    return np.asarray(
        turned if double == size else cv2.resize(turned, size, interpolation=cv2.INTER_AREA), np.float32
    )


def between_lattice(offset: NDArray[np.float64], size: tuple[int, int]) -> NDArray[np.float32]:
    """Return the map (H, W, 2) of a picture's pixels to where they are taken from, of which the offsets are known on a lattice from corner to corner."""
    pixels, places = _lattice_places(*size, offset.shape[1], offset.shape[0])
    way = np.asarray(cv2.remap(offset.astype(np.float32), places, None, cv2.INTER_LINEAR), np.float32)  # type: ignore[call-overload]  # one map of both coordinates
    way += pixels
    return way


@lru_cache(maxsize=8)
def _lattice_places(
    width: int, height: int, columns: int, rows: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return each pixel (H, W, 2), and where it lies on a lattice from corner to corner."""
    pixels = np.stack(
        np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32)), axis=-1
    )
    # cv2.resize would take the lattice for the middles of cells.
    scale = np.array([(columns - 1) / (width - 1), (rows - 1) / (height - 1)], np.float32)
    places = pixels * scale
    pixels.setflags(write=False)
    places.setflags(write=False)
    return pixels, places


def resized(image: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.uint8]:
    """Return an image at a width and height that are no larger; itself where it has them."""
    if image.shape[::-1] == size:
        return image
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def _contrast(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return an image without its local mean, over its local contrast; NaN stays NaN."""
    unseen = np.isnan(image)
    filled = np.where(unseen, 0.0, image).astype(np.float32)
    window = (_CONTRAST_PX, _CONTRAST_PX)
    off = filled - cv2.blur(filled, window)
    spread = np.sqrt(np.maximum(cv2.blur(off * off, window), 0.0)) + _LEAST_CONTRAST
    return np.where(unseen, np.nan, off / spread).astype(np.float32)


def _plane_cost(
    now: NDArray[np.float32],
    before: NDArray[np.float32],
    camera: CameraModel,
    direction: NDArray[np.float64],
    inverse: float,
) -> NDArray[np.float32]:
    """Return how badly each cell (h, w) fits a plane across the optical axis; NaN where it would not have been in the earlier picture."""
    # (x, y, 1) + inverse * direction, seen from the earlier position: a shift and a scale, the same for the whole picture.
    scale = 1.0 / (1.0 + inverse * float(direction[2]))
    shift_x = camera.fx_px * inverse * float(direction[0]) * scale + camera.cx_px * (1.0 - scale)
    shift_y = camera.fy_px * inverse * float(direction[1]) * scale + camera.cy_px * (1.0 - scale)
    drawn = cv2.warpAffine(
        before,
        np.array([[scale, 0.0, shift_x], [0.0, scale, shift_y]]),
        (camera.width_px, camera.height_px),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=np.nan,
    )
    missed = np.minimum(np.abs(now - drawn), _MOST_COST)
    unseen = np.isnan(missed)
    missed[unseen] = _UNSEEN_COST
    blurred = cv2.blur(missed, (_WINDOW_PX, _WINDOW_PX), borderType=cv2.BORDER_REFLECT)
    blurred[unseen] = np.nan
    half = _CELL_PX // 2
    return np.asarray(blurred[half::_CELL_PX, half::_CELL_PX], np.float32)


def _aggregated(cost: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the costs (planes, h, w) with those of the cheapest ways to each cell along its row and its column, from both sides."""
    upright, level = cost.transpose(1, 0, 2), cost.transpose(2, 0, 1)
    return np.asarray(
        _both_ways(upright).transpose(1, 0, 2) + _both_ways(level).transpose(1, 2, 0), np.float32
    )


def _both_ways(cost: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the costs (length, planes, n) of the cheapest ways along the first axis, forth and back."""
    side = cost.shape[2]
    total = np.concatenate([cost, cost[::-1]], axis=2)
    last = total[0]
    for index in range(1, len(total)):
        least = last.min(axis=0)
        way = np.minimum(last, least + _JUMP_COST)
        stepped = last + _STEP_COST
        np.minimum(way[1:], stepped[:-1], out=way[1:])
        np.minimum(way[:-1], stepped[1:], out=way[:-1])
        way -= least
        last = total[index]
        last += way
    return np.asarray(total[:, :, :side] + total[::-1, :, side:], np.float32)


def _between(total: NDArray[np.float32], best: NDArray[np.int16]) -> NDArray[np.float64]:
    """Return the place of the least cost between the planes, by the parabola through the best one and its neighbours."""
    count = len(total)
    if count < 3:
        return best.astype(np.float64)
    middle = np.clip(best, 1, count - 2).astype(np.intp)
    below, at, above = (
        np.take_along_axis(total, middle[None] + step, axis=0)[0].astype(np.float64) for step in (-1, 0, 1)
    )
    bend = np.maximum(below - 2.0 * at + above, 1e-6)
    return np.asarray(middle + np.clip(0.5 * (below - above) / bend, -1.0, 1.0))

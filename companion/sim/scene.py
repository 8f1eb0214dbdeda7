"""Rooms of textured rectangles, ray-cast: a camera's view of a world in which every distance is known.

The world is local NED with the floor at down = 0. Everything is a pure function of sizes and a seed: the same scene, camera and
pose give the same image, bit for bit. For a pinhole, 1 / z, u / z and v / z of a plane are linear in the pixel, so a view is a few array
operations for each rectangle, a depth buffer, and one texture look-up for each surface that is seen.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from detector.camera_model import CameraModel

_NEAR_M: Final = 0.02
_BACKGROUND_GREY: Final = 96
_TEXELS_PER_M: Final = 128.0
_MAX_TEXTURE_SIDE: Final = 2048
_MIP_LEVELS: Final = 8
_MIP_GUARD_TEXELS: Final = 2  # between the levels, so that bilinear look-ups do not bleed
_VERTICAL_TOLERANCE: Final = 0.2  # |down| of a unit normal up to which a surface counts as a wall


class Texture(StrEnum):
    """What a surface looks like."""

    BRICK = "brick"
    TILE = "tile"
    PLASTER = "plaster"


@dataclass(frozen=True, slots=True)
class Rectangle:
    """One flat surface, visible from both sides.

    Attributes
    ----------
    corner_m
        One corner, local NED.
    along_m, across_m
        The two sides that start there, as vectors; perpendicular to each other.
    texture, seed
        Its look.
    brightness
        Factor on the grey values, so that neighbouring surfaces part visibly.
    """

    corner_m: tuple[float, float, float]
    along_m: tuple[float, float, float]
    across_m: tuple[float, float, float]
    texture: Texture = Texture.BRICK
    seed: int = 0
    brightness: float = 1.0

    def __post_init__(self) -> None:
        along, across = np.array(self.along_m), np.array(self.across_m)
        lengths = np.linalg.norm(along), np.linalg.norm(across)
        if min(lengths) < 1e-3:
            raise ValueError(f"a rectangle's sides must be at least 1 mm long, got {lengths}")
        if abs(float(along @ across)) > 1e-6 * float(lengths[0] * lengths[1]):
            raise ValueError(
                f"a rectangle's sides must be perpendicular, got {self.along_m} and {self.across_m}"
            )


class _Surface:
    """A rectangle made ready for rendering: its plane, and its texture with all its smaller copies side by side."""

    def __init__(self, rectangle: Rectangle) -> None:
        self.corner_m = np.array(rectangle.corner_m, dtype=np.float64)
        self.along_m = np.array(rectangle.along_m, dtype=np.float64)
        self.across_m = np.array(rectangle.across_m, dtype=np.float64)
        self.length_m = float(np.linalg.norm(self.along_m))
        self.width_m = float(np.linalg.norm(self.across_m))
        self.normal = np.cross(self.along_m, self.across_m) / (self.length_m * self.width_m)
        # Gradients of the coordinates u, v in [0, 1] over the rectangle.
        self.u_gradient = self.along_m / self.length_m**2
        self.v_gradient = self.across_m / self.width_m**2
        texels_per_m = min(_TEXELS_PER_M, _MAX_TEXTURE_SIDE / max(self.length_m, self.width_m))
        if (
            max(self.length_m, self.width_m) * _TEXELS_PER_M < 256.0
        ):  # small things are looked at from near by
            texels_per_m = 256.0 / max(self.length_m, self.width_m)
        texture = _draw_texture(rectangle, self.length_m, self.width_m, texels_per_m)
        self.texture_height, self.texture_width = texture.shape
        self.atlas, self.level_x, self.level_y, self.level_scale = _mip_atlas(texture)

    @property
    def is_vertical(self) -> bool:
        return abs(float(self.normal[2])) <= _VERTICAL_TOLERANCE

    def corners_m(self) -> NDArray[np.float64]:
        sides = np.array([np.zeros(3), self.along_m, self.along_m + self.across_m, self.across_m])
        return np.asarray(self.corner_m + sides, dtype=np.float64)


class Scene:
    """A world of rectangles.

    Parameters
    ----------
    rectangles
        Its surfaces. Drawing their textures takes some 0.1 s each, once.
    """

    def __init__(self, rectangles: tuple[Rectangle, ...]) -> None:
        if not rectangles:
            raise ValueError("a scene needs at least one rectangle")
        self.rectangles = rectangles
        self._surfaces = tuple(_Surface(rectangle) for rectangle in rectangles)

    def render(
        self,
        camera: CameraModel,
        position_ned_m: ArrayLike,
        r_ned_from_camera: ArrayLike,
        *,
        supersample: int = 2,
    ) -> NDArray[np.uint8]:
        """Give the grey image that a camera takes.

        Parameters
        ----------
        camera
            Its size and lens.
        position_ned_m
            (3,), local NED.
        r_ned_from_camera
            (3, 3), camera frame (x right, y down, z forward) to local NED.
        supersample
            Rays for each pixel and axis; 1 is faster, and coarser on surfaces seen at a flat angle.

        Returns
        -------
        (height_px, width_px) uint8.
        """
        view = _View(camera, position_ned_m, r_ned_from_camera, supersample)
        nearest, inverse_depth = self._nearest(view)
        grey = np.full(view.shape, _BACKGROUND_GREY, dtype=np.uint8)
        for index, surface in enumerate(self._surfaces):
            _paint(view, surface, nearest == index, inverse_depth, grey)
        if supersample > 1:
            return np.asarray(
                cv2.resize(grey, (camera.width_px, camera.height_px), interpolation=cv2.INTER_AREA),
                dtype=np.uint8,
            )
        return grey

    def depth(
        self, camera: CameraModel, position_ned_m: ArrayLike, r_ned_from_camera: ArrayLike
    ) -> NDArray[np.float64]:
        """Give the true depth of each pixel's centre, along the camera's axis.

        Returns
        -------
        (height_px, width_px), metres; infinite where nothing is hit.
        """
        view = _View(camera, position_ned_m, r_ned_from_camera, 1)
        _, inverse_depth = self._nearest(view)
        with np.errstate(divide="ignore"):
            return np.asarray(1.0 / inverse_depth.astype(np.float64))

    def range_along(self, position_ned_m: ArrayLike, direction_ned: ArrayLike) -> float:
        """Give the distance to the first surface along a direction (of any length), infinite if there is none."""
        position = np.asarray(position_ned_m, dtype=np.float64)
        direction = np.asarray(direction_ned, dtype=np.float64)
        direction = direction / np.linalg.norm(direction)
        least_m = math.inf
        for surface in self._surfaces:
            approach = float(direction @ surface.normal)
            if abs(approach) < 1e-12:
                continue
            distance_m = float((surface.corner_m - position) @ surface.normal) / approach
            if not 0.0 <= distance_m < least_m:
                continue
            offset = position + distance_m * direction - surface.corner_m
            u, v = float(offset @ surface.u_gradient), float(offset @ surface.v_gradient)
            if 0.0 <= u <= 1.0 and 0.0 <= v <= 1.0:
                least_m = distance_m
        return least_m

    def clearance(self, position_ned_m: ArrayLike, *, half_height_m: float = 0.2) -> float:
        """Give the horizontal distance to the nearest wall, of those that reach into the vehicle's height.

        Parameters
        ----------
        position_ned_m
            (3,), the vehicle's middle.
        half_height_m
            Walls that end above or below this much of it do not count.
        """
        position = np.asarray(position_ned_m, dtype=np.float64)
        least_m = math.inf
        for surface in self._surfaces:
            corners = surface.corners_m()
            down = corners[:, 2]
            if not surface.is_vertical or not (
                down.min() - half_height_m < position[2] < down.max() + half_height_m
            ):
                continue
            along = np.array([-surface.normal[1], surface.normal[0]])
            along /= np.linalg.norm(along)
            reach = (corners[:, :2] - position[:2]) @ along
            beside = (corners[:, :2] - position[:2]) @ np.array([-along[1], along[0]])
            distance_along = max(float(reach.min()), -float(reach.max()), 0.0)
            distance_beside = max(float(beside.min()), -float(beside.max()), 0.0)
            least_m = min(least_m, math.hypot(distance_along, distance_beside))
        return least_m

    def _nearest(self, view: _View) -> tuple[NDArray[np.int16], NDArray[np.float32]]:
        """Depth buffer: index of the surface at each sample (-1: none) and 1 / z (0: none)."""
        nearest = np.full(view.shape, -1, dtype=np.int16)
        best = np.zeros(view.shape, dtype=np.float32)
        for index, surface in enumerate(self._surfaces):
            window = view.window(surface)
            if window is None:
                continue
            inverse_depth, u, v = view.planes(surface, window)
            hit = inverse_depth > best[window]
            hit &= inverse_depth < 1.0 / _NEAR_M
            # 0 <= u / w <= 1 without the division
            hit &= u >= 0.0
            hit &= v >= 0.0
            hit &= u <= inverse_depth
            hit &= v <= inverse_depth
            np.copyto(best[window], inverse_depth, where=hit)
            nearest[window][hit] = index
        return nearest, best


_Window = tuple[slice, slice]


class _View:
    """A camera at a place: the rays of its samples, and planes expressed in them."""

    def __init__(
        self, camera: CameraModel, position_ned_m: ArrayLike, r_ned_from_camera: ArrayLike, supersample: int
    ) -> None:
        if supersample < 1:
            raise ValueError(f"supersample must be at least 1, got {supersample}")
        self.position_m = np.asarray(position_ned_m, dtype=np.float64)
        self.r_camera_from_ned = np.asarray(r_ned_from_camera, dtype=np.float64).T
        if self.position_m.shape != (3,) or self.r_camera_from_ned.shape != (3, 3):
            raise ValueError(
                f"expected a position (3,) and a rotation (3, 3), got {self.position_m.shape} and {self.r_camera_from_ned.shape}"
            )
        self.shape = (camera.height_px * supersample, camera.width_px * supersample)
        self.pixel_area = 1.0 / (camera.fx_px * camera.fy_px * supersample**2)
        x_px = (np.arange(self.shape[1]) + 0.5) / supersample - 0.5
        y_px = (np.arange(self.shape[0]) + 0.5) / supersample - 0.5
        if camera.is_distorted:
            grid = np.stack(np.meshgrid(x_px, y_px), axis=-1).reshape(-1, 2)
            rays = camera.pixel_to_ray(grid)
            self.x = (rays[:, 0] / rays[:, 2]).reshape(self.shape).astype(np.float32)
            self.y = (rays[:, 1] / rays[:, 2]).reshape(self.shape).astype(np.float32)
        else:  # a row and a column say it all
            self.x = ((x_px - camera.cx_px) / camera.fx_px).astype(np.float32)[None, :]
            self.y = ((y_px - camera.cy_px) / camera.fy_px).astype(np.float32)[:, None]
        self._x_of_column = None if camera.is_distorted else self.x[0]
        self._y_of_row = None if camera.is_distorted else self.y[:, 0]

    def window(self, surface: _Surface) -> _Window | None:
        """Return the samples that the surface can reach, or None when it lies behind the camera."""
        corners = (surface.corners_m() - self.position_m) @ self.r_camera_from_ned.T
        if (corners[:, 2] < _NEAR_M).all():
            return None
        everything = (slice(0, self.shape[0]), slice(0, self.shape[1]))
        if (corners[:, 2] < _NEAR_M).any() or self._x_of_column is None or self._y_of_row is None:
            return everything
        flat = corners[:, :2] / corners[:, 2:3]
        columns = np.searchsorted(self._x_of_column, [flat[:, 0].min(), flat[:, 0].max()])
        rows = np.searchsorted(self._y_of_row, [flat[:, 1].min(), flat[:, 1].max()])
        if columns[0] == columns[1] or rows[0] == rows[1]:
            return None
        return (
            slice(max(int(rows[0]) - 1, 0), int(rows[1]) + 1),
            slice(max(int(columns[0]) - 1, 0), int(columns[1]) + 1),
        )

    def planes(
        self, surface: _Surface, window: _Window
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        """1 / z, u / z and v / z of the surface's plane in the window."""
        normal = self.r_camera_from_ned @ surface.normal
        offset = surface.corner_m - self.position_m
        distance_m = float(offset @ surface.normal)
        if abs(distance_m) < 1e-9:  # seen edge-on: nothing to see
            distance_m = math.inf
        inverse = normal / distance_m
        u = self.r_camera_from_ned @ surface.u_gradient - float(offset @ surface.u_gradient) * inverse
        v = self.r_camera_from_ned @ surface.v_gradient - float(offset @ surface.v_gradient) * inverse
        return self._linear(inverse, window), self._linear(u, window), self._linear(v, window)

    def texel_scale(self, surface: _Surface) -> float:
        """Texels across a sample at z = 1 m: the root of the determinant of the map from samples to texels (it grows with z^1.5)."""
        distance_m = abs(float((surface.corner_m - self.position_m) @ surface.normal))
        texels_per_m2 = surface.texture_width * surface.texture_height / (surface.length_m * surface.width_m)
        # An area A on the image plane at z = 1 covers A z^3 / distance on a plane: z^2 for the size, z / distance for the slant.
        return math.sqrt(self.pixel_area * texels_per_m2 / max(distance_m, 1e-9))

    def _linear(self, coefficients: NDArray[np.float64], window: _Window) -> NDArray[np.float32]:
        a, b, c = (np.float32(value) for value in coefficients)
        rows, columns = window
        if self._x_of_column is None:
            return np.asarray(a * self.x[window] + (b * self.y[window] + c), dtype=np.float32)
        return np.asarray(a * self.x[:, columns] + (b * self.y[rows] + c), dtype=np.float32)


def _paint(
    view: _View,
    surface: _Surface,
    seen: NDArray[np.bool_],
    inverse_depth: NDArray[np.float32],
    grey: NDArray[np.uint8],
) -> None:
    """Look the surface's texture up where it is seen, between the two copies whose texels fit the samples' size."""
    rows, columns = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
    if rows.size == 0:
        return
    window = (slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1))
    mask = seen[window]
    _, u, v = view.planes(surface, window)
    # Outside the surface the plane may lie behind the camera; those samples are masked, but must stay finite.
    z = np.reciprocal(np.where(mask, inverse_depth[window], np.float32(1.0)))
    x = np.asarray(u * z * np.float32(surface.texture_width), dtype=np.float32)
    y = np.asarray(v * z * np.float32(surface.texture_height), dtype=np.float32)
    level = 1.5 * np.log2(z) + np.float32(math.log2(view.texel_scale(surface)))
    np.clip(level, 0.0, len(surface.level_x) - 1.001, out=level)
    lower = level.astype(np.int32)
    finer = _look_up(surface, x, y, lower)
    if len(surface.level_x) > 1 and float(level[mask].max(initial=0.0)) > 0.0:
        coarser = _look_up(surface, x, y, lower + 1)
        finer += (level - lower) * (coarser - finer)
    np.copyto(grey[window], np.rint(finer).astype(np.uint8), where=mask)


def _look_up(
    surface: _Surface, x: NDArray[np.float32], y: NDArray[np.float32], level: NDArray[np.int32]
) -> NDArray[np.float32]:
    scale = surface.level_scale[level]
    map_x = x * scale + surface.level_x[level]
    map_y = y * scale + surface.level_y[level]
    return np.asarray(
        cv2.remap(surface.atlas, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE),
        dtype=np.float32,
    )


def _mip_atlas(
    texture: NDArray[np.uint8],
) -> tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Put a texture and its halved copies into one image.

    Returns
    -------
    The image, and for each level x and y of its origin and its scale, so that (texel of level 0) * scale + origin is its place.
    """
    guard = _MIP_GUARD_TEXELS
    levels = [texture]
    while len(levels) < _MIP_LEVELS and min(levels[-1].shape) >= 8:
        height, width = levels[-1].shape
        half = cv2.resize(levels[-1], ((width + 1) // 2, (height + 1) // 2), interpolation=cv2.INTER_AREA)
        levels.append(np.asarray(half, dtype=np.uint8))
    padded = [
        np.asarray(cv2.copyMakeBorder(level, guard, guard, guard, guard, cv2.BORDER_REPLICATE))
        for level in levels
    ]
    side_width = max((level.shape[1] for level in padded[1:]), default=0)
    height = max(padded[0].shape[0], sum(level.shape[0] for level in padded[1:]))
    atlas = np.zeros((height, padded[0].shape[1] + side_width), dtype=np.uint8)
    origin_x, origin_y, scale = [], [], []
    left, top = 0, 0
    for number, level in enumerate(padded):
        atlas[top : top + level.shape[0], left : left + level.shape[1]] = level
        # Texel centres are at half-integers of the texture and at whole numbers of the image.
        origin_x.append(left + guard - 0.5)
        origin_y.append(top + guard - 0.5)
        scale.append((level.shape[0] - 2 * guard) / texture.shape[0])
        if number == 0:
            left = level.shape[1]
        else:
            top += level.shape[0]
    return (
        atlas,
        np.array(origin_x, dtype=np.float32),
        np.array(origin_y, dtype=np.float32),
        np.array(scale, dtype=np.float32),
    )


def _draw_texture(
    rectangle: Rectangle, length_m: float, width_m: float, texels_per_m: float
) -> NDArray[np.uint8]:
    """Draw bricks, tiles or plaster with patches, over noise of several wavelengths, in a dark frame (skirting)."""
    rng = np.random.default_rng([rectangle.seed, len(rectangle.texture)])
    # Sides are multiples of the coarsest level's texel, so that every level is an exact half of the one before.
    step = 2 ** (_MIP_LEVELS - 1)
    width = max(step, round(length_m * texels_per_m / step) * step)
    height = max(step, round(width_m * texels_per_m / step) * step)
    per_m_x, per_m_y = width / length_m, height / width_m
    grey = np.full((height, width), 128.0, dtype=np.float32)
    for wavelength_m, amplitude in ((1.6, 14.0), (0.4, 12.0), (0.1, 7.0), (0.03, 4.0)):
        columns, rows = math.ceil(length_m / wavelength_m) + 3, math.ceil(width_m / wavelength_m) + 3
        if columns > width or rows > height:
            continue
        coarse = rng.normal(0.0, amplitude, (rows, columns)).astype(np.float32)
        grey += cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    if rectangle.texture is Texture.BRICK:
        _draw_courses(grey, rng, (0.25 * per_m_x, 0.083 * per_m_y), 0.012 * per_m_x, stagger=True)
    elif rectangle.texture is Texture.TILE:
        _draw_courses(grey, rng, (0.4 * per_m_x, 0.4 * per_m_y), 0.012 * per_m_x, stagger=False)
    else:
        _draw_patches(grey, rng, length_m, width_m, (per_m_x, per_m_y))
    frame_x, frame_y = round(0.06 * per_m_x), round(0.06 * per_m_y)
    inside = np.zeros(grey.shape, dtype=np.bool_)
    inside[frame_y : height - frame_y, frame_x : width - frame_x] = True
    grey[~inside] *= 0.35
    grey *= rectangle.brightness
    return np.clip(grey, 4.0, 251.0).astype(np.uint8)


def _draw_courses(
    grey: NDArray[np.float32],
    rng: np.random.Generator,
    size: tuple[float, float],
    joint: float,
    *,
    stagger: bool,
) -> None:
    """Give each brick or tile its own shade, and dark joints between them; sizes in texels."""
    height, width = grey.shape
    y, x = np.arange(height, dtype=np.float32)[:, None], np.arange(width, dtype=np.float32)[None, :]
    row = np.floor(y / size[1]).astype(np.int32)
    shift = (row % 2) * (0.5 * size[0] if stagger else 0.0)
    column = np.floor((x + shift) / size[0]).astype(np.int32)
    shades = rng.normal(0.0, 26.0, (int(row.max()) + 1, int(column.max()) + 1)).astype(np.float32)
    grey += shades[row, column]
    in_joint = (np.mod(y, size[1]) < joint) | (np.mod(x + shift, size[0]) < joint)
    grey[in_joint] = 0.5 * grey[in_joint] + 15.0


def _draw_patches(
    grey: NDArray[np.float32],
    rng: np.random.Generator,
    length_m: float,
    width_m: float,
    per_m: tuple[float, float],
) -> None:
    """Hang posters, switches and stains on a plastered wall: about six on each square metre."""
    for _ in range(int(6 * length_m * width_m) + 4):
        side_x, side_y = np.exp(rng.uniform(math.log(0.05), math.log(0.5), 2))
        left, top = rng.uniform(0, length_m), rng.uniform(0, width_m)
        box = grey[
            int(top * per_m[1]) : int((top + side_y) * per_m[1]) + 1,
            int(left * per_m[0]) : int((left + side_x) * per_m[0]) + 1,
        ]
        box += np.float32(rng.normal(0.0, 38.0))


def _box_inside(
    north_m: tuple[float, float], east_m: tuple[float, float], height_m: float, seed: int
) -> tuple[Rectangle, ...]:
    """Floor, ceiling and four walls, seen from within; the floor is at down = 0."""
    (south, north), (west, east) = north_m, east_m
    length, width = north - south, east - west
    up = (0.0, 0.0, -height_m)
    return (
        Rectangle((south, west, 0.0), (length, 0, 0), (0, width, 0), Texture.TILE, seed, 0.85),
        Rectangle((south, west, -height_m), (length, 0, 0), (0, width, 0), Texture.PLASTER, seed + 1, 1.25),
        Rectangle((south, west, 0.0), (length, 0, 0), up, Texture.BRICK, seed + 2, 1.0),
        Rectangle((south, east, 0.0), (length, 0, 0), up, Texture.PLASTER, seed + 3, 0.95),
        Rectangle((north, west, 0.0), (0, width, 0), up, Texture.PLASTER, seed + 4, 1.1),
        Rectangle((south, west, 0.0), (0, width, 0), up, Texture.BRICK, seed + 5, 1.05),
    )


def square_wall(
    distance_m: float, angle_deg: float = 0.0, *, seed: int = 0, brightness: float = 1.0
) -> Scene:
    """Make one wall that fills the view of a camera at the origin that looks north.

    Parameters
    ----------
    distance_m
        From the origin to the wall along north.
    angle_deg
        0: met squarely; else the wall is turned about the vertical, its right-hand (eastern) side further away.
    seed, brightness
        Its look.
    """
    half_length_m, half_height_m = 3.0 * distance_m, 2.2 * distance_m
    sine, cosine = math.sin(math.radians(angle_deg)), math.cos(math.radians(angle_deg))
    corner = (distance_m - half_length_m * sine, -half_length_m * cosine, half_height_m)
    along = (2.0 * half_length_m * sine, 2.0 * half_length_m * cosine, 0.0)
    return Scene(
        (Rectangle(corner, along, (0.0, 0.0, -2.0 * half_height_m), Texture.BRICK, seed, brightness),)
    )


def corridor(
    length_m: float = 20.0,
    width_m: float = 2.4,
    height_m: float = 2.6,
    *,
    behind_m: float = 3.0,
    seed: int = 0,
) -> Scene:
    """Make a closed corridor that runs north from ``-behind_m`` to ``length_m``, its middle at east = 0."""
    return Scene(_box_inside((-behind_m, length_m), (-0.5 * width_m, 0.5 * width_m), height_m, seed))


def empty_room(
    length_m: float = 12.0,
    width_m: float = 8.0,
    height_m: float = 3.0,
    *,
    behind_m: float = 2.0,
    seed: int = 0,
) -> Scene:
    """Make a room that reaches north from ``-behind_m`` to ``length_m - behind_m``, its middle at east = 0."""
    return Scene(
        _box_inside((-behind_m, length_m - behind_m), (-0.5 * width_m, 0.5 * width_m), height_m, seed)
    )


def room_with_wall(
    length_m: float = 12.0,
    width_m: float = 8.0,
    height_m: float = 3.0,
    *,
    wall_north_m: float = 5.0,
    gap_m: float = 2.5,
    gap_on_the_right: bool = True,
    thickness_m: float = 0.2,
    behind_m: float = 2.0,
    seed: int = 0,
) -> Scene:
    """Make the room of :func:`empty_room` with a wall across it that leaves a gap at one side.

    Parameters
    ----------
    length_m, width_m, height_m, behind_m
        As in :func:`empty_room`.
    wall_north_m
        Where the wall's front stands.
    gap_m
        The free way beside it, to the east wall or to the west wall; 0 makes a dead end.
    gap_on_the_right
        Whether the way is free at the eastern (right-hand) side.
    thickness_m
        Of the wall.
    seed
        Its look.
    """
    if not 0.0 <= gap_m < width_m or not -behind_m < wall_north_m < length_m - behind_m - thickness_m:
        raise ValueError(
            f"the wall must stand inside the room, got gap_m = {gap_m} and wall_north_m = {wall_north_m}"
        )
    side = 1.0 if gap_on_the_right else -1.0
    start_east_m, end_east_m = -0.5 * side * width_m, side * (0.5 * width_m - gap_m)
    along = (0.0, end_east_m - start_east_m, 0.0)
    up = (0.0, 0.0, -height_m)
    wall = (
        Rectangle((wall_north_m, start_east_m, 0.0), along, up, Texture.BRICK, seed + 6, 1.15),
        Rectangle((wall_north_m + thickness_m, start_east_m, 0.0), along, up, Texture.BRICK, seed + 7, 0.9),
        Rectangle(
            (wall_north_m, end_east_m, 0.0), (thickness_m, 0.0, 0.0), up, Texture.PLASTER, seed + 8, 0.8
        ),
    )
    room = _box_inside((-behind_m, length_m - behind_m), (-0.5 * width_m, 0.5 * width_m), height_m, seed)
    return Scene(room + wall)

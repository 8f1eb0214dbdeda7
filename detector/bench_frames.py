"""Frames for the benchmark: a walk down a corridor that is made here, or given frames brought to the size that is asked for."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from detector.camera_model import CameraModel
from detector.observer import CameraPose

_HFOV_DEG: Final = 80.0
_HALF_WIDTH_M: Final = 1.1
_ABOVE_M: Final = 1.2
_BELOW_M: Final = 1.3
_END_M: Final = 12.0
_STEP_M: Final = 0.25
_TILE_M: Final = 4.0
_TILE_PX: Final = 1024
_LEVELS: Final = 6
_NOISE_GREY: Final = 1.5
_SURFACES: Final = ((1.0, 3), (0.85, 4), (1.25, 5), (0.6, 6), (0.95, 7))
"""Brightness and seed of the left wall, the right wall, the ceiling, the floor and the end."""
_WORLD_FROM_CAMERA: Final = ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
"""A level camera that looks along the corridor, in a world of x along it, y to the right, z down."""


@dataclass(frozen=True, slots=True)
class Stream:
    """Frames of one camera in order, each paired with the one before.

    Attributes
    ----------
    frames
        (H, W) uint8, all of one size.
    camera
        Of that size; None where it is not known.
    poses
        One a frame; empty where they are not known.
    """

    frames: tuple[NDArray[np.uint8], ...]
    camera: CameraModel | None = None
    poses: tuple[CameraPose, ...] = ()

    def __post_init__(self) -> None:
        if self.poses and len(self.poses) != len(self.frames):
            raise ValueError(f"expected {len(self.frames)} poses, one a frame, got {len(self.poses)}")

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: int) -> NDArray[np.uint8]:
        return self.frames[index]

    def __iter__(self) -> Iterator[NDArray[np.uint8]]:
        return iter(self.frames)


def generated_stream(size_px: tuple[int, int], count: int) -> Stream:
    """Return a camera's view while it moves 0.25 m a frame along a corridor with textured walls, ray-cast at the size itself.

    The same arguments always give the same frames, noise of the sensor included.

    Parameters
    ----------
    size_px
        Width and height.
    count
        Number of frames.
    """
    if count < 2:
        raise ValueError(f"a stream needs at least two frames, got {count}")
    textures = [_mip_levels(seed) for _, seed in _SURFACES]
    axes = np.array(_WORLD_FROM_CAMERA)
    return Stream(
        tuple(_corridor(size_px, _STEP_M * index, index, textures) for index in range(count)),
        CameraModel.from_hfov(*size_px, _HFOV_DEG),
        tuple(CameraPose(axes, np.array([_STEP_M * index, 0.0, 0.0])) for index in range(count)),
    )


def resized_stream(given: Stream, size_px: tuple[int, int]) -> Stream:
    """Return frames cut about their middle to another shape, and brought to a size; their camera with them.

    Parameters
    ----------
    given
        Frames, of the size that their camera says where that is known.
    size_px
        Width and height.

    Raises
    ------
    detector.camera_model.CameraError
        The camera's middle is cut off.
    """
    frames = tuple(_fitted(frame, size_px) for frame in given)
    if given.camera is None:
        return replace(given, frames=frames)
    left, top, part_width, part_height = _part(given[0], size_px)
    camera = replace(
        given.camera,
        width_px=part_width,
        height_px=part_height,
        cx_px=given.camera.cx_px - left,
        cy_px=given.camera.cy_px - top,
    )
    return replace(given, frames=frames, camera=camera.scaled_to(*size_px))


def there_and_back(given: Stream, count: int) -> Stream:
    """Return at least ``count`` frames: the stream, then back through it, and so on; a single pair becomes a stream that way."""
    turn = [*range(len(given)), *range(len(given) - 2, 0, -1)]
    order = [turn[i % len(turn)] for i in range(max(count, len(given)))]
    return replace(
        given,
        frames=tuple(given.frames[index] for index in order),
        poses=tuple(given.poses[index] for index in order) if given.poses else (),
    )


def _part(frame: NDArray[np.uint8], size_px: tuple[int, int]) -> tuple[int, int, int, int]:
    """Return left, top, width and height of the largest part about the middle that has the shape of a size."""
    width, height = size_px
    scale = max(width / frame.shape[1], height / frame.shape[0])
    part_width = min(frame.shape[1], max(1, round(width / scale)))
    part_height = min(frame.shape[0], max(1, round(height / scale)))
    return (frame.shape[1] - part_width) // 2, (frame.shape[0] - part_height) // 2, part_width, part_height


def _fitted(frame: NDArray[np.uint8], size_px: tuple[int, int]) -> NDArray[np.uint8]:
    left, top, part_width, part_height = _part(frame, size_px)
    part = frame[top : top + part_height, left : left + part_width]
    if (part_width, part_height) == size_px:
        return np.ascontiguousarray(part)
    way = cv2.INTER_AREA if size_px[0] < part_width else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(part, size_px, interpolation=way), np.uint8)


# ---------------------------------------------------------------------- the corridor


def _corridor(
    size_px: tuple[int, int], north_m: float, seed: int, textures: list[list[NDArray[np.float32]]]
) -> NDArray[np.uint8]:
    width, height = size_px
    focal_px = 0.5 * width / math.tan(math.radians(0.5 * _HFOV_DEG))
    x = ((np.arange(width) - 0.5 * (width - 1)) / focal_px).astype(np.float32)[None, :]
    y = ((np.arange(height) - 0.5 * (height - 1)) / focal_px).astype(np.float32)[:, None]
    tiny = np.float32(1e-6)
    beside = np.float32(_HALF_WIDTH_M) / np.maximum(np.abs(x), tiny)
    upright = np.where(y < 0, np.float32(_ABOVE_M), np.float32(_BELOW_M)) / np.maximum(np.abs(y), tiny)
    depth = np.minimum(np.minimum(beside, upright), np.float32(_END_M - north_m))
    surface = np.where(x < 0, 0, 1) + np.zeros_like(y, np.int8)
    surface = np.where(upright < beside, np.where(y < 0, 2, 3), surface)
    surface = np.where(depth >= np.float32(_END_M - north_m), 4, surface)
    ahead = depth + np.float32(north_m)
    # Where the ray meets its surface, in metres along it.
    u = np.where(surface == 4, x * depth, ahead)
    v = np.where((surface == 2) | (surface == 3), x * depth, y * depth)
    # A pixel covers depth / focal across, and more along a surface that leads away; the texture is taken that coarse.
    slant = np.where(surface == 4, 1.0, depth / _HALF_WIDTH_M).astype(np.float32)
    footprint_px = depth / np.float32(focal_px) * np.sqrt(np.maximum(slant, 1.0)) * (_TILE_PX / _TILE_M)
    level = np.clip(np.rint(np.log2(np.maximum(footprint_px, 1.0))), 0, _LEVELS - 1).astype(np.int8)
    grey = np.zeros((height, width), np.float32)
    for index, (brightness, _) in enumerate(_SURFACES):
        for number in range(_LEVELS):
            seen = (surface == index) & (level == number)
            if seen.any():
                grey[seen] = np.float32(brightness) * _looked_up(textures[index][number], u[seen], v[seen])
    noise = np.random.default_rng(seed).normal(0.0, _NOISE_GREY, grey.shape)
    return np.clip(grey + noise, 0, 255).astype(np.uint8)


def _looked_up(
    texture: NDArray[np.float32], u_m: NDArray[np.float32], v_m: NDArray[np.float32]
) -> NDArray[np.float32]:
    side = texture.shape[0]
    at_u = np.mod(u_m * np.float32(side / _TILE_M), side)
    at_v = np.mod(v_m * np.float32(side / _TILE_M), side)
    # The tile's first row and column once more behind its last, so that it joins itself.
    joined = cv2.copyMakeBorder(texture, 0, 1, 0, 1, cv2.BORDER_WRAP)
    # remap takes no more than 32767 columns.
    rows = -(-len(at_u) // 16384)
    padded = np.zeros((2, rows * 16384), np.float32)
    padded[0, : len(at_u)], padded[1, : len(at_u)] = at_u, at_v
    found = cv2.remap(joined, padded[0].reshape(rows, -1), padded[1].reshape(rows, -1), cv2.INTER_LINEAR)
    return np.asarray(found, np.float32).reshape(-1)[: len(at_u)]


def _mip_levels(seed: int) -> list[NDArray[np.float32]]:
    """Return a tile of patches and spots of several sizes, and its halved copies."""
    rng = np.random.default_rng(seed)
    grey = np.full((_TILE_PX, _TILE_PX), 115.0, np.float32)
    for patch_px, amplitude in ((256, 14.0), (64, 14.0), (16, 9.0), (4, 4.0)):
        cells = _TILE_PX // patch_px
        coarse = rng.normal(0.0, amplitude, (cells, cells)).astype(np.float32)
        grey += np.kron(coarse, np.ones((patch_px, patch_px), np.float32))
    grey = np.asarray(cv2.GaussianBlur(grey, (0, 0), 1.0, borderType=cv2.BORDER_REFLECT), np.float32)
    levels = [grey]
    while len(levels) < _LEVELS:
        half = levels[-1].shape[0] // 2
        levels.append(
            np.asarray(cv2.resize(levels[-1], (half, half), interpolation=cv2.INTER_AREA), np.float32)
        )
    return levels

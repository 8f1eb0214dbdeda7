"""What surfaces of a simulated world look like: grey pictures of a known size, by name.

Most are photographs in the wheel of ``miniworld`` (extra ``sim``), read where that is installed; its Python code, which would
bring a window system with it, is never imported. The rest is drawn here.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.errors import CompanionError

_LONGEST_SIDE_PX: Final = 1024
_PLAIN_GREY: Final = 200


class SimulationExtraError(CompanionError):
    """Something that the extra ``sim`` brings, or a system package that it needs, is missing."""


@dataclass(frozen=True, slots=True)
class TextureImage:
    """A picture and how much of a surface it covers; it repeats beyond that.

    Attributes
    ----------
    grey
        (height, width) uint8, the upper row first.
    width_m, height_m
        Its size on the surface; 0: it is stretched over the whole surface, once.
    """

    grey: NDArray[np.uint8]
    width_m: float
    height_m: float


@dataclass(frozen=True, slots=True)
class _Photograph:
    file: str
    width_m: float
    height_m: float


# The sizes are chosen for a natural look: a brick course of 8 cm, tiles of 30 to 60 cm.
_PHOTOGRAPHS: Final[dict[str, _Photograph]] = {
    "brick": _Photograph("brick_wall_1.png", 2.0, 2.0),
    "cinder_blocks": _Photograph("cinder_blocks_1.png", 1.6, 1.6),
    "concrete": _Photograph("concrete_1.png", 2.0, 2.0),
    "concrete_tiles": _Photograph("concrete_tiles_1.png", 1.8, 1.8),
    "drywall": _Photograph("drywall_1.png", 1.0, 1.0),
    "stucco": _Photograph("stucco_1.png", 1.0, 1.0),
    "marble": _Photograph("marble_1.png", 2.0, 2.0),
    "wood": _Photograph("wood_2.png", 1.2, 1.2),
    "dark_wood": _Photograph("wood_1.png", 1.2, 1.2),
    "wood_planks": _Photograph("wood_planks_1.png", 1.5, 1.5),
    "floor_tiles": _Photograph("floor_tiles_bw_1.png", 2.0, 2.0),
    "white_tiles": _Photograph("floor_tiles_white.png", 1.2, 1.2),
    "carpet": _Photograph("asphalt_1.png", 1.2, 1.2),
    "rock": _Photograph("rock_1.png", 2.0, 2.0),
    "ceiling_tiles": _Photograph("ceiling_tiles_1.png", 2.4, 2.4),
    "cardboard": _Photograph("cardboard_2.png", 1.0, 1.0),
    "metal": _Photograph("metal_grill_1.png", 0.5, 0.5),
    "door": _Photograph("door_steel_grey.png", 0.0, 0.0),
    "door_red": _Photograph("door_steel_red.png", 0.0, 0.0),
    "garage_door": _Photograph("door_garage_white.png", 0.0, 0.0),
    "vent": _Photograph("airduct_grate_1.png", 0.0, 0.0),
    "portrait_1": _Photograph("portraits/adelaide_hanscom1.png", 0.0, 0.0),
    "portrait_2": _Photograph("portraits/alessandro_allori1.png", 0.0, 0.0),
    "portrait_3": _Photograph("portraits/alexandre_cabanel1.png", 0.0, 0.0),
    "portrait_4": _Photograph("portraits/alexei_harlamov1.png", 0.0, 0.0),
}


def texture_names() -> tuple[str, ...]:
    """Return all names that :func:`load_texture` knows, sorted."""
    return tuple(sorted({*_PHOTOGRAPHS, *_DRAWN}))


def load_texture(name: str) -> TextureImage:
    """Return a texture.

    Raises
    ------
    ValueError
        When there is none of that name.
    SimulationExtraError
        When its picture is not installed.
    """
    if name in _DRAWN:
        return _DRAWN[name]()
    if name not in _PHOTOGRAPHS:
        raise ValueError(f"texture: found {name!r}; allowed: {', '.join(texture_names())}")
    photograph = _PHOTOGRAPHS[name]
    grey = read_grey(miniworld_folder() / "textures" / photograph.file)
    return TextureImage(grey, photograph.width_m, photograph.height_m)


def miniworld_folder() -> Path:
    """Return where the wheel of miniworld is installed.

    Raises
    ------
    SimulationExtraError
        When it is not.
    """
    found = importlib.util.find_spec("miniworld")  # finds the folder without running its code
    if found is None or not found.submodule_search_locations:
        raise SimulationExtraError(
            "the pictures of the simulated worlds are not installed: pip install 'void-companion[sim]'"
        )
    return Path(next(iter(found.submodule_search_locations)))


def read_grey(path: Path) -> NDArray[np.uint8]:
    """Read a picture as grey, halved until no side is longer than 1024 pixels."""
    try:
        data = np.fromfile(path, dtype=np.uint8)
    except OSError as error:
        raise SimulationExtraError(f"{path}: cannot be read: {error.strerror}") from error
    decoded = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)
    if decoded is None:
        raise SimulationExtraError(f"{path}: not a picture")
    while max(decoded.shape) > _LONGEST_SIDE_PX:
        half = (max(1, decoded.shape[1] // 2), max(1, decoded.shape[0] // 2))
        decoded = cv2.resize(decoded, half, interpolation=cv2.INTER_AREA)
    return np.asarray(decoded, dtype=np.uint8)


def _plain() -> TextureImage:
    return TextureImage(np.full((8, 8), _PLAIN_GREY, dtype=np.uint8), 1.0, 1.0)


def _cloth() -> TextureImage:
    """Draw woven check with folds: clothes and upholstery."""
    rng = np.random.default_rng(11)
    y, x = np.mgrid[0:256, 0:256]
    grey = 110.0 + 22.0 * ((x // 32) % 2) + 22.0 * ((y // 32) % 2)
    coarse = rng.normal(0.0, 26.0, (6, 12)).astype(np.float32)
    grey += _periodic(coarse, 256) + rng.normal(0.0, 7.0, grey.shape)
    return TextureImage(np.clip(np.rint(grey), 0, 255).astype(np.uint8), 0.6, 0.6)


def _notices() -> TextureImage:
    """Draw sheets of paper with lines of text on cork: a notice board."""
    rng = np.random.default_rng(12)
    grey = rng.normal(120.0, 9.0, (384, 512))
    for _ in range(14):
        left, top = int(rng.integers(8, 430)), int(rng.integers(8, 280))
        width, height = int(rng.integers(45, 80)), int(rng.integers(60, 96))
        grey[top : top + height, left : left + width] = rng.uniform(200, 250)
        for line in range(top + 8, top + height - 6, 7):
            end = left + 6 + int(rng.uniform(0.5, 1.0) * (width - 12))
            grey[line : line + 3, left + 6 : end] = rng.uniform(30, 90)
    return TextureImage(np.clip(np.rint(grey), 0, 255).astype(np.uint8), 0.0, 0.0)


def _shelf() -> TextureImage:
    """Draw shelves full of books."""
    rng = np.random.default_rng(13)
    grey = np.full((512, 256), 45.0)
    for row in range(4):
        floor = 128 * (row + 1) - 8
        left = 6
        while left < 246:
            width, height = int(rng.integers(6, 20)), int(rng.integers(70, 112))
            book = grey[floor - height : floor, left : min(left + width, 250)]
            book[:] = rng.uniform(40, 230)
            book[height // 5 : height // 4] = rng.uniform(40, 230)
            left += width + int(rng.integers(1, 3))
        grey[floor : floor + 8] = 150.0
    return TextureImage(np.clip(np.rint(grey), 0, 255).astype(np.uint8), 0.0, 0.0)


def _periodic(coarse: NDArray[np.float32], side_px: int) -> NDArray[np.float32]:
    """Enlarge noise so that its borders fit each other."""
    tiled = np.tile(coarse, (3, 3))
    large = cv2.resize(tiled, (3 * side_px, 3 * side_px), interpolation=cv2.INTER_CUBIC)
    return np.asarray(large[side_px : 2 * side_px, side_px : 2 * side_px], dtype=np.float32)


_DRAWN: Final[dict[str, Callable[[], TextureImage]]] = {
    "plain": _plain,
    "cloth": _cloth,
    "notices": _notices,
    "shelf": _shelf,
}

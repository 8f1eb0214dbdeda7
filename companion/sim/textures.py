"""The pictures behind the names of textures: grey, as arrays, read from the wheel of ``miniworld`` (extra ``sim``).

Its Python code, which would bring a window system with it, is never imported, and none of its files are copied.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.errors import CompanionError
from companion.sim.world.textures import checked_texture, plain_colour_rgb, texture_file

_LONGEST_SIDE_PX: Final = 1024
_LUMA_RGB: Final = (0.299, 0.587, 0.114)  # ITU-R BT.601, as OpenCV reads colour pictures as grey
MESH_PREFIX: Final = "meshes/"


class SimulationExtraError(CompanionError):
    """Something that the extra ``sim`` brings, or a system package that it needs, is missing."""


def load_texture(name: str) -> NDArray[np.uint8]:
    """Return a texture as grey, the upper row first.

    Parameters
    ----------
    name
        As ``companion.sim.world.textures.checked_texture`` allows, or ``meshes/STEM`` for the skin of a mesh.

    Raises
    ------
    ValueError
        When there is none of that name.
    SimulationExtraError
        When its picture is not installed.
    """
    if name.startswith(MESH_PREFIX):
        return read_grey(miniworld_folder() / f"{name}.png")
    colour = plain_colour_rgb(checked_texture(name))
    if colour is not None:
        return np.full((8, 8), luma(*colour), dtype=np.uint8)
    return read_grey(miniworld_folder() / "textures" / f"{texture_file(name)}")


def luma(red: float, green: float, blue: float) -> int:
    """Return the grey value of a colour, both from 0 to 255."""
    return round(sum(weight * value for weight, value in zip(_LUMA_RGB, (red, green, blue), strict=True)))


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

"""Meshes from Wavefront OBJ files: triangles with texture coordinates, a grey for each material."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from companion.sim.surfaces import Surface
from companion.sim.textures import MESH_PREFIX, SimulationExtraError, luma

_WHITE = "plain:#ffffff"
_DEFAULT_MATERIAL_GREY = 0.8

_Corner = tuple[int, int, int]


def load_mesh(folder: Path, stem: str) -> tuple[Surface, ...]:
    """Read a mesh in its own axes: x, y up, z.

    A picture of the same name, where there is one, is its skin; else each material has the colour that the file
    of materials of the same name gives it.

    Parameters
    ----------
    folder
        Where ``STEM.obj``, and ``STEM.png`` or ``STEM.mtl``, are.
    stem
        Name without extension.

    Returns
    -------
    One surface a material. The arrays that a ``Surface`` names NED are in the mesh's axes and units here.

    Raises
    ------
    SimulationExtraError
        When the file cannot be read or is not made of triangles and quadrangles.
    """
    path = folder / f"{stem}.obj"
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except OSError as error:
        raise SimulationExtraError(f"{path}: cannot be read: {error.strerror}") from error
    columns: dict[str, list[list[float]]] = {"v": [], "vt": [], "vn": []}
    faces: defaultdict[str, list[tuple[_Corner, _Corner, _Corner]]] = defaultdict(list)
    material = ""
    try:
        for line in lines:
            kind, *words = line.split() or [""]
            if kind in columns:
                columns[kind].append([float(word) for word in words])
            elif kind == "usemtl":
                material = words[0]
            elif kind == "f":
                corners = [_corner(word) for word in words]
                faces[material].extend(
                    (corners[0], corners[k], corners[k + 1]) for k in range(1, len(corners) - 1)
                )
        position, uv, normal = (
            np.array([row[:width] for row in columns[kind]], dtype=np.float32).reshape(-1, width)
            for kind, width in (("v", 3), ("vt", 2), ("vn", 3))
        )
        skinned = path.with_suffix(".png").exists()
        greys = {} if skinned else _material_greys(path.with_suffix(".mtl"))
        texture = f"{MESH_PREFIX}{stem}" if skinned else _WHITE
        default = 1.0 if skinned else _DEFAULT_MATERIAL_GREY
        return tuple(
            _surface(texture, np.array(triangles), position, uv, normal, greys.get(name, default))
            for name, triangles in faces.items()
        )
    except (ValueError, IndexError) as error:
        raise SimulationExtraError(f"{path}: not a mesh that can be used: {error}") from error


def _corner(word: str) -> _Corner:
    """Return the indices (position, uv, normal) of ``1/2/3``, ``1//3``, ``1/2`` or ``1``; 0: not given."""
    parts = [int(part) if part else 0 for part in word.split("/")]
    if parts[0] < 1 or min(parts) < 0:
        raise ValueError(f"expected indices from 1, got {word!r}")
    position, uv, normal = (*parts, 0, 0)[:3]
    return position, uv, normal


def _material_greys(path: Path) -> dict[str, float]:
    if not path.exists():
        return {}
    greys, name = {}, ""
    for line in path.read_text(encoding="utf-8").splitlines():
        kind, *words = line.split() or [""]
        if kind == "newmtl":
            name = words[0]
        elif kind == "Kd":
            red, green, blue = (255.0 * float(word) for word in words[:3])
            greys[name] = luma(red, green, blue) / 255.0
    return greys


def _surface(
    texture: str,
    corners: NDArray[np.int64],
    position: NDArray[np.float32],
    uv: NDArray[np.float32],
    normal: NDArray[np.float32],
    grey: float,
) -> Surface:
    """Make a surface out of (M, 3, 3) corners: a vertex for each different triple of indices."""
    different, place = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    triangles = place.reshape(-1, 3).astype(np.uint32)
    at = position[different[:, 0] - 1]
    if (different[:, 2] > 0).all():
        outward = normal[different[:, 2] - 1]
    else:  # the mean of the faces around
        face = np.cross(at[triangles[:, 1]] - at[triangles[:, 0]], at[triangles[:, 2]] - at[triangles[:, 0]])
        outward = np.zeros_like(at)
        for k in range(3):
            np.add.at(outward, triangles[:, k], face)
    length = np.linalg.norm(outward, axis=1, keepdims=True)
    outward = outward / np.maximum(length, 1e-12)
    has_uv = different[:, 1] > 0
    places = np.zeros((len(different), 2), dtype=np.float32)
    places[has_uv] = uv[different[has_uv, 1] - 1]
    return Surface(texture, at, outward.astype(np.float32), places, triangles, grey)

"""Textured triangles, and the simple bodies that are made of them: rectangles, blocks, columns, balls.

Everything is in local NED, metres, the floor at down = 0.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class Surface:
    """Triangles that wear one texture.

    Attributes
    ----------
    texture
        A name for ``companion.sim.textures.load_texture``.
    position_ned_m, normal_ned
        (N, 3) vertices and the outward unit normals there.
    uv
        (N, 2) place in the texture: u to the right, v up, one copy of it for each whole number.
    triangles
        (M, 3) indices of vertices. Both sides are visible.
    grey
        Factor on the texture, at most 1.
    """

    texture: str
    position_ned_m: Floats
    normal_ned: Floats
    uv: Floats
    triangles: NDArray[np.uint32]
    grey: float = 1.0

    def __post_init__(self) -> None:
        count = len(self.position_ned_m)
        for name, array, columns in (
            ("position_ned_m", self.position_ned_m, 3),
            ("normal_ned", self.normal_ned, 3),
            ("uv", self.uv, 2),
        ):
            if array.shape != (count, columns):
                raise ValueError(f"{name}: expected ({count}, {columns}), got {array.shape}")
        if self.triangles.ndim != 2 or self.triangles.shape[1] != 3:
            raise ValueError(f"triangles: expected (M, 3), got {self.triangles.shape}")
        if self.triangles.size and int(self.triangles.max()) >= count:
            raise ValueError(f"triangles: expected indices below {count}, got {int(self.triangles.max())}")


def joined(parts: Sequence[Surface]) -> Surface:
    """Return one surface out of several with the same texture and factor."""
    looks = {(part.texture, part.grey) for part in parts}
    if len(looks) != 1:
        raise ValueError(f"expected surfaces that look alike, got {sorted(looks)}")
    offsets = np.cumsum([0, *(len(part.position_ned_m) for part in parts[:-1])])
    return Surface(
        parts[0].texture,
        np.concatenate([part.position_ned_m for part in parts]),
        np.concatenate([part.normal_ned for part in parts]),
        np.concatenate([part.uv for part in parts]),
        np.concatenate(
            [part.triangles + np.uint32(offset) for part, offset in zip(parts, offsets, strict=True)]
        ).astype(np.uint32),
        parts[0].grey,
    )


def rectangle(
    texture: str,
    corner_ned_m: ArrayLike,
    right_ned_m: ArrayLike,
    up_ned_m: ArrayLike,
    *,
    uv_corner: tuple[float, float] = (0.0, 0.0),
    uv_size: tuple[float, float] = (1.0, 1.0),
) -> Surface:
    """Make a rectangle.

    Parameters
    ----------
    texture
        What it wears.
    corner_ned_m
        The lower left corner as seen from its front.
    right_ned_m, up_ned_m
        Its sides from there, as seen from its front; perpendicular to each other.
    uv_corner, uv_size
        Which part of the texture it shows; larger than 1: more copies than one.
    """
    corner, right, up = (np.asarray(v, dtype=np.float64) for v in (corner_ned_m, right_ned_m, up_ned_m))
    # Seen from the front, right x up points at the viewer: NED is right-handed.
    normal = np.cross(right, up)
    length = float(np.linalg.norm(normal))
    if length < 1e-9:
        raise ValueError(f"expected two sides that span a rectangle, got {right} and {up}")
    (u, v), (du, dv) = uv_corner, uv_size
    return Surface(
        texture,
        np.stack([corner, corner + right, corner + right + up, corner + up]).astype(np.float32),
        np.tile(normal / length, (4, 1)).astype(np.float32),
        np.array([[u, v], [u + du, v], [u + du, v + dv], [u, v + dv]], dtype=np.float32),
        np.array([[0, 1, 2], [0, 2, 3]], dtype=np.uint32),
    )


def block(
    texture: str,
    centre_m: tuple[float, float],
    size_m: tuple[float, float, float],
    azimuth_rad: float,
    bottom_m: float,
    *,
    tile_m: float | None,
    along_from_m: float = 0.0,
) -> Surface:
    """Make a block.

    Parameters
    ----------
    texture
        On all sides.
    centre_m
        North and east of its middle.
    size_m
        Length along its azimuth, width across it, height.
    azimuth_rad
        Of its length.
    bottom_m
        Its underside above the floor.
    tile_m
        Side of one copy of the texture; None: one copy on each face.
    along_from_m
        Where the texture stands at its rear end: the pieces of a wall continue each other's.
    """
    length, width, height = size_m
    along = np.array([math.cos(azimuth_rad), math.sin(azimuth_rad), 0.0])
    across = np.array([-math.sin(azimuth_rad), math.cos(azimuth_rad), 0.0])
    up = np.array([0.0, 0.0, -1.0])
    middle = np.array([*centre_m, -bottom_m - 0.5 * height])
    half = 0.5 * length * along, 0.5 * width * across, 0.5 * height * up
    start = along_from_m
    # Outward normal, the viewer's right, the viewer's up, their lengths, and the texture's place at the left lower corner.
    faces = (
        (half[1], along, up, (length, height), (start, bottom_m)),
        (-half[1], -along, up, (length, height), (-start - length, bottom_m)),
        (half[0], -across, up, (width, height), (0.0, bottom_m)),
        (-half[0], across, up, (width, height), (0.0, bottom_m)),
        (half[2], along, -across, (length, width), (start, 0.0)),
        (-half[2], along, across, (length, width), (start, 0.0)),
    )
    parts = []
    for outward, right, face_up, (wide, high), place in faces:
        corner = middle + outward - 0.5 * wide * right - 0.5 * high * face_up
        uv_corner, uv_size = (0.0, 0.0), (1.0, 1.0)
        if tile_m is not None:
            uv_corner = (place[0] / tile_m, place[1] / tile_m)
            uv_size = (wide / tile_m, high / tile_m)
        parts.append(
            rectangle(texture, corner, wide * right, high * face_up, uv_corner=uv_corner, uv_size=uv_size)
        )
    return joined(parts)


def column(
    texture: str,
    centre_m: tuple[float, float],
    radii_m: tuple[float, float],
    azimuth_rad: float,
    bottom_m: float,
    height_m: float,
    *,
    tile_m: float,
    sides: int = 24,
) -> Surface:
    """Make an upright elliptic cylinder with a lid.

    Parameters
    ----------
    texture
        On all of it.
    centre_m
        North and east of its axis.
    radii_m
        Half axes along its azimuth and across it.
    azimuth_rad
        Of the first half axis.
    bottom_m, height_m
        Its foot above the floor, and its height.
    tile_m
        Side of one copy of the texture.
    sides
        Corners of the polygon that stands for the ellipse; they lie on it.
    """
    angle = np.linspace(0.0, math.tau, sides + 1)
    circle = np.column_stack((np.cos(angle), np.sin(angle)))
    rotation = _rotation(azimuth_rad)
    edge = circle * radii_m @ rotation.T + centre_m
    outward = circle / radii_m
    outward = outward / np.linalg.norm(outward, axis=1, keepdims=True) @ rotation.T
    # Looking at it from outside, clockwise azimuths run to the left.
    around_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(edge, axis=0), axis=1))])
    foot = np.column_stack((edge, np.full(sides + 1, -bottom_m)))
    top = np.column_stack((edge, np.full(sides + 1, -bottom_m - height_m)))
    u = -around_m / tile_m
    side = Surface(
        texture,
        np.concatenate([foot, top]).astype(np.float32),
        np.tile(np.column_stack((outward, np.zeros(sides + 1))), (2, 1)).astype(np.float32),
        np.column_stack(
            (np.tile(u, 2), np.repeat([bottom_m, bottom_m + height_m], sides + 1) / tile_m)
        ).astype(np.float32),
        _strip(2, sides + 1),
    )
    lid_places = np.concatenate([[centre_m], edge])
    lid = Surface(
        texture,
        np.column_stack((lid_places, np.full(sides + 2, -bottom_m - height_m))).astype(np.float32),
        np.tile([0.0, 0.0, -1.0], (sides + 2, 1)).astype(np.float32),
        (lid_places / tile_m).astype(np.float32),
        np.array([[0, k, k + 1] for k in range(1, sides + 1)], dtype=np.uint32),
    )
    return joined([side, lid])


def ball(
    texture: str,
    centre_ned_m: tuple[float, float, float],
    radii_m: tuple[float, float, float],
    azimuth_rad: float,
    *,
    sides: int = 16,
) -> Surface:
    """Make an upright ellipsoid; its half axes go along its azimuth, across it, and up."""
    around, polar = np.meshgrid(
        np.linspace(0.0, math.tau, sides + 1), np.linspace(0.0, math.pi, sides // 2 + 1)
    )
    unit = np.stack([np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), -np.cos(polar)], axis=-1)
    turn = np.eye(3)
    turn[:2, :2] = _rotation(azimuth_rad)
    outward = unit / np.asarray(radii_m)
    outward /= np.linalg.norm(outward, axis=-1, keepdims=True)
    return Surface(
        texture,
        ((unit * radii_m) @ turn.T + centre_ned_m).reshape(-1, 3).astype(np.float32),
        (outward @ turn.T).reshape(-1, 3).astype(np.float32),
        np.stack([-around / math.tau, 1.0 - polar / math.pi], axis=-1).reshape(-1, 2).astype(np.float32),
        _strip(*around.shape),
    )


def _rotation(azimuth_rad: float) -> NDArray[np.float64]:
    """Return the rotation of (along, across) to (north, east)."""
    cosine, sine = math.cos(azimuth_rad), math.sin(azimuth_rad)
    return np.array([[cosine, -sine], [sine, cosine]])


def _strip(rows: int, columns: int) -> NDArray[np.uint32]:
    """Return the triangles of a grid of vertices, row by row."""
    index = np.arange(rows * columns, dtype=np.uint32).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    return np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 3)

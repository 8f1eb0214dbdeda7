"""What a world looks like: its walls, blocks, pillars, people and furniture as textured triangles in local NED."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from companion.sim.surfaces import Surface, ball, block, column, rectangle
from companion.sim.textures import miniworld_folder
from companion.sim.wavefront import load_mesh
from companion.sim.world.furniture import MESHES, Mesh
from companion.sim.world.model import Furniture, Person, Picture, Wall, World
from companion.sim.world.textures import TILE_SIDE_M

_PICTURE_GAP_M = 0.006
"""Pictures hang this far before their wall: nearer, and the depth buffer could not tell them apart from 30 m away."""
_BEYOND_WALLS_M = 1.0
_SKIN_TEXTURE = "plain:#b98a6e"
_HEAD_PART = 0.13
"""Height of a head over that of the person."""


def world_surfaces(world: World) -> tuple[Surface, ...]:
    """Return everything that can be seen in a world.

    Raises
    ------
    companion.sim.textures.SimulationExtraError
        When there is furniture in it and its meshes are not installed.
    """
    return (
        *_floor_and_ceiling(world),
        *(surface for wall in world.walls for surface in wall_surfaces(wall, world.ceiling_m)),
        *(
            block(
                box.texture,
                box.centre_m,
                box.size_m,
                math.radians(box.yaw_deg),
                box.bottom_m,
                tile_m=_tile_m(box.texture),
            )
            for box in world.boxes
        ),
        *(
            column(
                pillar.texture,
                pillar.centre_m,
                (pillar.radius_m, pillar.radius_m),
                0.0,
                0.0,
                world.ceiling_m if pillar.height_m is None else pillar.height_m,
                tile_m=_tile_m(pillar.texture) or 1.0,
            )
            for pillar in world.pillars
        ),
        *(surface for person in world.people for surface in _person(person)),
        *(surface for piece in world.furniture for surface in _furniture(piece)),
    )


def wall_surfaces(wall: Wall, ceiling_m: float) -> Iterator[Surface]:
    """Give a wall's pieces between its doorways, the lintels above them, and the pictures on it."""
    top_m = ceiling_m if wall.height_m is None else wall.bottom_m + wall.height_m
    origin = np.asarray(wall.from_m)
    along = (np.asarray(wall.to_m) - origin) / wall.length_m
    azimuth_rad = math.atan2(along[1], along[0])

    def piece(from_m: float, to_m: float, bottom_m: float) -> Iterator[Surface]:
        if to_m - from_m > 1e-6 and top_m - bottom_m > 1e-6:
            middle = origin + 0.5 * (from_m + to_m) * along
            yield block(
                wall.texture,
                (float(middle[0]), float(middle[1])),
                (to_m - from_m, wall.thickness_m, top_m - bottom_m),
                azimuth_rad,
                bottom_m,
                tile_m=_tile_m(wall.texture),
                along_from_m=from_m,
            )

    reached_m = 0.0
    for opening in sorted(wall.openings, key=lambda opening: opening.at_m):
        begin_m = max(0.0, opening.at_m - 0.5 * opening.width_m)
        end_m = min(wall.length_m, opening.at_m + 0.5 * opening.width_m)
        yield from piece(reached_m, begin_m, wall.bottom_m)
        yield from piece(begin_m, end_m, wall.bottom_m + opening.height_m)
        reached_m = end_m
    yield from piece(reached_m, wall.length_m, wall.bottom_m)
    for picture in wall.pictures:
        yield _picture(wall, picture)


def _picture(wall: Wall, picture: Picture) -> Surface:
    origin = np.asarray(wall.from_m)
    along = (np.asarray(wall.to_m) - origin) / wall.length_m
    to_the_right = np.array([-along[1], along[0]])
    outward = to_the_right if picture.side == "right" else -to_the_right
    # Somebody who looks at a wall's right side from there has the wall's direction to the right.
    right = along if picture.side == "right" else -along
    lower_left = (
        origin
        + picture.at_m * along
        + (0.5 * wall.thickness_m + _PICTURE_GAP_M) * outward
        - 0.5 * picture.width_m * right
    )
    return rectangle(
        picture.texture,
        (*lower_left, -picture.bottom_m),
        (*(picture.width_m * right), 0.0),
        (0.0, 0.0, -picture.height_m),
    )


def _floor_and_ceiling(world: World) -> Iterator[Surface]:
    ends = np.array([end for wall in world.walls for end in (wall.from_m, wall.to_m)])
    south, west = ends.min(axis=0) - _BEYOND_WALLS_M
    length, width = np.ptp(ends, axis=0) + 2.0 * _BEYOND_WALLS_M
    for texture, down_m, right, up, size in (
        (world.floor_texture, 0.0, (0.0, width, 0.0), (length, 0.0, 0.0), (width, length)),
        (world.ceiling_texture, -world.ceiling_m, (length, 0.0, 0.0), (0.0, width, 0.0), (length, width)),
    ):
        tile_m = _tile_m(texture) or 1.0
        uv_size = (float(size[0]) / tile_m, float(size[1]) / tile_m)
        yield rectangle(texture, (south, west, down_m), right, up, uv_size=uv_size)


def _person(person: Person) -> Iterator[Surface]:
    """Give an elliptic body and a head upon it."""
    depth_m, width_m = person.shoulders_m
    azimuth_rad = math.radians(person.yaw_deg)
    head_m = _HEAD_PART * person.height_m
    yield column(
        person.clothes_texture,
        person.centre_m,
        (0.5 * depth_m, 0.5 * width_m),
        azimuth_rad,
        0.0,
        person.height_m - head_m,
        tile_m=_tile_m(person.clothes_texture) or 1.0,
    )
    yield ball(
        _SKIN_TEXTURE,
        (*person.centre_m, -person.height_m + 0.5 * head_m),
        (0.4 * head_m, 0.35 * head_m, 0.5 * head_m),
        azimuth_rad,
    )


def _furniture(piece: Furniture) -> Iterator[Surface]:
    mesh = MESHES[piece.kind]
    azimuth_rad = math.radians(piece.yaw_deg)
    if mesh.file is None:
        length_m, width_m, height_m = (piece.scale * side for side in mesh.size_m)
        yield block(
            mesh.texture or _SKIN_TEXTURE,
            piece.centre_m,
            (length_m, width_m, height_m),
            azimuth_rad,
            0.0,
            tile_m=None,
        )
        return
    for part in load_mesh(miniworld_folder() / "meshes", mesh.file.removesuffix(".obj")):
        yield _placed(part, mesh, piece, azimuth_rad)


def _placed(part: Surface, mesh: Mesh, piece: Furniture, azimuth_rad: float) -> Surface:
    """Bring a mesh (x, y up, z) into the world as ``companion.sim.world.furniture.Mesh`` says."""
    cosine, sine = math.cos(azimuth_rad), math.sin(azimuth_rad)
    # Columns: where the mesh's x, y and z go in NED. Along the heading, up, and to its right.
    axes = np.array([[cosine, 0.0, -sine], [sine, 0.0, cosine], [0.0, -1.0, 0.0]])
    low, high = np.asarray(mesh.low), np.asarray(mesh.high)
    foot = np.array([0.5 * (low[0] + high[0]), low[1], 0.5 * (low[2] + high[2])])
    factor = piece.scale * mesh.metres_per_unit
    position = factor * (part.position_ned_m - foot) @ axes.T + (*piece.centre_m, 0.0)
    return Surface(
        part.texture,
        position.astype(np.float32),
        (part.normal_ned @ axes.T).astype(np.float32),
        part.uv,
        part.triangles,
        part.grey,
    )


def _tile_m(texture: str) -> float | None:
    """Return the side of one copy of a texture; None for what is stretched over a face, such as a portrait."""
    return TILE_SIDE_M.get(texture)

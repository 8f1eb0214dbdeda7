from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from companion.sim.surfaces import Surface, ball, block, column, joined, rectangle
from companion.sim.textures import SimulationExtraError, load_texture, miniworld_folder, read_grey
from companion.sim.wavefront import load_mesh
from companion.sim.world.furniture import MESHES
from companion.sim.world.model import Furniture, Goal, Opening, Person, Pillar, Start, Wall, World
from companion.sim.world.prisms import prisms_of
from companion.sim.world_surfaces import wall_surfaces, world_surfaces

BODIES = {
    "block": block("white_1", (2.0, -1.0), (1.5, 0.4, 0.9), 0.6, 0.3, tile_m=1.0),
    "column": column("white_1", (2.0, -1.0), (0.3, 0.5), 0.6, 0.1, 1.2, tile_m=1.0),
    "ball": ball("white_1", (2.0, -1.0, -1.5), (0.2, 0.3, 0.4), 0.6),
}


@pytest.mark.parametrize("name", BODIES)
def test_normals_point_outward(name: str) -> None:
    body = BODIES[name]
    lengths = np.linalg.norm(body.normal_ned, axis=1)
    np.testing.assert_allclose(lengths, 1.0, atol=1e-5)
    middle = body.position_ned_m.min(axis=0) / 2 + body.position_ned_m.max(axis=0) / 2
    assert ((body.position_ned_m - middle) * body.normal_ned).sum(axis=1).min() > 0.0


@pytest.mark.parametrize("azimuth_deg", [0, 35, 90, 200])
def test_a_block_reaches_as_far_as_it_says(azimuth_deg: float) -> None:
    azimuth = math.radians(azimuth_deg)
    body = block("white_1", (2.0, -1.0), (1.5, 0.4, 0.9), azimuth, 0.3, tile_m=1.0)
    along = np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
    across = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
    offset = body.position_ned_m - np.array([2.0, -1.0, 0.0])
    assert np.ptp(offset @ along) == pytest.approx(1.5, abs=1e-5)
    assert np.ptp(offset @ across) == pytest.approx(0.4, abs=1e-5)
    assert (-offset[:, 2].max(), -offset[:, 2].min()) == pytest.approx((0.3, 1.2), abs=1e-5)


def test_the_texture_of_a_wall_goes_on_across_its_pieces() -> None:
    wall = Wall(
        from_m=(0.0, 0.0),
        to_m=(6.0, 0.0),
        texture="brick_wall_1",
        openings=(Opening(at_m=3.0, width_m=1.0, height_m=2.0),),
    )
    for piece in wall_surfaces(wall, 2.7):
        east_side = piece.normal_ned[:, 1] > 0.9
        # Bricks are 2 m a copy: u follows the way along the wall, v the height.
        np.testing.assert_allclose(
            piece.uv[east_side, 0], piece.position_ned_m[east_side, 0] / 2.0, atol=1e-5
        )
        np.testing.assert_allclose(
            piece.uv[east_side, 1], -piece.position_ned_m[east_side, 2] / 2.0, atol=1e-5
        )


def test_what_is_seen_is_what_can_be_touched() -> None:
    """Everything that a vehicle could hit has the same bounding box as what is drawn for it, furniture with all its layers."""
    world = World(
        name="w",
        start=Start(north_m=0.0, east_m=0.0),
        goal=Goal(north_m=1.0, east_m=0.0),
        walls=(
            Wall(from_m=(-8.0, -8.0), to_m=(9.0, -7.0), openings=(Opening(at_m=3.0, width_m=1.2),)),
            Wall(from_m=(-8.0, 8.0), to_m=(9.0, 8.0), bottom_m=0.5, height_m=1.0),
        ),
        pillars=(Pillar(centre_m=(3.0, 3.0), radius_m=0.3),),
        people=(Person(centre_m=(-3.0, 3.0), yaw_deg=40.0),),
        furniture=tuple(
            Furniture(kind=kind, centre_m=(1.5 * k, -3.0), yaw_deg=90.0 * (k % 4))
            for k, kind in enumerate(MESHES)
        ),
    )
    drawn = np.concatenate([surface.position_ned_m for surface in world_surfaces(world)[2:]])
    nothing = {"walls": (), "pillars": (), "people": ()}
    solid = prisms_of(world)
    alone = [(prism,) for prism in solid if prism.kind != "furniture"]
    layered = [
        prisms_of(world.model_copy(update={**nothing, "furniture": (piece,)})) for piece in world.furniture
    ]
    for prisms in (*alone, *layered):
        outlines = np.concatenate([prism.outline_m for prism in prisms])
        low, high = outlines.min(axis=0), outlines.max(axis=0)
        bottom_m, top_m = prisms[0].bottom_m, prisms[-1].top_m
        inside = ((drawn[:, :2] > low - 0.02) & (drawn[:, :2] < high + 0.02)).all(axis=1)
        inside &= (-drawn[:, 2] > bottom_m - 0.02) & (-drawn[:, 2] < top_m + 0.02)
        points = drawn[inside]
        np.testing.assert_allclose(points[:, :2].min(axis=0), low, atol=0.03, err_msg=prisms[0].kind)
        np.testing.assert_allclose(points[:, :2].max(axis=0), high, atol=0.03, err_msg=prisms[0].kind)
        assert -points[:, 2].max() == pytest.approx(bottom_m, abs=0.02)
        assert -points[:, 2].min() == pytest.approx(top_m, abs=0.02)


def test_only_what_looks_alike_is_joined() -> None:
    one = rectangle("white_1", (0, 0, 0), (0, 1, 0), (1, 0, 0))
    other = rectangle("wood_1", (0, 0, 0), (0, 1, 0), (1, 0, 0))
    with pytest.raises(ValueError, match="look alike"):
        joined([one, other])
    assert len(joined([one, one]).triangles) == 4


@pytest.mark.parametrize(
    ("field", "value"),
    [("uv", np.zeros((3, 2), np.float32)), ("triangles", np.array([[0, 1, 4]], np.uint32))],
)
def test_a_surface_checks_its_shapes(field: str, value: np.ndarray) -> None:
    good = rectangle("white_1", (0, 0, 0), (0, 1, 0), (1, 0, 0))
    parts = {name: getattr(good, name) for name in ("position_ned_m", "normal_ned", "uv", "triangles")}
    with pytest.raises(ValueError, match=field):
        Surface("white_1", **{**parts, field: value})


CUBE = """
mtllib cube.mtl
v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0
vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1
vn 0 0 1
usemtl dark
f 1/1/1 2/2/1 3/3/1 4/4/1
usemtl light
f 1 2 3
"""


def test_a_mesh_has_the_greys_of_its_materials(tmp_path: Path) -> None:
    (tmp_path / "cube.obj").write_text(CUBE)
    (tmp_path / "cube.mtl").write_text("newmtl dark\nKd 0.2 0.2 0.2\nnewmtl light\nKd 1 1 1\n")
    dark, light = load_mesh(tmp_path, "cube")
    assert (dark.grey, light.grey) == pytest.approx((0.2, 1.0))
    assert len(dark.triangles) == 2
    np.testing.assert_array_equal(np.sort(dark.uv, axis=0)[[0, -1]], [[0, 0], [1, 1]])
    np.testing.assert_allclose(light.normal_ned, [[0, 0, 1]] * 3)  # from its corners: the file gives none


@pytest.mark.parametrize(
    "text", ["v 0 0 0\nf 1 2 3\n", "v 0 0 zero\n", "v 0 0 0\nf 0 1 1\n", "v 0 0 0\nf a b c\n"]
)
def test_a_broken_mesh_is_one_clear_error(tmp_path: Path, text: str) -> None:
    (tmp_path / "m.obj").write_text(text)
    with pytest.raises(SimulationExtraError, match=r"m\.obj"):
        load_mesh(tmp_path, "m")


def test_a_missing_mesh_or_picture_is_one_clear_error(tmp_path: Path) -> None:
    with pytest.raises(SimulationExtraError, match="cannot be read"):
        load_mesh(tmp_path, "none")
    (tmp_path / "text.png").write_text("no picture")
    with pytest.raises(SimulationExtraError, match="not a picture"):
        read_grey(tmp_path / "text.png")


def test_textures_are_grey_and_not_too_large() -> None:
    assert load_texture("plain:#ff0000").max() == 76
    assert load_texture("meshes/office_chair").ndim == 2
    assert max(load_texture("door_steel_brown").shape) <= 1024
    with pytest.raises(ValueError, match="plain:#rrggbb"):
        load_texture("wallpaper")
    assert miniworld_folder().name == "miniworld"

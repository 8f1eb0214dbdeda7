from importlib import util
from pathlib import Path
from typing import get_args

import pytest

from companion.sim.world.file import builtin_worlds, load_world
from companion.sim.world.furniture import MESHES, FurnitureKind
from companion.sim.world.textures import PAINTINGS, TILE_SIDE_M, plain_colour_rgb, texture_file


def _wheel() -> Path:
    spec = util.find_spec("miniworld")
    if spec is None or spec.origin is None:
        pytest.skip("the miniworld wheel, extra [sim], is not installed")
    return Path(spec.origin).parent


def test_every_kind_has_a_mesh_of_indoor_size() -> None:
    assert set(MESHES) == set(get_args(FurnitureKind))
    for mesh in MESHES.values():
        along, across, height = mesh.size_m
        assert 0.3 < along < 3.5
        assert 0.3 < across < 1.5
        assert height == pytest.approx(mesh.height_m)


def test_a_desk_keeps_its_proportions() -> None:
    along, across, height = MESHES["desk"].size_m
    assert along / height == pytest.approx(66.9159 / 63.6329, rel=1e-4)
    assert across / height == pytest.approx(32.9025 / 63.6329, rel=1e-4)


def test_bounding_boxes_are_those_of_the_wheel() -> None:
    folder = _wheel() / "meshes"
    for mesh in MESHES.values():
        if mesh.file is None:
            continue
        rows = [
            line.split()[1:4] for line in (folder / mesh.file).read_text().splitlines() if line[:2] == "v "
        ]
        columns = list(zip(*[[float(value) for value in row] for row in rows], strict=True))
        assert mesh.low == pytest.approx([min(column) for column in columns], abs=1e-3)
        assert mesh.high == pytest.approx([max(column) for column in columns], abs=1e-3)


def test_every_texture_is_in_the_wheel() -> None:
    folder = _wheel() / "textures"
    missing = [
        name for name in (*TILE_SIDE_M, *PAINTINGS) if not (folder / str(texture_file(name))).is_file()
    ]
    assert missing == []


def test_a_plain_colour_has_no_file() -> None:
    assert texture_file("plain:#0a10ff") is None
    assert plain_colour_rgb("plain:#0a10ff") == (10, 16, 255)
    assert plain_colour_rgb("wood_1") is None


@pytest.mark.parametrize("name", builtin_worlds())
def test_every_picture_of_a_built_in_world_is_in_the_wheel(name: str) -> None:
    folder = _wheel() / "textures"
    world = load_world(name)
    used = {world.floor_texture, world.ceiling_texture}
    used |= {thing.texture for thing in (*world.walls, *world.boxes, *world.pillars)}
    used |= {picture.texture for wall in world.walls for picture in wall.pictures}
    files = [file for texture in sorted(used) if (file := texture_file(texture)) is not None]
    assert [file for file in files if not (folder / file).is_file()] == []

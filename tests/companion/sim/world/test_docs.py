import re
from pathlib import Path
from typing import get_args

from companion.sim.world.file import builtin_worlds, parse_world
from companion.sim.world.furniture import MESHES
from companion.sim.world.model import World
from companion.sim.world.random import Difficulty
from companion.sim.world.route import find_route
from companion.sim.world.textures import TILE_SIDE_M

_PAGE = (Path(__file__).parents[4] / "docs" / "worlds.md").read_text()


def test_every_key_is_on_the_page() -> None:
    schema = World.model_json_schema()
    models = [schema, *schema["$defs"].values()]
    keys = {key for model in models for key in model["properties"]}
    missing = {key for key in keys if not re.search(rf"`\[*{key}\]*`", _PAGE)}
    assert missing == set()


def test_every_built_in_world_difficulty_and_piece_is_on_the_page() -> None:
    for name in builtin_worlds():
        assert f"| `{name}` |" in _PAGE
    assert f"| | {' | '.join(get_args(Difficulty))} |" in _PAGE
    for kind, mesh in MESHES.items():
        size = " x ".join(f"{side_m:.2f}" for side_m in mesh.size_m)
        assert re.search(rf"\| `{kind}`[^|]*\| {size} \|", _PAGE), (kind, size)


def test_every_texture_is_on_the_page() -> None:
    named = set(re.findall(r"`([a-z0-9_]+)`", _PAGE))
    for first, last in re.findall(r"`(\w+_)1` to `\w+_(\d)`", _PAGE):
        named |= {f"{first}{number}" for number in range(1, int(last) + 1)}
    assert set(TILE_SIDE_M) - named == set()


def test_the_world_to_copy_can_be_flown() -> None:
    text = re.findall(r"```toml\n(.*?)```", _PAGE, flags=re.DOTALL)[0]
    world = parse_world(text)
    assert len(world.walls) == 4
    assert find_route(world) is not None

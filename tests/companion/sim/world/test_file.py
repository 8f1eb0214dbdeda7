from pathlib import Path

import pytest

from companion.errors import ConfigError
from companion.sim.world.clearance import VEHICLE_RADIUS_M
from companion.sim.world.file import builtin_worlds, load_world, parse_world
from companion.sim.world.route import find_route

_LEAST = """
name = "hall"
[start]
north_m = 0
east_m = 0
[goal]
north_m = 5
east_m = 0
"""
_WALL = """
[[walls]]
from_m = [-1, -2]
to_m = [-1, 2.5]
"""


def _message(text: str) -> str:
    with pytest.raises(ConfigError) as caught:
        parse_world(text, name="my.toml")
    return str(caught.value)


def test_a_file_is_read(tmp_path: Path) -> None:
    path = tmp_path / "hall.toml"
    path.write_text(_LEAST + _WALL)
    world = load_world(path)
    assert world == load_world(str(path))
    assert world.walls[0].to_m == (-1.0, 2.5)


@pytest.mark.parametrize(
    ("more", "line"),
    [
        ("thickness_m = 9", "walls[0].thickness_m: found 9; allowed: number from 0.01 and up to 5"),
        ("thikness_m = 1", "walls[0].thikness_m: unknown key; did you mean walls[0].thickness_m?"),
        ("height_m = 'x'", 'walls[0].height_m: found "x"; allowed: number from 0.01 and up to 400'),
        ("openings = 3", "walls[0].openings: found 3; allowed: tables, [[walls.openings]], at most 500"),
        (
            "[[walls.openings]]\nwidth_m = 1",
            "walls[0].openings[0].at_m: found nothing; allowed: number from 0 and up to 400",
        ),
        (
            "[[walls.openings]]\nat_m = 4.2\nwidth_m = 1",
            "walls[0].openings[0].at_m: found 4.2 with width_m = 1; allowed: within the wall's length of 4.500 m",
        ),
        (
            "[[walls.pictures]]\nat_m = 2\nside = 'top'\ntexture = 'wood_1'",
            'walls[0].pictures[0].side: found "top"; allowed: one of "left", "right"',
        ),
        ("[light]\nambient = true", "light.ambient: found true; allowed: number from 0 and up to 1"),
        (
            "[[pillars]]\ncentre_m = [1]",
            "pillars[0].centre_m[1]: found nothing; allowed: number from -200 and up to 200",
        ),
        (
            "[[boxes]]\ncentre_m = 3\nsize_m = [1, 1, 1]",
            "boxes[0].centre_m: found 3; allowed: 2 numbers, [north, east] (m)",
        ),
        (
            "[[people]]\ncentre_m = [0.3, 0]",
            "start: found 0.15 m from the nearest thing; allowed: room for a vehicle of 0.35 m radius",
        ),
    ],
)
def test_a_fault_is_one_line_with_file_key_found_and_allowed(more: str, line: str) -> None:
    assert _message(_LEAST + _WALL + more) == f"my.toml: {line}"


def test_all_faults_are_told_at_once() -> None:
    message = _message("name = 'x'\nfloor_texture = 'lava'\nstart = 3\n[goal]\nnorth_m = 1\neast_m = '2'")
    assert [line.split(" found ")[0] for line in message.splitlines()] == [
        "my.toml: floor_texture:",
        "my.toml: start:",
        "my.toml: goal.east_m:",
    ]
    assert "brick_wall_1" in message
    assert "allowed: a table with north_m, east_m" in message


def test_no_toml_no_file_no_name(tmp_path: Path) -> None:
    assert _message("name = ").startswith("my.toml: not valid TOML: ")
    with pytest.raises(ConfigError, match="no such file"):
        load_world(tmp_path / "none.toml")
    with pytest.raises(ConfigError, match="give the world file itself"):
        load_world(tmp_path)
    with pytest.raises(ConfigError, match="did you mean corridor"):
        load_world("coridor")
    with pytest.raises(ConfigError, match=r"allowed: a \.toml file, or barewalls, corridor"):
        load_world("moon")


def test_the_built_in_worlds_are_these() -> None:
    assert builtin_worlds() == (
        "barewalls",
        "corridor",
        "deadend",
        "door",
        "lcorridor",
        "room",
        "siderooms",
        "tjunction",
    )


@pytest.mark.parametrize("name", builtin_worlds())
def test_a_built_in_world_keeps_its_word_about_its_goal(name: str) -> None:
    world = load_world(name)
    assert world.name == name
    assert world.goal_reachable == (name != "deadend")
    route = find_route(world, VEHICLE_RADIUS_M + 0.03)
    assert (route is not None) == world.goal_reachable

import math

import numpy as np
import pytest

from companion.errors import ConfigError
from companion.sim.world.clearance import VEHICLE_RADIUS_M, Obstacles
from companion.sim.world.model import World
from companion.sim.world.random import Difficulty, random_world
from companion.sim.world.route import Route, find_route, point_route

_MARGIN_M = {"easy": 0.2, "medium": 0.15, "hard": 0.05}
_WORLDS = [("easy", 1), ("easy", 5), *(("medium", seed) for seed in range(5)), ("hard", 2), ("hard", 3)]


def _blocked(world: World) -> bool:
    north, east = world.goal.north_m - world.start.north_m, world.goal.east_m - world.start.east_m
    position = (world.start.north_m, world.start.east_m, -world.start.height_m)
    return Obstacles.of(world).free_distance_m(position, math.atan2(east, north)) < math.hypot(north, east)


@pytest.mark.parametrize(("difficulty", "seed"), _WORLDS)
def test_the_reference_path_can_be_flown(difficulty: Difficulty, seed: int) -> None:
    world = random_world(seed, difficulty)
    path = np.array(world.reference_path_m)
    assert path[0].tolist() == [world.start.north_m, world.start.east_m]
    assert path[-1].tolist() == [world.goal.north_m, world.goal.east_m]
    obstacles = Obstacles.of(world)
    height_m = world.start.height_m
    points = point_route(Route(path, 0.0), 0.05).tolist()
    least_m = min(obstacles.clearance_m((north, east, -height_m)) for north, east in points)
    assert least_m >= _MARGIN_M[difficulty] - 0.005  # corners are kept to the millimetre
    assert difficulty == "easy" or _blocked(world)


def test_the_same_seed_gives_the_same_world_and_another_one_another() -> None:
    world = random_world(4, "medium")
    assert random_world(4, "medium") == world
    others = [random_world(5, "medium"), random_world(4, "hard"), random_world(4, "medium", 0.3)]
    assert all(other != world for other in others[:2])
    # A smaller vehicle may get the same things, but a path of its own.
    assert others[2].reference_path_m != world.reference_path_m


def test_a_world_survives_its_own_check() -> None:
    world = random_world(3, "hard")
    assert World.model_validate_json(world.model_dump_json()) == world
    assert find_route(world, VEHICLE_RADIUS_M, grid_m=0.05) is not None


def test_harder_worlds_are_narrower() -> None:
    def corridor_m(seed: int, difficulty: Difficulty) -> float:
        about = random_world(seed, difficulty).description
        assert "bends" in about
        return float(about.split(" of ")[1].split(" m")[0])

    for seed in (4, 5):  # the floor plan's kind is the seed's, whatever the difficulty
        assert 2.2 <= corridor_m(seed, "easy") <= 3.0
        assert 1.8 <= corridor_m(seed, "hard") <= 2.6


def test_what_is_not_allowed_is_said() -> None:
    with pytest.raises(ConfigError, match="difficulty: found 'extreme'; allowed: easy, medium, hard"):
        random_world(1, "extreme")  # type: ignore[arg-type]  # what a command line may bring
    with pytest.raises(ConfigError, match="seed: found -1"):
        random_world(-1)

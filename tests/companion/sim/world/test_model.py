import pickle
from typing import Any

import pytest
from pydantic import ValidationError

from companion.sim.world.model import World

_LEAST: dict[str, Any] = {
    "name": "hall",
    "start": {"north_m": 0, "east_m": 0},
    "goal": {"north_m": 5, "east_m": 0},
}


def _wall(**more: Any) -> dict[str, Any]:
    return {"walls": [{"from_m": [0, 0], "to_m": [4.0, 0], **more}]}


def test_lists_and_whole_numbers_of_a_file_become_tuples_of_floats() -> None:
    world = World.model_validate(_LEAST | _wall(openings=[{"at_m": 2, "width_m": 1}]))
    assert world.walls[0].from_m == (0.0, 0.0)
    assert world.walls[0].openings[0].height_m == 2.1
    assert world.goal.north_m == 5.0


def test_a_world_is_hashable_and_crosses_processes() -> None:
    world = World.model_validate(_LEAST | _wall())
    assert pickle.loads(pickle.dumps(world)) == world  # noqa: S301 - our own bytes
    assert hash(world) == hash(world.model_copy())


@pytest.mark.parametrize(
    ("more", "loc"),
    [
        ({"start": {"north_m": True, "east_m": 0}}, ("start", "north_m")),
        ({"start": {"north_m": "1", "east_m": 0}}, ("start", "north_m")),
        ({"start": {"north_m": float("nan"), "east_m": 0}}, ("start", "north_m")),
        ({"walls": [{"from_m": [0, "1"], "to_m": [1, 1]}]}, ("walls", 0, "from_m", 1)),
        (_wall(colour="red"), ("walls", 0, "colour")),
        (_wall(texture="brick"), ("walls", 0, "texture")),
        (_wall(texture="plain:#12345"), ("walls", 0, "texture")),
        (_wall(texture="portraits/../x"), ("walls", 0, "texture")),
        ({"furniture": [{"kind": "sofa", "centre_m": [1, 1]}]}, ("furniture", 0, "kind")),
    ],
)
def test_a_wrong_key_is_found_where_it_is(more: dict[str, Any], loc: tuple[str | int, ...]) -> None:
    with pytest.raises(ValidationError) as caught:
        World.model_validate(_LEAST | more)
    assert [error["loc"] for error in caught.value.errors()] == [loc]


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (_wall(openings=[{"at_m": 3.8, "width_m": 1.0}]), r"openings\[0\].at_m: found 3.8"),
        (_wall(pictures=[{"at_m": 0.1, "side": "left", "texture": "wood_1"}]), r"pictures\[0\].at_m"),
        (_wall(openings=[{"at_m": 1.0, "width_m": 1.0}, {"at_m": 1.5, "width_m": 1.0}]), "overlap"),
        ({"walls": [{"from_m": [1, 1], "to_m": [1, 1]}]}, "to_m: found 0 m from from_m"),
        ({"name": "open air"}, "walls: found none; allowed: at least one"),
        (_wall(bottom_m=1.0, height_m=2.0), r"walls\[0\].height_m: found a top at 3 m"),
        (
            _wall() | {"people": [{"centre_m": [1, 1], "height_m": 2.0}], "ceiling_m": 1.9},
            r"people\[0\].height_m",
        ),
        (_wall() | {"goal": {"north_m": 5, "east_m": 0, "height_m": 3.0}}, "goal.height_m"),
    ],
)
def test_keys_that_cannot_both_hold_are_named(more: dict[str, Any], words: str) -> None:
    with pytest.raises(ValidationError, match=words):
        World.model_validate(_LEAST | more)

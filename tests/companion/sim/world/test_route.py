import math

import numpy as np
import pytest

from companion.sim.world.clearance import Obstacles
from companion.sim.world.model import Box, Goal, Opening, Start, Wall, World
from companion.sim.world.route import find_route, point_route


def _hall(*boxes: Box, door_m: float | None = None, goal_north_m: float = 8.0) -> World:
    """A closed hall, 10 m north by 4 m east, with a wall across its middle that has one door at east 3."""
    corners = [(-1.0, 0.0), (9.0, 0.0), (9.0, 4.0), (-1.0, 4.0)]
    walls = [Wall(from_m=a, to_m=b) for a, b in zip(corners, corners[1:] + corners[:1], strict=True)]
    if door_m is not None:
        openings = (Opening(at_m=3.0, width_m=door_m),) if door_m else ()
        walls.append(Wall(from_m=(4.0, 0.0), to_m=(4.0, 4.0), openings=openings))
    return World(
        name="hall",
        start=Start(north_m=0.0, east_m=1.0),
        goal=Goal(north_m=goal_north_m, east_m=1.0),
        walls=tuple(walls),
        boxes=boxes,
    )


def test_a_free_way_is_the_straight_line() -> None:
    route = find_route(_hall())
    assert route is not None
    assert route.points_m.tolist() == [[0.0, 1.0], [8.0, 1.0]]
    assert route.length_m == 8.0


def test_the_way_leads_through_the_door_and_can_be_flown() -> None:
    world = _hall(door_m=1.0)
    route = find_route(world)
    assert route is not None
    # around the door's near post, 0.35 m off: not shorter than the string, and at most a cell or two longer
    string_m = 2.0 * math.hypot(4.0, 1.5 + 0.35)
    assert string_m - 0.2 <= route.length_m <= string_m + 0.3
    obstacles = Obstacles.of(world)
    points = point_route(route, 0.05)
    assert points[0].tolist() == [0.0, 1.0]
    assert points[-1].tolist() == [8.0, 1.0]
    assert np.hypot(*np.diff(points, axis=0).T).max() <= 0.05 + 1e-9
    assert min(obstacles.clearance_m((n, e, -1.2)) for n, e in points.tolist()) > 0.0


@pytest.mark.parametrize(
    ("world", "radius_m"),
    [
        (_hall(door_m=0.0), 0.35),  # no door
        (_hall(door_m=0.8), 0.45),  # too narrow a door
        (_hall(goal_north_m=8.8), 0.35),  # a goal within the wall's reach
        (_hall(Box(centre_m=(4.0, 2.0), size_m=(0.5, 3.0, 2.7))), 0.35),  # 0.5 m on each side
    ],
)
def test_no_way_is_none(world: World, radius_m: float) -> None:
    assert find_route(world, radius_m) is None


def test_what_lies_under_the_vehicle_or_above_it_is_no_hindrance() -> None:
    for bottom_m, height_m, blocked in ((0.0, 0.9, False), (1.5, 1.0, False), (0.0, 1.1, True)):
        beam = Box(centre_m=(4.0, 2.0), size_m=(0.5, 4.0, height_m), bottom_m=bottom_m)
        assert (find_route(_hall(beam)) is None) == blocked

import numpy as np
import pytest

from companion.sim.world.file import load_world
from companion.sim.world.model import Box, Goal, Opening, Start, Wall, World
from companion.sim.world.top_view import plan_sheet, top_view

_WORLD = World(
    name="hall",
    start=Start(north_m=0.0, east_m=0.0, yaw_deg=90.0),
    goal=Goal(north_m=6.0, east_m=2.0),
    walls=(
        Wall(
            from_m=(3.0, -2.0), to_m=(3.0, 4.0), thickness_m=0.2, openings=(Opening(at_m=4.0, width_m=1.0),)
        ),
    ),
    boxes=(
        Box(centre_m=(1.5, -1.0), size_m=(1.0, 1.0, 2.0)),
        Box(centre_m=(1.5, 3.0), size_m=(1.0, 1.0, 0.5)),
    ),
    reference_path_m=((0.0, 0.0), (3.0, 2.0), (6.0, 2.0)),
)


def _colour(north_m: float, east_m: float, *, with_path: bool = False) -> tuple[int, ...]:
    view = top_view(_WORLD, px_per_m=50.0, with_reference_path=with_path)
    x, y = np.round(view.pixels([(north_m, east_m)])[0]).astype(int)
    return tuple(view.image[y, x].tolist())


def test_things_stand_where_they_are_and_low_ones_are_not_filled() -> None:
    floor = _colour(4.5, -1.0)
    wall = _colour(3.0, -1.0)
    box = _colour(1.5, -1.0)
    assert len({floor, wall, box}) == 3
    assert _colour(3.0, 2.0) == floor  # the doorway: its lintel is higher up
    assert _colour(1.5, 3.0) == floor  # 0.5 m high
    assert _colour(1.0, 3.0) != floor  # but outlined


def test_start_heading_goal_and_path_are_marked() -> None:
    floor = _colour(4.5, -1.0)
    assert _colour(0.0, 0.0) == _colour(0.0, 0.5) != floor  # it looks east
    assert _colour(0.5, 0.0) == floor
    assert _colour(6.0, 2.0) not in (floor, _colour(0.0, 0.0))
    assert _colour(4.5, 2.0, with_path=True) != floor
    assert _colour(4.5, 2.0) == floor


def test_a_flown_path_can_be_drawn_from_positions_with_height() -> None:
    view = top_view(_WORLD, px_per_m=50.0)
    before = view.image.copy()
    view.draw_path(np.array([[4.0, -1.5, -1.2], [5.0, -1.5, -1.3]]), (0, 0, 255))
    changed = np.argwhere((view.image != before).any(axis=2))[:, ::-1]
    assert changed.min(axis=0) == pytest.approx(view.pixels([(5.0, -1.5)])[0], abs=3)
    assert changed.max(axis=0) == pytest.approx(view.pixels([(4.0, -1.5)])[0], abs=3)


def test_a_sheet_holds_every_plan() -> None:
    worlds = tuple(load_world(name) for name in ("room", "door", "corridor"))
    sheet = plan_sheet(worlds, px_per_m=10.0, columns=2)
    upper = top_view(worlds[0], px_per_m=10.0).image.shape[0]
    lower = top_view(worlds[2], px_per_m=10.0).image.shape[0]
    assert sheet.shape[0] >= upper + lower
    assert (sheet[-lower // 2, :] != 255).any()

import math

import numpy as np
import pytest

from companion.sim.world.clearance import Obstacles
from companion.sim.world.model import Box, Furniture, Goal, Opening, Person, Pillar, Start, Wall, World
from companion.sim.world.prisms import Prism, ellipse_m, prisms_of, rectangle_m, wall_prisms


def _cube(yaw_deg: float = 0.0) -> Obstacles:
    """A cube of 2 m around (5, 0), from 0 to 2 m."""
    outline = rectangle_m((5.0, 0.0), 2.0, 2.0, math.radians(yaw_deg))
    return Obstacles.of_prisms((Prism(outline, 0.0, 2.0, "box"),), ceiling_m=10.0)


def _clutter(seed: int, count: int = 30) -> tuple[Prism, ...]:
    rng = np.random.default_rng(seed)
    prisms = []
    for index in range(count):
        centre = (float(rng.uniform(-8, 8)), float(rng.uniform(-8, 8)))
        along, across, yaw = rng.uniform(0.1, 2.0), rng.uniform(0.1, 2.0), rng.uniform(-math.pi, math.pi)
        outline = (
            rectangle_m(centre, along, across, yaw)
            if index % 2
            else ellipse_m(centre, along, across, yaw, 12)
        )
        bottom = float(rng.choice([0.0, 1.0, 1.6]))
        prisms.append(Prism(outline, bottom, bottom + float(rng.uniform(0.2, 1.5)), "box"))
    return tuple(prisms)


@pytest.mark.parametrize(
    ("position", "expected_m"),
    [
        ((0.0, 0.0, -1.0), 4.0 - 0.35),
        ((4.0, 4.0, -1.0), 3.0 - 0.35),
        ((1.0, -4.0, -1.0), math.hypot(3, 3) - 0.35),
        ((5.0, 0.0, -3.0), 1.0 - 0.2),  # above it
        ((0.0, 0.0, -3.2), math.hypot(3.65, 1.0)),  # beside and above: from its edge to the edge of the cube
        ((5.0, 0.0, -9.5), 0.3),  # the ceiling is nearest
        ((3.75, 0.0, -1.0), -0.1),  # 0.1 m inside
        ((0.0, 0.0, -10.0), -0.2),  # into the ceiling
    ],
)
def test_clearance_of_a_cube(position: tuple[float, float, float], expected_m: float) -> None:
    assert _cube().clearance_m(position) == pytest.approx(expected_m, abs=1e-9)
    assert _cube().collides(position) == (expected_m <= 0.0)


def test_free_distance_ends_at_sides_and_corners() -> None:
    cube = _cube()
    assert cube.free_distance_m((0.0, 0.0, -1.0), 0.0) == pytest.approx(3.65)
    # 1.2 m beside its middle line the disc meets a corner 0.2 m off its own: sqrt(0.35^2 - 0.2^2) before it
    grazing = 4.0 - math.sqrt(0.35**2 - 0.2**2)
    assert cube.free_distance_m((0.0, 1.2, -1.0), 0.0) == pytest.approx(grazing)
    assert cube.free_distance_m((0.0, 1.36, -1.0), 0.0) == 30.0
    assert cube.free_distance_m((0.0, 0.0, -1.0), math.pi) == 30.0
    assert cube.free_distance_m((0.0, 0.0, -2.3), 0.0) == 30.0  # over it
    assert cube.free_distance_m((3.7, 0.0, -1.0), math.pi) == 0.0  # touches already
    assert cube.free_distance_m((0.0, 0.0, -1.0), 0.0, limit_m=2.0) == 2.0


@pytest.mark.parametrize("seed", range(5))
def test_the_swept_disc_stops_where_clearance_ends(seed: int) -> None:
    obstacles = Obstacles.of_prisms(_clutter(seed))
    rng = np.random.default_rng(100 + seed)
    azimuths = np.radians(np.arange(72) * 5.0)
    checked = 0
    while checked < 3:
        north, east = rng.uniform(-8, 8, 2)
        position = (float(north), float(east), -1.2)

        def beside_m(way: float, azimuth: float, at: tuple[float, float, float] = position) -> float:
            # So flat a vehicle that only what reaches its height is near.
            moved = (at[0] + way * math.cos(azimuth), at[1] + way * math.sin(azimuth), at[2])
            return obstacles.clearance_m(moved, half_height_m=0.2)

        if beside_m(0.0, 0.0) <= 0.0:
            continue
        checked += 1
        free = obstacles.free_distances_m(position, azimuths, limit_m=12.0)
        for azimuth, way in zip(azimuths.tolist(), free.tolist(), strict=True):
            if way < 12.0:
                assert beside_m(way + 1e-6, azimuth) <= 1e-6
            assert min(beside_m(part * way, azimuth) for part in np.linspace(0.0, 1.0, 40)) > -1e-9


@pytest.mark.parametrize("seed", range(3))
def test_clearance_is_that_of_points_on_the_outlines(seed: int) -> None:
    prism = _clutter(seed, 1)[0]
    obstacles = Obstacles.of_prisms((prism,))
    corners = prism.outline_m
    step = np.linspace(0.0, 1.0, 2001)[:, None]
    points = np.concatenate(
        [a + step * (b - a) for a, b in zip(corners, np.roll(corners, -1, 0), strict=True)]
    )
    height = (prism.bottom_m + prism.top_m) / 2
    rng = np.random.default_rng(seed)
    for position in rng.uniform(-9, 9, (20, 2)):
        nearest = float(np.hypot(*(points - position).T).min())
        found = obstacles.clearance_m((float(position[0]), float(position[1]), -height), radius_m=0.0)
        assert abs(found) == pytest.approx(nearest, abs=1e-3)


def test_a_doorway_leaves_two_parts_and_a_lintel() -> None:
    wall = Wall(
        from_m=(0.0, 0.0), to_m=(0.0, 4.0), thickness_m=0.2, openings=(Opening(at_m=1.5, width_m=1.0),)
    )
    parts = wall_prisms(wall, 2.7)
    extents = [(p.outline_m[:, 1].min(), p.outline_m[:, 1].max(), p.bottom_m, p.top_m) for p in parts]
    assert extents == [
        pytest.approx((0.0, 1.0, 0.0, 2.7)),
        pytest.approx((1.0, 2.0, 2.1, 2.7)),
        pytest.approx((2.0, 4.0, 0.0, 2.7)),
    ]
    obstacles = Obstacles.of_prisms(parts)
    assert obstacles.clearance_m((0.0, 1.5, -1.2)) == pytest.approx(0.15)
    assert obstacles.free_distance_m((-2.0, 1.5, -1.2), 0.0) == 30.0
    assert obstacles.free_distance_m((-2.0, 1.5, -2.1), 0.0) == pytest.approx(2.0 - 0.1 - 0.35)
    assert obstacles.free_distance_m((-2.0, 1.1, -1.2), 0.0) < 2.0


def test_everything_that_stands_in_a_world_is_touched() -> None:
    world = World(
        name="all",
        start=Start(north_m=0.0, east_m=0.0),
        goal=Goal(north_m=9.0, east_m=0.0),
        walls=(Wall(from_m=(-1.0, -3.0), to_m=(-1.0, 3.0)),),
        boxes=(Box(centre_m=(3.0, 0.0), size_m=(1.0, 2.0, 0.5), yaw_deg=90.0, bottom_m=1.0),),
        pillars=(Pillar(centre_m=(0.0, 3.0), radius_m=0.5),),
        people=(Person(centre_m=(0.0, -3.0), height_m=2.0, yaw_deg=90.0),),
        furniture=(Furniture(kind="crate", centre_m=(6.0, 0.0), yaw_deg=45.0),),
    )
    kinds = [prism.kind for prism in prisms_of(world)]
    assert kinds == ["wall", "box", "pillar", "person", "furniture"]
    free = Obstacles.of(world).free_distances_m((0.0, 0.0, -1.2), np.radians([0.0, 90.0, 180.0, 270.0]))
    # the box is turned: 2 m along north; the person looks east: 0.34 m deep that way; the wall is 0.15 m thick
    assert free == pytest.approx(
        [3.0 - 1.0 - 0.35, 2.5 - 0.35, 1.0 - 0.075 - 0.35, 3.0 - 0.17 - 0.35], abs=0.03
    )
    low = Obstacles.of(world).free_distance_m((5.0, 0.0, -0.6), 0.0)
    assert low == pytest.approx(1.0 - 0.4 * math.sqrt(2.0) - 0.35)


def test_nothing_is_near_in_an_empty_world() -> None:
    empty = Obstacles.of_prisms((), ceiling_m=3.0)
    assert empty.clearance_m((0.0, 0.0, -1.2)) == pytest.approx(1.6)
    assert empty.free_distance_m((0.0, 0.0, -1.2), 1.0) == 30.0

"""What several profiles say together, carried along by the pose."""

from __future__ import annotations

import math

import numpy as np
import pytest

from detector.parallax.map_memory import MapMemory, MapMemoryParams, carried
from detector.parallax.void_map import BINS, VoidMap, VoidMapParams

PARAMS = VoidMapParams()


def box(
    half_m: float, north_m: float = 0.0, east_m: float = 0.0, *, half_view_deg: int = 180, look_deg: int = 0
) -> VoidMap:
    """The map from inside a square, from a place in it, of what a camera with a field of view sees."""
    empty = VoidMap.unknown()
    cos, sin = np.cos(empty.azimuth_rad), np.sin(empty.azimuth_rad)
    with np.errstate(divide="ignore"):
        ahead = np.where(
            cos > 1e-9, (half_m - north_m) / cos, np.where(cos < -1e-9, -(half_m + north_m) / cos, np.inf)
        )
        aside = np.where(
            sin > 1e-9, (half_m - east_m) / sin, np.where(sin < -1e-9, -(half_m + east_m) / sin, np.inf)
        )
    off = (np.degrees(empty.azimuth_rad) - look_deg + 180.0) % 360.0 - 180.0
    known = np.abs(off) <= half_view_deg
    return VoidMap(
        empty.azimuth_rad,
        np.where(known, np.minimum(ahead, aside), 0.0),
        np.where(known, 30, 0),
        np.where(known, 0.1, np.inf),
        known,
    )


def test_a_carried_map_is_the_map_from_the_other_place() -> None:
    there = carried(box(5.0), 0.8, -0.5)
    expected = box(5.0, 0.8, -0.5)
    both = there.known & expected.known
    assert both.sum() > 0.95 * BINS
    np.testing.assert_allclose(there.free_m[both], expected.free_m[both], rtol=0.03)


def test_what_hides_behind_a_near_border_is_not_told_from_elsewhere() -> None:
    found = box(6.0)
    free = found.free_m.copy()
    near = np.abs(np.degrees(found.azimuth_rad)) <= 10.0
    free[near] = 1.5
    there = carried(VoidMap(found.azimuth_rad, free, found.count, found.sigma_m, found.known), 0.0, -2.0)
    # Seen from the west, the near thing stands to the north-east, and it hides what lies behind it.
    assert there.free_m[there.at(math.atan2(2.0, 1.5))] == pytest.approx(2.5, abs=0.4)


def test_one_bad_profile_of_four_changes_nothing() -> None:
    memory = MapMemory()
    for index in range(4):
        memory.add(box(1.0 if index == 2 else 5.0), (0.0, 0.0), float(index))
    remembered = memory.remembered((0.0, 0.0), 4.0)
    assert remembered.found.free_m[0] == pytest.approx(5.0)
    assert remembered.profiles[0] == 4
    assert remembered.agreeing[0] == 3


def test_of_two_the_nearer_counts() -> None:
    memory = MapMemory(MapMemoryParams(fade_s=600.0))
    memory.add(box(2.0), (0.0, 0.0), 0.0)
    memory.add(box(5.0), (0.0, 0.0), 0.0)
    assert memory.remembered((0.0, 0.0), 0.0).found.free_m[0] == pytest.approx(2.0)


def test_a_turn_does_not_forget() -> None:
    memory = MapMemory()
    memory.add(box(5.0, half_view_deg=35), (0.0, 0.0), 0.0)
    for index in range(1, 8):
        look = 20 * index
        memory.add(box(5.0, half_view_deg=35, look_deg=look), (0.0, 0.0), 0.3 * index)
    found = memory.remembered((0.0, 0.0), 2.4).found
    assert found.known[found.at(0.0)], "seen before the turn, out of view now"
    assert found.free_m[found.at(0.0)] == pytest.approx(5.0)
    assert not found.known[found.at(math.radians(-90.0))], "never seen"


def test_a_vehicle_that_stays_keeps_room_for_what_it_saw_elsewhere() -> None:
    memory = MapMemory(MapMemoryParams(kept=3, fade_distance_m=50.0, fade_s=600.0))
    memory.add(box(5.0, half_view_deg=20, look_deg=90), (0.0, 0.0), 0.0)
    for index in range(1, 30):
        memory.add(box(5.0, half_view_deg=20), (0.0, 0.001 * index), 0.1 * index)
    found = memory.remembered((0.0, 0.03), 3.0).found
    assert found.known[found.at(0.0)]
    assert found.known[found.at(math.radians(90.0))], "seen once, before all the others"


def test_it_fades_with_distance_and_with_age() -> None:
    memory = MapMemory(MapMemoryParams(fade_distance_m=0.5, fade_s=2.0))
    memory.add(box(20.0), (0.0, 0.0), 0.0)
    assert memory.remembered((0.2, 0.0), 0.5).found.known.any()
    assert not memory.remembered((4.0, 0.0), 0.5).found.known.any()
    assert not memory.remembered((0.2, 0.0), 60.0).found.known.any()


def test_after_it_forgot_it_knows_nothing() -> None:
    memory = MapMemory()
    memory.add(box(5.0), (0.0, 0.0), 0.0)
    memory.forget()
    assert len(memory) == 0
    assert not memory.remembered((0.0, 0.0), 0.0).found.known.any()


def test_a_map_without_scale_cannot_be_carried() -> None:
    with pytest.raises(ValueError, match="metres"):
        MapMemory().add(VoidMap.unknown(metric=False), (0.0, 0.0), 0.0)


def two_gaps(left_m: float, right_m: float) -> VoidMap:
    found = VoidMap.unknown()
    free, known = found.free_m.copy(), found.known.copy()
    degrees = np.degrees(found.azimuth_rad)
    known[np.abs(degrees) <= 35.0] = True
    free[known] = 1.0
    free[np.abs(degrees + 25.0) <= 8.0] = left_m
    free[np.abs(degrees - 25.0) <= 8.0] = right_m
    return VoidMap(found.azimuth_rad, free, np.where(known, 30, 0), np.where(known, 0.1, np.inf), known)


def test_the_answer_stays_until_another_gap_is_clearly_better() -> None:
    memory = MapMemory()

    def answered_deg(left_m: float, right_m: float) -> float:
        gap = memory.answer(two_gaps(left_m, right_m), PARAMS)
        assert gap is not None
        return math.degrees(gap.azimuth_rad)

    assert answered_deg(5.0, 4.0) == pytest.approx(-25.0, abs=2.0)
    assert answered_deg(4.5, 5.0) == pytest.approx(-25.0, abs=2.0), "hardly better: it stays"
    assert answered_deg(3.0, 5.0) == pytest.approx(25.0, abs=2.0), "clearly better: it goes"
    assert answered_deg(5.0, 4.5) == pytest.approx(25.0, abs=2.0)
    memory.forget()
    assert answered_deg(5.0, 4.5) == pytest.approx(-25.0, abs=2.0)

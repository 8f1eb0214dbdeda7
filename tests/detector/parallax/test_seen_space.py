"""A way is known only through places that several pairs in a row looked past, with room for the whole vehicle."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from detector.parallax.coverage import looked_past
from detector.parallax.samples import RangedSamples
from detector.parallax.seen_space import LOOKS, WAYS, SeenSpace
from detector.parallax.void_map import VoidMapParams

PARAMS = VoidMapParams()
FAR_M = 6.0
CAMERA_M = 1.2
"""Of the camera above the floor."""


def view(half_deg: float = 38.0) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Azimuths and elevations (rad, positive down) of a picture's grid, two degrees apart."""
    azimuth, down = np.meshgrid(
        np.radians(np.arange(-half_deg, half_deg + 1.0, 2.0)), np.radians(np.arange(-28.0, 29.0, 2.0))
    )
    return azimuth.ravel(), down.ravel()


def seen(
    range_m: NDArray[np.float64] | float = FAR_M,
    told: NDArray[np.bool_] | None = None,
    half_deg: float = 38.0,
) -> RangedSamples:
    """What a camera that looks north says, with a standard deviation of 0.004 1/m."""
    azimuth, down = view(half_deg)
    n = len(azimuth)
    rays = np.column_stack([np.cos(down) * np.cos(azimuth), np.cos(down) * np.sin(azimuth), np.sin(down)])
    inverse = np.broadcast_to(1.0 / np.asarray(range_m, np.float64), n)
    return RangedSamples(
        rays,
        inverse,
        np.full(n, 0.004),
        np.zeros((n, 2)),
        True,
        np.ones(n, np.bool_) if told is None else told,
    )


def floor_only() -> RangedSamples:
    """A plain wall 4 m ahead: nothing is told but the floor in front of it."""
    _, down = view()
    range_m = np.where(down > 0.0, CAMERA_M / np.sin(np.maximum(down, 1e-3)), FAR_M)
    return seen(range_m, range_m * np.cos(down) < 4.0)


class Flight:
    """A vehicle that flies north and takes pairs, five a second."""

    def __init__(self) -> None:
        self.space = SeenSpace(PARAMS)
        self.north_m = self.time_s = 0.0

    def take(self, samples: RangedSamples, times: int = 1, ahead_m: float = 0.0) -> None:
        for _ in range(times):
            self.time_s += 0.2
            self.north_m += ahead_m
            self.space.been((self.north_m, 0.0), self.time_s)
            self.space.look(samples, (self.north_m, 0.0), self.time_s)

    def reach_m(self, azimuth_deg: float) -> float:
        reach = self.space.reach_m((self.north_m, 0.0), self.time_s)
        return float(reach[round(azimuth_deg / 360.0 * WAYS) % WAYS])


def test_nothing_is_known_before_anything_was_seen() -> None:
    assert Flight().space.reach_m((0.0, 0.0), 0.0).max() < 0.25


def test_a_way_ahead_opens_with_the_third_look_and_those_out_of_view_do_not() -> None:
    flight = Flight()
    flight.take(seen(), LOOKS - 1)
    assert flight.reach_m(0.0) < 0.25
    flight.take(seen())
    assert flight.reach_m(0.0) == pytest.approx(PARAMS.covered_m)
    assert flight.reach_m(90.0) < 0.25
    assert flight.reach_m(180.0) < 0.25


def test_pairs_that_follow_at_once_are_one_look() -> None:
    space = SeenSpace(PARAMS)
    for count in range(10):
        space.been((0.0, 0.0), 0.01 * count)
        space.look(seen(), (0.0, 0.0), 0.01 * count)
    assert space.reach_m((0.0, 0.0), 0.1).max() < 0.25


def test_a_pair_that_shows_nothing_breaks_the_row() -> None:
    flight = Flight()
    flight.take(seen(), LOOKS - 1)
    flight.space.missed()
    flight.take(seen(), LOOKS - 1)
    assert flight.reach_m(0.0) < 0.25


def test_what_was_looked_through_stays_so_out_of_view() -> None:
    flight = Flight()
    flight.take(seen(), LOOKS)
    flight.take(seen(), 6, ahead_m=0.15)
    flight.space.missed()
    assert flight.reach_m(180.0) >= 0.3, "the way that it came"
    flight.time_s += 61.0
    assert flight.reach_m(180.0) < 0.25, "after a minute the estimate has drifted"


def test_the_disc_is_swept_past_the_edge_of_the_view() -> None:
    narrow = Flight()
    narrow.take(seen(half_deg=20.0), LOOKS)
    wide = Flight()
    wide.take(seen(), LOOKS)
    assert narrow.reach_m(0.0) < 0.5 < wide.reach_m(0.0)
    assert wide.reach_m(30.0) < 0.5, "the right shoulder would go where nothing was seen"


def test_a_plain_wall_beside_a_door_is_not_flown_into() -> None:
    azimuth, _ = view()
    door = Flight()
    # Through the door, from straight ahead to the right edge, it looks far; of the wall on the left nothing is told.
    door.take(seen(told=azimuth >= 0.0), LOOKS)
    assert door.reach_m(-12.0) < 0.5
    door.take(seen(told=azimuth >= 0.0), LOOKS, ahead_m=0.2)
    assert door.reach_m(0.0) < 1.0, "its left half is in front of the wall"


def test_what_stands_on_the_floor_hides_the_floor_behind_it() -> None:
    flight = Flight()
    flight.take(floor_only(), LOOKS)
    assert flight.reach_m(0.0) > 1.0


def test_a_low_thing_below_what_is_looked_past_counts() -> None:
    azimuth, down = view()
    # A bush, 1 m away, from 0.1 m below the camera downward.
    bush = (np.abs(azimuth) < np.radians(20.0)) & (down > math.atan(0.1 / 1.0))
    flight = Flight()
    flight.take(seen(np.where(bush, 1.0, FAR_M)), LOOKS)
    assert flight.reach_m(0.0) < 0.9


def test_another_local_frame_is_nothing_looked_through() -> None:
    flight = Flight()
    flight.take(seen(), LOOKS)
    flight.space.forget()
    assert flight.reach_m(0.0) < 0.25


def test_far_from_where_it_was_nothing_is_known() -> None:
    flight = Flight()
    flight.take(seen(), LOOKS)
    flight.north_m += 30.0
    assert flight.reach_m(0.0) < 0.25


@pytest.mark.parametrize(
    ("gap_deg", "at_m", "is_past"), [(6.0, 2.0, True), (14.0, 2.0, False), (14.0, 1.0, True)]
)
def test_a_gap_between_samples_that_could_hide_a_pillar_is_not_looked_past(
    gap_deg: float, at_m: float, is_past: bool
) -> None:
    azimuth, _ = view()
    samples = seen(told=np.abs(azimuth) >= np.radians(gap_deg / 2.0))
    past = looked_past(samples, np.array([at_m]), PARAMS.hidden_width_m, PARAMS.half_height_m)
    assert bool(past[0, 0]) is is_past


def test_nothing_told_is_nothing_looked_past() -> None:
    nothing = seen(told=np.zeros(len(view()[0]), np.bool_))
    assert not looked_past(nothing, np.array([0.5, 1.0]), 0.3, 0.3).any()

"""What was seen near is still there when it shows no longer; in a plain scene a way counts no further than it was looked through."""

from __future__ import annotations

import math

import numpy as np
import pytest

from detector.parallax.map_memory import MapMemory
from detector.parallax.samples import RangedSamples
from detector.parallax.sure_map import SureMap, looked_through_m
from detector.parallax.void_map import VoidMap, VoidMapParams, void_map
from tests.detector.parallax.test_coverage import FAR_M, azimuth_deg, looking

PARAMS = VoidMapParams()
HERE = (0.0, 0.0)


class Flight:
    """A vehicle that hovers and takes one pair after another."""

    def __init__(self, params: VoidMapParams = PARAMS) -> None:
        self.params = params
        self.memory = MapMemory()
        self.sure_map = SureMap(params)
        self.time_s = 0.0

    def take(self, samples: RangedSamples) -> tuple[VoidMap, VoidMap]:
        """The whole map and what may be flown, after another pair."""
        self.time_s += 0.2
        measured = void_map(samples, self.params)
        self.memory.add(measured, HERE, self.time_s)
        whole = self.memory.remembered(HERE, self.time_s).found
        return whole, self.sure_map.add(measured, samples, whole, HERE, self.time_s)


def with_a_hole(samples_far: bool = True) -> RangedSamples:
    """What is seen of a smooth pillar right ahead: nothing, with what is far on either side."""
    return looking(np.abs(azimuth_deg()) > 7.0, FAR_M if samples_far else 1.0)


def test_a_near_thing_that_shows_no_longer_is_still_there() -> None:
    flight = Flight()
    textured = np.where(np.abs(azimuth_deg()) <= 7.0, 1.4, FAR_M)
    flight.take(looking(None, textured))
    for _ in range(6):
        whole, surely = flight.take(with_a_hole())
    ahead = whole.at(0.0)
    assert whole.free_m[ahead] > 3.0, "the last pairs bridge the hole"
    assert surely.known[ahead]
    assert surely.free_m[ahead] == pytest.approx(1.4 - PARAMS.radius_m, abs=0.15)


def plain_room() -> RangedSamples:
    """What is seen of a room with plain walls: samples on either side of a wide plain place ahead, and nothing to the left."""
    return looking((np.abs(azimuth_deg() - 8.0) > 6.5) & (azimuth_deg() > -8.0) & (azimuth_deg() < 24.0))


def test_in_a_plain_scene_a_way_ends_where_something_could_stand_in_it() -> None:
    samples = plain_room()
    whole, surely = Flight(VoidMapParams(plain_share=0.6)).take(samples)
    looked_m, ahead = looked_through_m(samples, PARAMS), whole.at(math.radians(8.0))
    assert whole.free_m[ahead] > 3.0, "bridged"
    assert looked_m[ahead] < 1.5
    # The spread is taken off by who flies it, so it is not taken off here.
    assert surely.free_m[ahead] - surely.sigma_m[ahead] == pytest.approx(looked_m[ahead])
    bold, as_the_map_says = Flight(VoidMapParams(plain_share=0.0)).take(samples)
    np.testing.assert_array_equal(as_the_map_says.free_m, bold.free_m)


def test_where_most_is_known_a_gap_between_samples_ends_nothing() -> None:
    whole, surely = Flight().take(with_a_hole())
    ahead = whole.at(0.0)
    assert looked_through_m(with_a_hole(), PARAMS)[ahead] < 1.5
    assert surely.free_m[ahead] == whole.free_m[ahead] > 3.0


def test_a_near_thing_is_gone_when_its_place_is_looked_through() -> None:
    flight = Flight()
    flight.take(looking(None, np.where(np.abs(azimuth_deg()) <= 7.0, 1.4, FAR_M)))
    for _ in range(6):
        whole, surely = flight.take(looking())
    ahead = np.abs(np.degrees(whole.azimuth_rad)) < 15.0
    np.testing.assert_array_equal(surely.free_m[ahead], whole.free_m[ahead])


def test_one_wild_pair_makes_no_near_thing() -> None:
    flight = Flight()
    for _ in range(4):
        flight.take(looking())
    flight.take(looking(None, np.where(np.abs(azimuth_deg()) <= 7.0, 1.4, FAR_M)))
    whole, surely = flight.take(with_a_hole())
    assert surely.free_m[whole.at(0.0)] > 3.0


def test_what_is_looked_through_everywhere_is_flown_as_the_map_says() -> None:
    whole, surely = Flight().take(looking())
    level = np.abs(np.degrees(whole.azimuth_rad)) < 15.0
    np.testing.assert_array_equal(surely.free_m[level], whole.free_m[level])


def test_without_the_question_nothing_ends_earlier() -> None:
    bold = VoidMapParams(covered_m=0.0)
    whole, surely = Flight(bold).take(with_a_hole())
    np.testing.assert_array_equal(surely.free_m, whole.free_m)
    np.testing.assert_array_equal(surely.known, whole.known)


def test_forgetting_leaves_nothing_of_before() -> None:
    flight = Flight()
    flight.take(looking(None, np.where(np.abs(azimuth_deg()) <= 7.0, 1.4, FAR_M)))
    flight.sure_map.forget()
    _, surely = flight.take(with_a_hole())
    ahead = surely.at(0.0)
    assert surely.free_m[ahead] != pytest.approx(1.4 - PARAMS.radius_m, abs=0.15)

"""Latitude and longitude to local NED and back, against geometry in space."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.guidance.dialect import Autopilot
from companion.guidance.geodesy import Anchor, GlobalReference, to_global, to_local

PX4, ARDUPILOT = Autopilot.PX4, Autopilot.ARDUPILOT
RADIUS_M = 6_371_000.0

anchors = st.builds(
    Anchor,
    st.integers(-700_000_000, 700_000_000),
    st.integers(-1_800_000_000, 1_800_000_000),
    st.floats(-500, 500),
    st.floats(-500, 500),
)
metres = st.floats(-5000, 5000)


@given(anchors, metres, metres, st.sampled_from([PX4, ARDUPILOT]))
def test_there_and_back_is_the_same_place(anchor, north, east, autopilot):
    lat, lon = to_global(anchor, anchor.north_m + north, anchor.east_m + east, autopilot)
    assert abs(lon) <= 1_800_000_000
    back = to_local(anchor, lat, lon, autopilot)
    assert back == pytest.approx((anchor.north_m + north, anchor.east_m + east), abs=0.012)  # 1e-7 deg


def unit(lat_int: float, lon_int: float) -> np.ndarray:
    lat, lon = math.radians(lat_int * 1e-7), math.radians(lon_int * 1e-7)
    return np.array([math.cos(lat) * math.cos(lon), math.cos(lat) * math.sin(lon), math.sin(lat)])


@given(anchors, metres, metres)
def test_px4_distance_and_direction_are_those_on_its_sphere(anchor, north, east):
    """Azimuthal equidistant: the distance along the great circle, and the azimuth in which it begins."""
    lat, lon = to_global(anchor, anchor.north_m + north, anchor.east_m + east, PX4)
    here, there = unit(anchor.lat_int, anchor.lon_int), unit(lat, lon)
    distance = RADIUS_M * math.atan2(float(np.linalg.norm(np.cross(here, there))), float(here @ there))
    n, e = to_local(anchor, lat, lon, PX4)
    n, e = n - anchor.north_m, e - anchor.east_m
    assert math.hypot(n, e) == pytest.approx(distance, abs=1e-3)
    pole = np.array([0.0, 0.0, 1.0])
    east_axis = np.cross(pole, here)
    east_axis /= np.linalg.norm(east_axis)
    north_axis = np.cross(here, east_axis)
    if distance > 1.0:
        azimuth = math.atan2(float(there @ east_axis), float(there @ north_axis))
        assert math.remainder(math.atan2(e, n) - azimuth, math.tau) == pytest.approx(0.0, abs=1e-6)


@given(anchors, metres, metres)
def test_both_autopilots_agree_but_for_the_size_of_their_globe(anchor, north, east):
    lat, lon = to_global(anchor, anchor.north_m + north, anchor.east_m + east, PX4)
    n, e = to_local(anchor, lat, lon, ARDUPILOT)
    found = (n - anchor.north_m, e - anchor.east_m)
    curvature_m = (north * north + east * east) / RADIUS_M * 3  # tan(70 deg): what a plane neglects
    assert found == pytest.approx((north, east), abs=0.0012 * math.hypot(north, east) + curvature_m + 0.02)


def test_the_date_line_is_no_border_and_a_pole_is():
    fiji = Anchor(-180_000_000, 1_799_999_990, 0.0, 0.0)
    for autopilot in (PX4, ARDUPILOT):
        lat, lon = to_global(fiji, 0.0, 10.0, autopilot)
        assert lon < 0
        assert to_local(fiji, lat, lon, autopilot) == pytest.approx((0.0, 10.0), abs=0.012)
    with pytest.raises(ValueError, match="pole"):
        to_global(Anchor(899_999_990, 0, 0.0, 0.0), 1e6, 0.0, ARDUPILOT)
    with pytest.raises(ValueError, match="finite"):
        to_global(fiji, math.nan, 0.0, PX4)


def test_a_step_from_a_pair_far_from_the_origin_is_off_by_less_than_a_millimetre():
    origin = Anchor(473977420, 85455940, 0.0, 0.0)
    lat, lon = to_global(origin, 700.0, 700.0, PX4)
    pair = Anchor(lat, lon, *to_local(origin, lat, lon, PX4))
    goal = (pair.north_m + 1.06, pair.east_m - 1.06)
    by_pair = to_global(pair, *goal, PX4)
    assert to_local(origin, *by_pair, PX4) == pytest.approx(goal, abs=0.012)


def test_a_pair_is_two_positions_of_the_same_time_and_is_preferred():
    reference = GlobalReference()
    assert reference.anchor is None
    reference.on_origin(470000000, 80000000)
    assert reference.anchor == Anchor(470000000, 80000000, 0.0, 0.0)
    reference.on_global(1000, 470001000, 80001000)
    assert reference.anchor.north_m == 0.0, "no local position yet"
    reference.on_local(1000, 5.0, 6.0, 2.0, -1.0)
    reference.on_global(1050, 470001000, 80001000)
    assert reference.anchor == Anchor(470001000, 80001000, pytest.approx(5.1), pytest.approx(5.95))
    reference.on_global(1200, 470009000, 80009000)
    assert reference.anchor.lat_int == 470001000, "too far apart in time"
    reference.on_local(1300, 7.0, 7.0, 0.0, 0.0)
    reference.on_global(1300, 0, 0)
    assert reference.anchor.lat_int == 470001000, "zeros are no position"
    reference.forget()
    assert reference.anchor is None
    reference.on_global(1300, 470001000, 80001000)
    assert reference.anchor is None, "the local position of before is of another frame"

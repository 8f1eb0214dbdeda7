"""The rules by which an answer is right, one at a time."""

import math

import numpy as np
import pytest

from detector.camera_model import CameraModel
from detector.evaluation.dataset import Depth, FreeColumn, Motion, Pair, Plane, Truth
from detector.evaluation.judgement import (
    Scene,
    has_direction_truth,
    is_right_answer,
    is_single_plane,
    judge,
    judge_lines,
    profile_ratio,
)
from detector.evaluation.methods import Answer

CAMERA = CameraModel(400, 200, 300.0, 300.0, 200.0, 100.0)
PAIR = Pair(a="a", b="b")
SIZE = (400, 200)
YAW = math.radians(6.0)
TURN = np.array([[math.cos(YAW), 0, -math.sin(YAW)], [0, 1, 0], [math.sin(YAW), 0, math.cos(YAW)]])
"""later_from_earlier of a camera that turned to the right."""


def at(x, y=100.0, **more):
    return Answer("lowest_flow", (x, y), **more)


def verdict(answer, truth=None, **scene):
    return judge(answer, PAIR, Scene(truth or Truth(), SIZE, **scene), 0.5)


def profile(*depths_m, x=None):
    free = None if x is None else FreeColumn(x=x)
    return Truth(depth=Depth(column_profile_m=depths_m, free_column=free, valid_frac=0.8))


def test_within_a_tenth_of_the_width_of_the_vanishing_point_is_right():
    truth = Truth(vp=(200.0, 100.0))
    assert verdict(at(240.0), truth).right is True
    assert verdict(at(240.1), truth).right is False
    assert verdict(at(224.0, 132.0), truth).right is True
    assert verdict(at(224.0, 133.0), truth).right is False
    assert verdict(at(224.0, 132.0), truth).error_width == pytest.approx(0.1)


def test_inside_either_box_is_right():
    truth = Truth(far_box=(10, 20, 50, 60), doorway_box=(300, 0, 320, 200))
    assert [verdict(at(x, 40.0), truth).in_box for x in (9.9, 10.0, 50.0, 51.0, 310.0)] == [
        False, True, True, False, True,
    ]  # fmt: skip
    assert verdict(at(310.0, 40.0), truth).right is True
    assert verdict(at(100.0, 40.0), truth).right is False
    assert verdict(at(100.0, 40.0), truth).error_width == pytest.approx(70 / 400)


def test_beside_what_is_right_by_up_to_three_degrees_is_nearly_right():
    truth = Truth(far_box=(195, 90, 205, 110))
    beside_px = 205.0 + 300.0 * math.tan(math.radians(2.8))
    beyond_px = 205.0 + 300.0 * math.tan(math.radians(3.3))
    known = [verdict(at(x), truth, camera=CAMERA) for x in (200.0, beside_px, beyond_px)]
    assert [(v.right, v.nearly_right) for v in known] == [(True, True), (False, True), (False, False)]
    assert verdict(at(beside_px), truth).nearly_right is False  # without a camera a degree is nothing known
    assert verdict(at(200.0)).nearly_right is None


def test_a_way_that_ends_near_the_wall_limit_is_neither_wall_nor_free():
    ends_m = (None, 2.6, 2.8, 3.2, 3.4)
    found = [verdict(at(200.0), Truth(best_free_distance_m=end_m)).wall_ahead for end_m in ends_m]
    assert found == [None, True, None, None, False]
    near = [verdict(at(200.0), Truth(best_free_distance_m=end_m)).near_wall_limit for end_m in ends_m]
    assert near == [False, False, True, True, False]


def test_a_column_at_nine_tenths_of_the_deepest_is_right():
    truth = profile(10.0, 9.0, 8.9, None, x=50.0)
    found = [verdict(at(x), truth) for x in (50.0, 150.0, 250.0, 350.0)]
    assert [v.right for v in found] == [True, True, False, False]
    assert [v.profile_ratio for v in found] == [1.0, pytest.approx(0.9), pytest.approx(0.89), None]
    assert found[1].error_width == pytest.approx(0.25)
    assert all(v.has_direction_truth for v in found)


def test_columns_reach_from_half_a_pixel_before_the_first_centre():
    truth = profile(1.0, 2.0, 3.0, 4.0)
    edges = (-0.5, 99.4, 99.6, 399.4)
    assert [profile_ratio(truth, x, 400) for x in edges] == [0.25, 0.25, 0.5, 1.0]
    assert profile_ratio(truth, -0.6, 400) is None
    assert profile_ratio(truth, 399.6, 400) is None


def test_any_rule_that_holds_is_enough_and_none_without_truth():
    truth = Truth(
        vp=(390.0, 100.0), far_box=(0, 0, 10, 10), depth=Depth(column_profile_m=(1.0, 9.0, 1.0, 1.0))
    )
    assert [verdict(at(x, 5.0), truth).right for x in (5.0, 150.0, 250.0)] == [True, True, False]
    assert verdict(at(390.0), truth).right is True
    assert verdict(at(5.0)).right is None
    assert not has_direction_truth(Truth())
    assert not has_direction_truth(profile(None, None))


def test_chance_is_the_share_of_columns_that_would_be_right():
    assert verdict(Answer("none"), profile(1.0, 4.0, 3.9, None)).chance == pytest.approx(0.5)
    assert verdict(at(5.0), Truth(vp=(200.0, 10.0))).chance == pytest.approx(0.2, abs=0.01)
    assert verdict(at(5.0), Truth(vp=(0.0, 10.0))).chance == pytest.approx(0.1, abs=0.01)
    assert verdict(at(5.0), Truth(far_box=(100, 180, 200, 190))).chance == pytest.approx(0.25, abs=0.01)
    assert verdict(at(5.0), Truth(single_plane=True)).chance is None


def test_other_answers_are_no_directions():
    for kind in ("single_plane", "none"):
        found = verdict(Answer(kind), profile(1.0, 2.0))
        assert (found.right, found.in_box, found.error_width) == (None, None, None)
        assert found.has_direction_truth
        assert not found.is_direction


def test_errors_in_degrees_are_angles_between_the_rays():
    vp = verdict(at(350.0, 100.0), Truth(vp=(200.0, 100.0)), camera=CAMERA)
    assert vp.error_deg == pytest.approx(math.degrees(math.atan(0.5)))
    # Without a row of its own a column counts across the image alone.
    column = verdict(at(350.0, 10.0), profile(1.0, 1.0, x=50.0), camera=CAMERA)
    assert column.error_deg == pytest.approx(2 * math.degrees(math.atan(0.5)))
    assert column.error_width == pytest.approx(0.75)
    assert verdict(at(350.0, 100.0), Truth(vp=(200.0, 100.0))).error_deg is None


def test_a_direction_in_an_image_turned_back_is_judged_where_it_was_taken():
    motion = Motion(TURN, np.array([0.0, 0.0, 0.2]))
    ahead_of_a = 200.0 - 300.0 * math.tan(YAW)
    found = verdict(at(200.0), Truth(vp=(ahead_of_a, 100.0)), camera=CAMERA, motion=motion, turned_back=True)
    assert found.x_px == pytest.approx(ahead_of_a)
    assert found.error_width == pytest.approx(0.0, abs=1e-9)
    assert verdict(at(200.0), Truth(), camera=CAMERA, motion=motion).x_px == 200.0


@pytest.mark.parametrize(
    ("truth", "expected"),
    [
        (Truth(), None),
        (Truth(single_plane=True), True),
        (Truth(single_plane=False), False),
        (Truth(wall_close=True), True),
        (Truth(wall_close="door"), True),
        (Truth(wall_ahead=False), False),
        (Truth(wall_ahead=True, single_plane=False), True),
        (Truth(depth=Depth(plane_like=True)), True),
        (Truth(depth=Depth(plane_like=False)), False),
        (Truth(best_free_distance_m=2.9), True),
        (Truth(best_free_distance_m=3.0), False),
        (Truth(best_free_distance_m=2.9, wall_ahead=False), False),
    ],
)
def test_a_scene_is_one_plane_where_any_mark_says_so(truth, expected):
    assert is_single_plane(truth) is expected


def test_the_focus_is_turned_into_the_earlier_frame():
    motion = Motion(TURN, np.array([0.0, 0.0, 0.2]))
    seen_in_b = (200.0 - 300.0 * math.tan(YAW), 100.0)
    scene = {"camera": CAMERA, "motion": motion, "focus_px": (200.0, 100.0)}
    assert verdict(Answer("none", focus_px=seen_in_b), **scene).foe_px == pytest.approx(0.0, abs=1e-9)
    back = verdict(Answer("none", focus_px=(203.0, 104.0)), **scene, turned_back=True)
    assert back.foe_px == pytest.approx(5.0)
    plain = verdict(Answer("none", focus_px=(203.0, 104.0)), focus_px=(200.0, 100.0))
    assert plain.foe_px == pytest.approx(5.0)
    assert verdict(Answer("none"), **scene).foe_px is None


def test_time_to_contact_in_steps_of_the_pair():
    found = verdict(Answer("single_plane", contact_frames=44.0), earlier_contact_s=10.0, later_contact_s=9.75)
    assert (found.contact_truth_frames, found.contact_source) == (39.0, "time_to_contact_s")
    assert found.contact_error == pytest.approx(5 / 39)
    away = verdict(Answer("single_plane", contact_frames=4.0), earlier_contact_s=9.0, later_contact_s=9.5)
    assert away.contact_error is None


def test_time_to_contact_from_depth_needs_forward_motion():
    forward = Motion(np.eye(3), np.array([0.1, 0.0, 0.2]))
    deep = profile(2.0, 4.0, 1.0, None)
    found = verdict(at(150.0, contact_frames=25.0), deep, motion=forward)
    assert (found.contact_truth_frames, found.contact_source) == (pytest.approx(20.0), "column_profile_m")
    assert found.contact_error == pytest.approx(0.25)
    assert verdict(at(350.0, contact_frames=25.0), deep, motion=forward).contact_error is None
    sideways = Motion(np.eye(3), np.array([0.2, 0.0, 0.0]))
    assert verdict(at(150.0, contact_frames=25.0), deep, motion=sideways).contact_truth_frames is None


def test_time_to_contact_of_a_plane_is_along_the_axis():
    forward = Motion(np.eye(3), np.array([0.0, 0.0, 0.25]))
    plane = Plane(dist_m=1.0, normal_vs_axis_deg=45.0)
    wall = Truth(depth=Depth(plane=plane, plane_like=True))
    found = verdict(Answer("single_plane", contact_frames=4.0), wall, motion=forward)
    assert (found.contact_truth_frames, found.contact_source) == (pytest.approx(4 * math.sqrt(2)), "plane")
    part = Truth(depth=Depth(plane=plane, plane_like=False))
    assert verdict(Answer("single_plane", contact_frames=4.0), part, motion=forward).contact_error is None


def test_lines_that_find_nothing_are_not_right():
    assert judge_lines("f", None, (10.0, 10.0), 400, 0.1).within_tenth_width is False
    near = judge_lines("f", (50.0, 10.0), (10.0, 10.0), 400, 0.1)
    assert (near.within_tenth_width, near.error_width) == (True, pytest.approx(0.1))
    assert judge_lines("f", (51.0, 10.0), (10.0, 10.0), 400, 0.1).within_tenth_width is False


def test_where_it_is_known_how_far_the_vehicle_can_fly_that_counts_and_not_the_depth():
    # The deepest column is a slit that the vehicle does not fit through.
    truth = Truth(depth=Depth(column_profile_m=(2.0, 9.0, 3.0)), free_distance_profile_m=(2.0, 1.5, 3.0))
    assert profile_ratio(truth, 15.0, 30) == pytest.approx(0.5)
    assert profile_ratio(truth, 25.0, 30) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("truth", "direction", "plane", "silence"),
    [
        (Truth(), None, None, None),
        (Truth(vp=(200.0, 100.0)), True, None, None),
        (Truth(vp=(20.0, 100.0)), False, None, None),
        (Truth(single_plane=True), False, True, None),
        (Truth(vp=(200.0, 100.0), single_plane=False), True, False, None),
        (Truth(vp=(200.0, 100.0), single_plane=True), True, True, None),  # the truth has room for both
        (Truth(vp=(200.0, 100.0), best_free_distance_m=2.9), True, None, None),  # neither wall nor free
        (Truth(no_motion=True), False, False, True),
    ],
)
def test_an_answer_of_any_kind_is_right_wrong_or_not_known(truth, direction, plane, silence):
    answers = at(200.0), Answer("single_plane"), Answer("none", reason="no_motion")
    found = [is_right_answer(verdict(answer, truth)) for answer in answers]
    assert found == [direction, plane, silence]

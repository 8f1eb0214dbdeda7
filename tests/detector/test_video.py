"""A clip's answers are the observer's, or those of a fixed step; names sort as people count; pictures fit a video."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from detector.camera_model import CameraModel
from detector.evaluation.methods import METHODS, Answer, PairInput
from detector.flow import Tracks
from detector.observer import CameraPose, Observation, VoidObserver
from detector.params import DetectorParams
from detector.pipeline import VoidDetector
from detector.results import Diagnostics, NoDetection, NoDetectionReason, SinglePlane
from detector.rival_video import by_rival
from detector.video import (
    PANELS_A_ROW,
    Answered,
    annotated,
    by_fixed_step,
    by_observer,
    fitted,
    natural_key,
    side_by_side,
)

OFFICE = Path(__file__).parents[1] / "data" / "pairs" / "office"
PARAMS = DetectorParams.preset("default")
KNOWN = json.loads((OFFICE / "poses.json").read_text())
CAMERA = CameraModel(540, 360, KNOWN["K"][0][0], KNOWN["K"][1][1], KNOWN["K"][0][2], KNOWN["K"][1][2])


def image(name):
    return cv2.imread(str(OFFICE / name), cv2.IMREAD_GRAYSCALE)


def pose(name):
    matrix = np.array(KNOWN["poses"][name])
    return CameraPose(matrix[:3, :3], matrix[:3, 3])


def frames(*names):
    return [(image(name), index * 100_000_000, pose(name)) for index, name in enumerate(names)]


def same_answer(one, other):
    assert type(one) is type(other)
    for field in ("x_px", "y_px", "kind", "reason", "time_to_contact"):
        assert getattr(one, field, None) == getattr(other, field, None)


@pytest.mark.parametrize("with_poses", [True, False])
def test_the_answers_are_the_observers_and_come_with_their_tracks(with_poses):
    answer, observer = by_observer(PARAMS, CAMERA), VoidObserver(PARAMS, CAMERA)
    for picture, time_ns, known in frames("00184.jpg", "00185.jpg"):
        given_pose = known if with_poses else None
        answered = answer(picture, time_ns, given_pose)
        expected = observer.observe(picture, time_ns, given_pose)
        same_answer(answered.detection, expected.detection)
        assert answered.earlier_time_ns == expected.earlier_time_ns
        assert answered.baseline_m == expected.baseline_m
        assert len(answered.tracks) == answered.detection.diagnostics.n_after_distribution
    assert len(answered.tracks) > 100


def test_tracks_of_an_earlier_pair_are_not_shown_for_a_frame_without_one():
    answer = by_observer(PARAMS, CAMERA)
    for each in frames("00184.jpg", "00185.jpg"):
        answered = answer(*each)
    assert len(answered.tracks)
    answered = answer(np.zeros((360, 540), np.uint8), 300_000_000, None)
    assert answered.detection.reason is NoDetectionReason.BLACK
    assert len(answered.tracks) == 0


def test_a_fixed_step_pairs_with_the_frame_so_many_before():
    answer = by_fixed_step(PARAMS, CAMERA, 2)
    clip = frames("00184.jpg", "00193.jpg", "00185.jpg", "00194.jpg")
    answers = [answer(*each) for each in clip]
    for early in answers[:2]:
        assert early.detection.reason is NoDetectionReason.NO_EARLIER_FRAME
    for index, (a, b) in ((2, (clip[0], clip[2])), (3, (clip[1], clip[3]))):
        answered = answers[index]
        assert (answered.time_ns, answered.earlier_time_ns) == (b[1], a[1])
        assert answered.baseline_m == pytest.approx(np.linalg.norm(b[2].position_m - a[2].position_m))
    first = VoidDetector(PARAMS).detect(
        clip[0][0],
        clip[2][0],
        camera=CAMERA,
        later_from_earlier=clip[2][2].world_from_camera.T @ clip[0][2].world_from_camera,
        translation_earlier=clip[0][2].world_from_camera.T @ (clip[2][2].position_m - clip[0][2].position_m),
    )
    same_answer(answers[2].detection, first.detection)
    np.testing.assert_array_equal(answers[2].tracks.end_px, first.tracks.end_px)


def test_the_callers_image_may_change_after_the_call():
    def play(spoil):
        answer = by_fixed_step(PARAMS, None, 1)
        for picture, time_ns, _ in frames("00184.jpg", "00185.jpg"):
            answered = answer(picture, time_ns, None)
            if spoil:
                picture[:] = 0
        return answered

    same_answer(play(spoil=True).detection, play(spoil=False).detection)


def test_a_step_below_one_is_refused():
    with pytest.raises(ValueError, match="step"):
        by_fixed_step(PARAMS, None, 0)


@given(st.lists(st.integers(0, 10**6), min_size=1, max_size=8))
def test_numbers_in_names_sort_by_their_value(numbers):
    names = [f"frame{number}.png" for number in numbers]
    assert sorted(names, key=natural_key) == [f"frame{number}.png" for number in sorted(numbers)]


def test_names_of_any_shape_can_be_sorted_together():
    names = ["b2.png", "10.png", "9.png", "B1.png", "a.png", "\u00b23.png", ""]
    assert sorted(names, key=natural_key)[:5] == ["", "9.png", "10.png", "a.png", "B1.png"]


@pytest.mark.parametrize("size", [(48, 65), (361, 541), (360, 540)])
def test_a_picture_has_even_sides_and_says_which_frame_it_is(size):
    grey = np.full(size, 120, np.uint8)
    nothing = NoDetection(NoDetectionReason.NO_MOTION, "", Diagnostics())
    answered = Answered.of(Observation(nothing, 0), Tracks(np.zeros((0, 2)), np.zeros((0, 2))))
    picture = annotated(grey, answered, 3, 0.3)
    assert picture.shape[0] % 2 == picture.shape[1] % 2 == 0
    assert picture.shape[1] >= 400
    assert (annotated(grey, answered, 4, 0.3) != picture).any()
    wall = Answered.of(Observation(SinglePlane(None, Diagnostics()), 0), answered.tracks)
    assert (annotated(grey, wall, 3, 0.3) != picture).any()


def test_a_picture_of_another_size_is_fitted_whole_and_in_proportion():
    picture = np.full((100, 100, 3), 255, np.uint8)
    assert fitted(picture, (100, 100)) is picture
    wide = fitted(picture, (300, 50))
    assert wide.shape == (50, 300, 3)
    columns = np.nonzero(wide.any(axis=(0, 2)))[0]
    assert (columns.min(), columns.max()) == (125, 174)
    assert fitted(np.full((1, 500, 3), 255, np.uint8), (10, 10)).any()


@pytest.mark.parametrize("name", ["straight", "flow_balance", "line_vp"])
def test_a_rival_answers_the_pairs_that_the_detector_would(name):
    answer = by_rival(METHODS[name](PARAMS), PARAMS, CAMERA)
    first, second = frames("00184.jpg", "00185.jpg")
    nothing, found = answer(*first), answer(*second)
    assert nothing.detection.reason is NoDetectionReason.NO_EARLIER_FRAME
    assert (nothing.answer.kind, nothing.answer.reason) == ("none", "no_earlier_frame")
    (before, _, at_a), (now, _, at_b) = first, second
    pair = PairInput(
        before,
        now,
        CAMERA,
        at_b.world_from_camera.T @ at_a.world_from_camera,
        at_a.world_from_camera.T @ (at_b.position_m - at_a.position_m),
        at_b.world_from_camera,
    )
    assert found.answer == METHODS[name](PARAMS).answer(pair)
    assert (found.detection, found.earlier_time_ns) == (None, 0)
    assert found.baseline_m == pytest.approx(np.linalg.norm(at_b.position_m - at_a.position_m))


def test_a_rivals_picture_has_its_mark_or_its_reason():
    grey = np.full((240, 480), 120, np.uint8)

    def shown(answer):
        return annotated(grey, Answered(answer, None, 0, None, None, Tracks.none()), 0, 0.0)

    left, right, silent = (
        shown(Answer("flow_balance", (100.0, 150.0))),
        shown(Answer("flow_balance", (380.0, 150.0))),
        shown(Answer("none", reason="no_vanishing_point")),
    )
    plain = int(0.6 * 120)
    for picture, columns in ((left, slice(80, 120)), (right, slice(360, 400))):
        marked = np.argwhere((picture[70:] != plain).any(axis=2))
        assert 80 <= marked.mean(axis=0)[0] + 10 <= 160
        assert columns.start <= marked.mean(axis=0)[1] < columns.stop
    assert (silent[70:] == plain).all(), "no mark"
    assert (silent[:40] != left[:40]).any(), "other words"


def test_panels_stand_side_by_side_each_with_its_name():
    grey = np.full((240, 480), 120, np.uint8)
    answered = {
        name: Answered(Answer(name, (100.0, 150.0)), None, 0, None, None, Tracks.none())
        for name in ("straight", "flow_balance", "line_vp", "fourth")
    }
    alone = annotated(grey, answered["straight"], 1, 0.1)
    assert np.array_equal(side_by_side(grey, {"straight": answered["straight"]}, 1, 0.1), alone)
    height, width = alone.shape[:2]
    for count in (2, 3, 4):
        picture = side_by_side(grey, dict(list(answered.items())[:count]), 1, 0.1)
        assert np.array_equal(picture[:height, :width], alone)
        rows, columns = -(-count // PANELS_A_ROW), min(count, PANELS_A_ROW)
        assert picture.shape[0] // height == rows
        assert columns * width <= picture.shape[1] < (columns + 1) * width
        assert picture.shape[0] % 2 == picture.shape[1] % 2 == 0
        label = picture[height : height + 24, :width]
        assert label.max() == 255
        assert label.min() < 100, "its name below it"

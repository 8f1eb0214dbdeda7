"""The methods that can be judged side by side."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from detector.camera_model import CameraModel
from detector.evaluation.dataset import load_truth
from detector.evaluation.methods import (
    METHODS,
    PairInput,
    PaperMethod,
    answer_of,
    line_vanishing_point,
    with_focus,
)
from detector.params import DetectorParams
from detector.pipeline import VoidDetector
from detector.results import Diagnostics, Direction, DirectionKind, NoDetection, NoDetectionReason
from tests.reference.pairs import approach, window

PAIRS = Path(__file__).parents[2] / "data" / "pairs"
PARAMS = DetectorParams.preset("paper")


def fan(vp=(355.0, 245.0), width=640, height=480):
    """Floor lines that meet at a point, by twos about ten degrees apart."""
    image = np.full((height, width), 90, np.uint8)
    for angle_deg in (48.0, 57.0, 66.0, 114.0, 123.0, 132.0):
        along = np.array([np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))])
        start, end = np.array(vp) + 30 * along, np.array(vp) + 400 * along
        cv2.line(
            image, start.round().astype(int).tolist(), end.round().astype(int).tolist(), 200, 3, cv2.LINE_AA
        )
    return image  # fmt: skip


def test_straight_ahead_is_the_middle_whatever_is_seen():
    method = METHODS["straight"](PARAMS)
    answer = method.answer(PairInput(*approach()))
    assert (answer.kind, answer.point_px) == ("straight_ahead", (319.5, 239.5))


def test_the_lines_alone_find_where_they_meet():
    found = line_vanishing_point(fan(), PARAMS)
    assert found is not None
    assert np.hypot(found[0] - 355.0, found[1] - 245.0) < 12.0  # a cell is 10 px wide
    answer = METHODS["line_vp"](PARAMS).answer(PairInput(fan(), fan()))
    assert (answer.kind, answer.point_px) == ("line_vp", found)


def test_the_lines_alone_say_nothing_of_an_empty_image():
    blank = np.full((480, 640), 90, np.uint8)
    assert line_vanishing_point(blank, PARAMS) is None
    answer = METHODS["line_vp"](PARAMS).answer(PairInput(blank, blank))
    assert (answer.kind, answer.point_px, answer.reason) == ("none", None, "no_vanishing_point")


def test_papers_answers_are_the_detectors():
    earlier, later = window()
    found = METHODS["paper"](PARAMS).answer(PairInput(earlier, later))
    direct = VoidDetector(PARAMS).detect(earlier, later)
    assert isinstance(direct.detection, Direction)
    assert found.kind == direct.detection.kind.value
    assert found.point_px == (direct.detection.x_px, direct.detection.y_px)
    assert found.focus_px == direct.focus_px is not None
    contact = direct.detection.time_to_contact
    assert found.contact_frames == (None if contact is None else contact.frames)


def test_a_focus_that_was_given_is_not_an_estimate():
    office = load_truth(PAIRS / "office" / "groundtruth.json")
    pair = office.pairs[1]
    motion = office.motion_of(pair)
    assert motion is not None
    images = [cv2.imread(str(office.folder / name), cv2.IMREAD_GRAYSCALE) for name in (pair.a, pair.b)]
    told = PairInput(*images, office.camera, motion.later_from_earlier, motion.translation_earlier_m)
    with_translation = PaperMethod(PARAMS).answer(told)
    assert with_translation.focus_px is None
    turned = PairInput(*images, office.camera, motion.later_from_earlier)
    estimated = PaperMethod(PARAMS).answer(turned).focus_px
    assert estimated is not None
    assert with_focus(with_translation, office.camera).focus_px == estimated


def test_silence_keeps_its_reason():
    silence = NoDetection(NoDetectionReason.NO_MOTION, "stands", Diagnostics())
    assert (answer_of(silence).kind, answer_of(silence).reason) == ("none", "no_motion")
    direction = Direction(1.0, 2.0, DirectionKind.VANISHING_POINT, None, Diagnostics())
    assert answer_of(direction).kind == "vanishing_point"


@pytest.mark.parametrize("name", list(METHODS))
def test_every_method_answers_resets_and_has_lines(name):
    method = METHODS[name](DetectorParams.preset("default"))
    camera = CameraModel.from_hfov(640, 480, 80.0)
    before = method.answer(PairInput(*approach(), camera=camera))
    method.reset()
    assert method.answer(PairInput(*approach(), camera=camera)) == before
    assert method.vanishing_point(np.full((480, 640), 90, np.uint8)) is None


@pytest.mark.parametrize("nearer", ["left", "right"])
def test_flow_balance_turns_away_from_the_side_that_moves_more(nearer):
    rng = np.random.default_rng(3)
    texture = cv2.GaussianBlur(rng.integers(0, 255, (240, 400), np.uint8), (0, 0), 1.5)
    texture = cv2.normalize(texture, None, 20, 235, cv2.NORM_MINMAX)
    earlier = np.hstack([texture[:, 40:200], texture[:, 200:360]])
    later = np.hstack([texture[:, 46:206], texture[:, 201:361]])  # 6 px on the left, 1 px on the right
    if nearer == "right":
        earlier, later = (np.ascontiguousarray(image[:, ::-1]) for image in (earlier, later))
    answer = METHODS["flow_balance"](PARAMS).answer(PairInput(earlier, later))
    assert answer.kind == "flow_balance"
    assert (answer.point_px[0] > 200) is (nearer == "left")
    assert (answer.point_px[0] < 120) is (nearer == "right")


def test_flow_balance_has_no_answer_without_motion():
    earlier, _ = approach()
    answer = METHODS["flow_balance"](PARAMS).answer(PairInput(earlier, earlier))
    assert (answer.kind, answer.reason) == ("none", "no_motion")


def test_parallax_takes_what_it_is_told_and_says_where_the_focus_is():
    images = load_truth(PAIRS / "office" / "groundtruth.json")
    pair = images.pairs[0]
    motion = images.motion_of(pair)
    earlier, later = (
        cv2.imread(str(images.folder / name), cv2.IMREAD_GRAYSCALE) for name in (pair.a, pair.b)
    )
    method = METHODS["parallax"](DetectorParams.preset("default"))
    told = method.answer(
        PairInput(
            earlier,
            later,
            images.camera,
            motion.later_from_earlier,
            motion.translation_earlier_m,
            images.level_from_later(pair),
        )
    )
    alone = method.answer(PairInput(earlier, later, images.camera))
    assert told.focus_px is not None  # estimated: what is told is a prior
    assert alone.focus_px is not None
    assert told.focus_px != alone.focus_px


def test_the_lines_of_parallax_are_whole_image_segments():
    found = METHODS["parallax"](PARAMS).vanishing_point(fan())
    assert found is not None
    assert np.hypot(found[0] - 355.0, found[1] - 245.0) < 6.0
    assert METHODS["parallax"](PARAMS).vanishing_point(np.full((480, 640), 90, np.uint8)) is None


@pytest.mark.parametrize("size", [(1, 1), (8, 8), (20, 20), (64, 64)])
@pytest.mark.parametrize("name", ["paper", "parallax", "flow_balance", "line_vp"])
def test_frames_of_any_size_have_an_answer(name, size):
    noise = np.random.default_rng(0).integers(0, 255, size, dtype=np.uint8)
    answer = METHODS[name](PARAMS).answer(PairInput(noise, noise))
    assert (answer.point_px is None) == (answer.reason is not None)
    if min(size) < 64:  # in more noise than that lines may meet by chance
        assert answer.point_px is None


@pytest.mark.parametrize("wrong", ["earlier", "camera"])
def test_flow_balance_says_when_frames_or_camera_are_of_another_size(wrong):
    earlier, later = approach()
    given = {"earlier": earlier, "later": later, "camera": None}
    given |= {
        "earlier": {"earlier": earlier[:-8]},
        "camera": {"camera": CameraModel.from_hfov(320, 200, 70.0)},
    }[wrong]
    answer = METHODS["flow_balance"](PARAMS).answer(PairInput(**given))
    assert (answer.kind, answer.reason) == ("none", "wrong_size")

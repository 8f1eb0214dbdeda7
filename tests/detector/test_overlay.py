"""The picture of an answer: what was found stands where it was found, and the words fit."""

import numpy as np
import pytest

from detector.flow import Tracks
from detector.overlay import CandidateRole, candidate_roles, draw, headline, legible_zoom
from detector.pipeline import PairResult
from detector.results import (
    Diagnostics,
    Direction,
    DirectionKind,
    NoDetection,
    NoDetectionReason,
    SinglePlane,
    TimeToContact,
)

NO_TRACKS = Tracks(np.zeros((0, 2)), np.zeros((0, 2)))
GREY = np.full((240, 320), 120, np.uint8)


def result(detection, tracks=NO_TRACKS):
    return PairResult(detection, tracks, None)


def direction(x=200.0, y=150.0, kind=DirectionKind.LOWEST_FLOW, **diagnostics):
    return Direction(x, y, kind, TimeToContact(12.0, 1.5, 30), Diagnostics(**diagnostics))


def test_the_picture_has_the_frames_size_times_the_zoom_and_leaves_the_frame_alone():
    before = GREY.copy()
    assert draw(GREY, result(direction())).shape == (240, 320, 3)
    assert draw(GREY, result(direction()), zoom=2).shape == (480, 640, 3)
    np.testing.assert_array_equal(GREY, before)


def test_the_direction_is_marked_where_it_is_also_at_another_zoom():
    for zoom in (1, 3):
        picture = draw(GREY, result(direction(200.0, 150.0)), zoom=zoom)
        assert tuple(picture[150 * zoom + zoom // 2, 200 * zoom + zoom // 2]) == (255, 255, 255)


@pytest.mark.parametrize(("y", "text_rows"), [(150.0, slice(0, 20)), (10.0, slice(220, 240))])
def test_the_words_stand_where_the_direction_is_not(y, text_rows):
    picture = draw(GREY, result(direction(160.0, y)))
    assert (picture[text_rows] > 200).any()
    assert tuple(picture[round(y), 160]) == (255, 255, 255)


def test_lmcc_centres_candidates_and_lines_are_drawn_in_their_colours():
    found = direction(
        kind=DirectionKind.VANISHING_POINT,
        centre_points_px=((60.0, 200.0),),
        lmcc_px=(120.0, 120.0),
        candidates_px=((110.0, 160.0), (300.0, 220.0)),
        lines_px=((20.0, 100.0, 20.0, 140.0),),
    )
    picture = draw(GREY, result(found))
    assert tuple(picture[200, 60]) == (60, 220, 60)  # a centre, green
    assert tuple(picture[120, 120]) == (0, 235, 255)  # LMCC, yellow
    assert tuple(picture[160, 102]) == (255, 255, 255)  # the elected candidate, white
    assert tuple(picture[220, 300 - 10]) == (255, 130, 30)  # another one, blue, a diamond
    assert tuple(picture[120, 20]) == (255, 225, 80)  # a line, light blue
    rejected = Direction(200, 150, DirectionKind.LOWEST_FLOW, None, found.diagnostics)
    crossed_out = draw(GREY, result(rejected))
    assert tuple(crossed_out[160, 102]) == (60, 60, 255)  # examined, not elected: red
    assert tuple(crossed_out[160, 110]) == (60, 60, 255)  # and crossed out, for who does not see red
    assert tuple(picture[160, 110]) != (60, 60, 255)


def test_long_flow_has_another_colour_than_short_flow():
    start = np.array([[50.0, 100.0], [50.0, 140.0]])
    tracks = Tracks(start, start + np.array([[30.0, 0.0], [4.0, 0.0]]))
    picture = draw(GREY, result(SinglePlane(None, Diagnostics()), tracks))
    long, short = picture[100, 60].astype(int), picture[140, 52].astype(int)
    assert long[2] > long[0]  # towards yellow
    assert short[0] > short[2]  # towards blue
    assert long.sum() > short.sum()  # and brighter, which needs no colour to be seen


def test_notes_stand_below_the_answer_and_a_single_plane_has_a_border():
    wall = result(SinglePlane(None, Diagnostics()))
    plain, noted = draw(GREY, wall), draw(GREY, wall, notes=("frame 12",))
    assert not (plain[24:44, 8:-8] > 200).any()
    assert (noted[24:44, 8:-8] > 200).any()
    assert tuple(plain[120, 0]) == (40, 160, 255)
    assert tuple(draw(GREY, result(direction()))[120, 0]) == (72, 72, 72)


@pytest.mark.parametrize(("width_px", "zoom"), [(1, 8), (64, 8), (160, 3), (256, 2), (540, 1), (1280, 1)])
def test_small_frames_are_enlarged_until_words_can_be_read(width_px, zoom):
    assert legible_zoom(width_px) == zoom


def test_each_candidate_has_its_role_and_the_one_examined_comes_last():
    found = direction(
        kind=DirectionKind.VANISHING_POINT,
        lmcc_px=(100.0, 100.0),
        candidates_px=((110.0, 100.0), (300.0, 20.0)),
    )
    assert candidate_roles(found) == [
        ((300.0, 20.0), CandidateRole.VALID),
        ((110.0, 100.0), CandidateRole.ELECTED),
    ]
    rejected = Direction(100, 100, DirectionKind.LOWEST_FLOW, None, found.diagnostics)
    assert [role for _, role in candidate_roles(rejected)] == [CandidateRole.VALID, CandidateRole.REJECTED]
    assert candidate_roles(direction()) == []


def test_a_point_far_outside_and_a_tiny_frame_are_no_error():
    draw(GREY, result(direction(1e9, -1e9, lmcc_px=(1e12, 5.0))))
    assert draw(np.zeros((1, 1), np.uint8), result(direction(0.0, 0.0))).shape == (1, 1, 3)


def test_headlines_say_what_it_is():
    assert headline(direction()).startswith("lowest flow at (200, 150)")
    assert "contact in 12.0 +- 1.5 frames" in headline(direction())
    assert headline(SinglePlane(None, Diagnostics())) == "SINGLE PLANE, time to contact unknown"
    nothing = NoDetection(NoDetectionReason.NO_MOTION, "", Diagnostics())
    assert headline(nothing) == "no detection: no_motion"


@pytest.mark.parametrize("image", [np.zeros((4, 4)), np.zeros((4, 4, 2), np.uint8), np.zeros(4, np.uint8)])
def test_what_is_no_image_is_refused(image):
    with pytest.raises(ValueError, match="expected"):
        draw(image, result(direction()))
    with pytest.raises(ValueError, match="zoom"):
        draw(GREY, result(direction()), zoom=0)

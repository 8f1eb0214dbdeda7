"""The worst answers first, each with its truth."""

from pathlib import Path

import numpy as np

from detector.evaluation.contact_sheet import contact_sheet, worst_frames, worst_pairs
from detector.evaluation.dataset import Depth, Frame, ImageSet, Pair
from detector.evaluation.judgement import Scene, judge, judge_lines
from detector.evaluation.methods import Answer
from detector.evaluation.run import Evaluation, Settings
from detector.params import DetectorParams

OPEN = Frame(depth=Depth(column_profile_m=(1.0, 4.0, None, 2.0), plane_like=False))
WALL = Frame(depth=Depth(column_profile_m=(4.0, 4.0), plane_like=True))
STILL = Frame(no_motion=True)
SETTINGS = Settings("paper", "default", DetectorParams.preset("default"))


def verdict(name, frame, kind, x=None):
    answer = Answer(kind, None if x is None else (x, 50.0))
    return judge(answer, Pair(a="a", b=name), Scene(frame, (200, 100)), 0.1)


def evaluation(verdicts, frames, lines=()):
    images = ImageSet("made", Path("made"), (200, 100), None, frames)
    return Evaluation(images, SETTINGS, tuple(verdicts), tuple(lines))


def read(path):
    return np.full((100, 200), 128, np.uint8)


def test_the_most_dangerous_come_first_and_what_is_right_or_silent_not_at_all():
    verdicts = [
        verdict("right", OPEN, "lowest_flow", 60.0),
        verdict("shallow", OPEN, "lowest_flow", 190.0),
        verdict("shallower", OPEN, "lowest_flow", 10.0),
        verdict("false wall", OPEN, "single_plane"),
        verdict("missed wall", WALL, "lowest_flow", 10.0),
        verdict("silent", WALL, "none"),
        verdict("still", STILL, "lowest_flow", 10.0),
        verdict("found", WALL, "single_plane"),
    ]
    assert [v.b for v in worst_pairs(verdicts)] == [
        "still", "missed wall", "false wall", "shallower", "shallow",
    ]  # fmt: skip


def test_vanishing_points_by_how_far_they_are_off():
    lines = [
        judge_lines("near", (10.0, 10.0), (12.0, 10.0), 200, 0.1),
        judge_lines("off", (10.0, 10.0), (60.0, 10.0), 200, 0.1),
        judge_lines("none", None, (60.0, 10.0), 200, 0.1),
        judge_lines("far", (10.0, 10.0), (160.0, 10.0), 200, 0.1),
    ]
    assert [v.frame for v in worst_frames(lines)] == ["far", "off", "none"]


def test_the_sheet_shows_answer_and_truth_of_each():
    frames = {f"{index}": OPEN for index in range(6)}
    wrong = [verdict(name, OPEN, "lowest_flow", 190.0) for name in frames]
    sheet = contact_sheet(evaluation(wrong, frames), read)
    assert sheet is not None
    text, tile = 2 * 17 + 4, 180  # frames are enlarged to 360 px
    assert sheet.shape == (2 * (text + tile), 4 * 360, 3)
    first = sheet[text : text + tile, :360]
    assert (first[round(50.5 * 1.8 - 0.5), round(190.5 * 1.8 - 0.5)] == 255).all()  # the cross
    strip = first[-5, [45, 135, 225, 315]].astype(int)
    assert strip[0][2] > 200 > strip[0][1]  # 1 of 4 m: red
    assert strip[1][1] > 150 > strip[1][2]  # 4 of 4 m: green
    assert len(set(strip[2])) == 1  # not known: grey
    assert (sheet[text + tile + text :, 2 * 360 :] == 0).all()  # two tiles in the second row


def test_truth_of_stills_is_drawn():
    frames = {"f": Frame(vp=(100.0, 50.0), far_box=(20.0, 20.0, 60.0, 80.0))}
    lines = [judge_lines("f", None, (100.0, 50.0), 200, 0.1)]
    sheet = contact_sheet(evaluation([], frames, lines), read)
    assert sheet is not None
    yellow = (sheet == (0, 235, 255)).all(axis=2)
    assert yellow[38 + round(50 * 1.8), round(20.5 * 1.8 - 0.5)]
    assert yellow[38 + 86 : 38 + 96, 166:176].any()


def test_nothing_wrong_is_no_sheet():
    assert contact_sheet(evaluation([verdict("f", OPEN, "lowest_flow", 60.0)], {"f": OPEN}), read) is None

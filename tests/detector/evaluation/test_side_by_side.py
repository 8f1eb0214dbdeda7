"""Every method on the same pair: its own answer, its own time, judged by the truth that none of them was told."""

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest

from detector.evaluation import side_by_side
from detector.evaluation.dataset import load_truth
from detector.evaluation.judgement import NEAR_SHARE
from detector.evaluation.methods import METHODS, Answer, PairInput
from detector.evaluation.side_by_side import KnownPair, answer_side_by_side
from detector.params import DetectorParams

OFFICE = Path(__file__).parents[2] / "data" / "pairs" / "office"
PARAMS = DetectorParams.preset("default", kmeans_restarts=1, clusters_max=6)
IMAGES = load_truth(OFFICE / "groundtruth.json")
PAIR = IMAGES.pairs[0]


def pair_input():
    earlier, later = (cv2.imread(str(OFFICE / name), cv2.IMREAD_GRAYSCALE) for name in (PAIR.a, PAIR.b))
    return PairInput(earlier, later, IMAGES.camera)


class Fixed:
    """Says the same each time, and counts."""

    def __init__(self, answer):
        self.said, self.asked, self.resets = answer, [], 0

    def answer(self, pair):
        self.asked.append(pair)
        return self.said

    def reset(self):
        self.resets += 1


def test_each_row_is_the_methods_own_answer_in_their_order():
    given = pair_input()
    found = answer_side_by_side(given, PARAMS, loops=1)
    assert [row.method for row in found] == list(METHODS)
    for row in found:
        alone = METHODS[row.method](PARAMS).answer(given)
        assert (row.answer.kind, row.answer.point_px) == (alone.kind, alone.point_px)
        assert row.answer.confidence == alone.confidence
        assert row.seconds >= 0.0
        assert (row.verdict, row.right) == (None, None), "no truth was given"


def test_the_truth_is_for_judging_alone(monkeypatch):
    free = IMAGES.frames[PAIR.b].depth.free_column.x
    made = {
        "good": Fixed(Answer("gap", (free, 180.0), confidence=0.7)),
        "bad": Fixed(Answer("gap", (530.0, 180.0))),
        "wall": Fixed(Answer("single_plane")),
        "silent": Fixed(Answer("none", reason="no_motion")),
    }
    monkeypatch.setattr(side_by_side, "METHODS", {name: lambda _, m=m: m for name, m in made.items()})
    given = pair_input()
    found = answer_side_by_side(given, PARAMS, known=KnownPair(IMAGES, PAIR), loops=2)
    assert [row.right for row in found] == [True, False, False, None]
    assert found[0].verdict.profile_ratio == pytest.approx(1.0)
    assert abs(530.0 - free) > NEAR_SHARE * 540
    for method in made.values():
        assert len(method.asked) == 3  # once to warm up, then each loop
        assert method.resets == 2, "every loop is a first loop"
        assert all(pair is given for pair in method.asked)


def test_the_time_is_the_median_of_the_loops_and_the_loops_take_turns(monkeypatch):
    order = []
    durations = iter([1.0, 10.0, 5.0, 30.0, 2.0, 20.0])
    now = [0.0]

    class Slow(Fixed):
        def __init__(self, name):
            super().__init__(Answer("gap", (1.0, 1.0)))
            self.name = name

        def answer(self, pair):
            if self.asked:  # the first warms up
                order.append(self.name)
                now[0] += next(durations)
            return super().answer(pair)

    monkeypatch.setattr(side_by_side, "METHODS", {name: lambda _, n=name: Slow(n) for name in ("a", "b")})
    blank = PairInput(np.zeros((8, 8), np.uint8), np.zeros((8, 8), np.uint8))
    found = answer_side_by_side(blank, PARAMS, loops=3, timer=lambda: now[0])
    assert order == ["a", "b"] * 3
    assert [row.seconds for row in found] == [2.0, 20.0]
    with pytest.raises(ValueError, match="loops"):
        answer_side_by_side(blank, PARAMS, loops=0)


def test_frames_that_no_method_can_use_are_answers_too():
    given = dataclasses.replace(pair_input(), camera=None, earlier=np.zeros((8, 8), np.uint8))
    found = {row.method: row.answer for row in answer_side_by_side(given, PARAMS, loops=1)}
    assert {found[name].reason for name in ("paper", "parallax", "flow_balance")} == {"wrong_size"}
    assert found["straight"].point_px is not None

"""What a report says of each step is what the pipeline did: the same counts, choices, centres and votes."""

import itertools
import json
import math
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from detector.camera_model import CameraModel
from detector.overlay import CandidateRole
from detector.params import DetectorParams
from detector.report import P_SHOWN, CallCounter, Pair, cost_of_loops, examine, votes
from detector.results import Direction, DirectionKind, NoDetection, SinglePlane

PAIRS = Path(__file__).parents[1] / "data" / "pairs"


def image(name):
    return cv2.imread(str(PAIRS / name), cv2.IMREAD_GRAYSCALE)


def office(earlier, later, *, turned=False):
    camera = rotation = None
    if turned:
        known = json.loads((PAIRS / "office" / "poses.json").read_text())
        k = known["K"]
        camera = CameraModel(540, 360, k[0][0], k[1][1], k[0][2], k[1][2])
        a, b = (np.array(known["poses"][name])[:3, :3] for name in (earlier, later))
        rotation = b.T @ a
    return Pair(image(f"office/{earlier}"), image(f"office/{later}"), camera, rotation)


OPEN = office("00068.jpg", "00069.jpg")
TURNED = office("00193.jpg", "00194.jpg", turned=True)
WALL = Pair(image("brickwall/001.jpg"), image("brickwall/003.jpg"))
CASES = {
    "default": (OPEN, DetectorParams.preset("default")),
    "paper": (OPEN, DetectorParams.preset("paper")),
    "exact": (OPEN, DetectorParams.preset("default", speed="exact", clusters_max=6)),
    "turned": (TURNED, DetectorParams.preset("default")),
    "turned, not predicted": (TURNED, DetectorParams.preset("default", lk_predict_rotation=False)),
    "inverse contact": (OPEN, DetectorParams.preset("default", depth_cue="inverse_contact")),
    "circular": (OPEN, DetectorParams.preset("default", angle_statistics="circular", angle_gain=0.3)),
    "wall": (WALL, DetectorParams.preset("default")),
}


@pytest.mark.parametrize("name", CASES)
def test_every_step_is_the_pipelines(name):
    pair, params = CASES[name]
    steps = examine(pair, params)
    found = steps.result.detection.diagnostics
    assert found.n is not None, "a pair that ends earlier shows nothing"

    assert len(steps.tracks) == found.n_tracks
    assert steps.came_back.sum() == found.n_after_distribution
    assert steps.long_enough.sum() == found.n_after_length
    assert steps.kept.sum() == found.n_after_angle
    np.testing.assert_array_equal(steps.tracks[steps.came_back].start_px, steps.result.tracks.start_px)
    np.testing.assert_array_equal(steps.tracks[steps.came_back].end_px, steps.result.tracks.end_px)

    assert steps.survivors[P_SHOWN.index(found.p)] == found.n_after_angle
    small = [
        p
        for p, gain in zip(P_SHOWN, steps.gains, strict=True)
        if gain is not None and gain < params.angle_gain
    ]
    assert found.p == small[0]

    best = max(steps.n_choices, key=lambda choice: choice.quotient)
    assert best.n == found.n
    samples = steps.tracks[steps.kept].end_px
    middles = [samples[steps.labels == label].mean(axis=0) for label in range(found.n)]
    np.testing.assert_allclose(middles, found.centre_points_px, atol=0.2)

    calm = [
        c.k
        for c in steps.k_choices
        if c.largest_change is not None and c.largest_change < params.nearest_change
    ]
    assert found.k == (calm[0] if calm else steps.k_choices[-1].k)
    chosen = next(choice for choice in steps.k_choices if choice.k == found.k)
    np.testing.assert_allclose(chosen.magnitudes, found.centre_magnitudes_px)
    assert steps.unit == ("1/frame" if params.depth_cue == "inverse_contact" else "px")


def test_the_votes_figures_are_those_that_decided():
    seen = set()
    for preset, tolerance in itertools.product(("default", "paper"), (1e-4, 10.0)):
        params = DetectorParams.preset(preset, vote_tolerance=tolerance)
        steps = examine(OPEN, params)
        *others, examined = votes(steps)
        assert all(vote.role is CandidateRole.VALID for vote in others)
        found = steps.result.detection.diagnostics
        assert {vote.point_px for vote in (*others, examined)} == set(found.candidates_px)
        assert min((*others, examined), key=lambda v: math.dist(v.point_px, found.lmcc_px)) is examined
        elected = steps.result.detection.kind is DirectionKind.VANISHING_POINT
        assert (examined.difference < params.vote_tolerance) == elected
        assert examined.role is (CandidateRole.ELECTED if elected else CandidateRole.REJECTED)
        seen.add(examined.role)
    assert seen == {CandidateRole.ELECTED, CandidateRole.REJECTED}, "one tolerance elects, the other rejects"


def test_an_answer_that_comes_early_leaves_the_later_steps_empty():
    black = Pair(np.zeros((120, 160), np.uint8), np.zeros((120, 160), np.uint8))
    steps = examine(black, DetectorParams.preset("default"))
    assert isinstance(steps.result.detection, NoDetection)
    assert (len(steps.tracks), steps.survivors, steps.n_choices, steps.k_choices) == (0, (), (), ())
    assert votes(steps) == []

    few = examine(OPEN, DetectorParams.preset("default", min_flow_vectors=2000))
    assert isinstance(few.result.detection, NoDetection)
    assert few.kept.sum() == few.result.detection.diagnostics.n_after_angle > 0
    assert few.n_choices == ()

    still = examine(Pair(OPEN.earlier, OPEN.earlier), DetectorParams.preset("default"))
    assert isinstance(still.result.detection, NoDetection)
    assert len(still.tracks) == still.result.detection.diagnostics.n_tracks > 0
    assert still.survivors == ()


def test_the_pairs_cover_all_kinds_of_answer():
    assert isinstance(examine(*CASES["wall"]).result.detection, SinglePlane)
    assert isinstance(examine(*CASES["default"]).result.detection, Direction)


def test_calls_of_python_and_c_functions_are_counted_and_the_profiler_put_back():
    def python_function():
        return 1

    before = sys.getprofile()
    with CallCounter() as counter:
        start = counter()
        for _ in range(10):
            python_function()
        after_python = counter()
        for _ in range(10):
            math.sqrt(2.0)
        after_c = counter()
        assert counter() == counter(), "asking costs nothing"
    assert after_python - start == 10
    assert after_c - after_python == 10
    assert sys.getprofile() is before


def test_the_first_loop_estimates_and_the_others_do_not():
    ticks = itertools.count()
    first, other = cost_of_loops(
        WALL, DetectorParams.preset("default"), loops=2, timer=lambda: float(next(ticks))
    )
    assert set(first.seconds) == set(other.seconds) == set(first.calls) == set(other.calls)
    assert set(first.seconds) >= {"features", "flow", "clusters"}
    assert all(value == int(value) >= 1 for value in first.seconds.values()), "the timer's own seconds"
    assert first.total_seconds == sum(first.seconds.values())
    assert other.calls["clusters"] < first.calls["clusters"]
    assert first.total_calls == sum(first.calls.values()) > other.total_calls
    with pytest.raises(ValueError, match="loops"):
        cost_of_loops(WALL, DetectorParams.preset("default"), loops=0)

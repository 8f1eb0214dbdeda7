"""Two evaluations of the same pairs: differences, their intervals, and agreement."""

import numpy as np
import pytest

from detector.evaluation.comparison import ComparisonError, compare
from detector.evaluation.table import comparison

PAIR = {
    "kind": "lowest_flow", "x_px": 10.0, "y_px": 10.0, "width_px": 100, "has_direction_truth": True, "right": True,
    "error_width": 0.1, "profile_ratio": 0.95, "single_plane_truth": False, "no_motion_truth": None, "foe_px": 3.0,
    "contact_error": 0.1, "seconds": 0.1,
}  # fmt: skip


def evaluation(records, name="set", frames=()):
    pairs = [{**PAIR, "a": str(index), "b": str(index + 1), **record} for index, record in enumerate(records)]
    return {"name": name, "per_pair": pairs, "per_frame": list(frames)}


def figures(result):
    return {figure["name"]: figure for figure in result["figures"]}


def test_an_evaluation_does_not_differ_from_itself():
    one = evaluation([{"right": index % 3 == 0, "seconds": 0.1 * index} for index in range(30)])
    result = compare([one], [one])
    for figure in result["all"]["figures"]:
        assert figure["difference"] == 0.0
        assert figure["interval"] == (0.0, 0.0)
        assert figure["verdict"] == "no difference shown"
    assert result["all"]["agreement"] == {
        "pairs": 30, "same_kind": 30, "both_directions": 30, "within_twentieth_width": 30, "same_answer": 30,
    }  # fmt: skip


def test_pairing_shows_what_separate_intervals_would_hide():
    rng = np.random.default_rng(0)
    hard = (
        rng.random(200) < 0.5
    )  # wrong for both, which widens either share's interval and not that of the difference
    one = evaluation([{"right": bool(not is_hard)} for is_hard in hard])
    spoilt = [bool(not is_hard) and index % 20 != 0 for index, is_hard in enumerate(hard)]
    other = evaluation([{"right": right} for right in spoilt])
    figure = figures(compare([one], [other])["sets"][0])["direction right, of those answered"]
    lost = (np.sum(~hard) - np.sum(spoilt)) / 200
    assert figure["difference"] == pytest.approx(lost)
    low, high = figure["interval"]
    assert 0.0 < low < lost < high < 0.08
    assert figure["verdict"] == "better"
    back = figures(compare([other], [one])["sets"][0])["direction right, of those answered"]
    assert back["verdict"] == "worse"


def test_smaller_is_better_where_it_is_an_error():
    slow = evaluation([{"seconds": 1.0 + 0.01 * index, "error_width": 0.3} for index in range(20)])
    quick = evaluation([{"seconds": 0.1, "error_width": 0.1} for _ in range(20)])
    found = figures(compare([slow], [quick])["all"])
    assert found["seconds"]["verdict"] == "worse"
    assert found["direction error (width)"]["verdict"] == "worse"
    assert figures(compare([quick], [slow])["all"])["seconds"]["verdict"] == "better"


def test_silence_counts_against_all_with_truth_and_not_against_those_answered():
    silent = {
        "kind": "none",
        "x_px": None,
        "y_px": None,
        "right": None,
        "error_width": None,
        "profile_ratio": None,
    }
    one = evaluation([{}, {}, {"right": False}, {}])
    other = evaluation([{}, silent, silent, {}])
    found = figures(compare([one], [other])["all"])
    answered, of_all = (
        found[f"direction right, of {words}"] for words in ("those answered", "all with truth")
    )
    assert (answered["first"], answered["second"]) == (0.75, 1.0)
    assert (of_all["first"], of_all["second"]) == (0.75, 0.5)


def test_agreement_is_kind_and_place():
    one = evaluation([{}, {}, {}, {"kind": "none"}, {"kind": "single_plane"}])
    other = evaluation(
        [
            {"x_px": 15.0, "kind": "vanishing_point"},  # another kind, the same place
            {"x_px": 15.1},
            {"kind": "none"},
            {"kind": "none"},
            {"kind": "single_plane"},
        ]
    )
    assert compare([one], [other])["all"]["agreement"] == {
        "pairs": 5, "same_kind": 3, "both_directions": 2, "within_twentieth_width": 1, "same_answer": 3,
    }  # fmt: skip


def test_planes_motion_and_vanishing_points_have_their_figures():
    def made(wall, false_wall, still, within):
        return evaluation(
            [
                {"single_plane_truth": True, "kind": wall},
                {"single_plane_truth": False, "kind": false_wall},
                {"single_plane_truth": None, "no_motion_truth": True, "kind": still},
            ],
            frames=[{"frame": "f", "within_tenth_width": within, "error_width": 0.2}],
        )

    good, bad = (
        made("single_plane", "lowest_flow", "none", True),
        made("none", "single_plane", "single_plane", False),
    )
    found = figures(compare([good], [bad])["all"])
    for name, first, second in (
        ("planes found", 1.0, 0.0),
        ("false planes", 0.0, 1.0),
        ("silent without motion", 1.0, 0.0),
        ("vanishing point right", 1.0, 0.0),
    ):
        assert (found[name]["first"], found[name]["second"]) == (first, second)


def test_sets_are_pooled_and_shown():
    one, two = evaluation([{}] * 4, "one"), evaluation([{"right": False}] * 12, "two")
    result = compare([one, two], [one, two])
    assert figures(result["all"])["direction right, of those answered"]["first"] == 0.25
    text = comparison(result, "this", "seed=1")
    assert (
        "| one | direction right, of those answered | 1 | 1 | +0 | +0 .. +0 | no difference shown |" in text
    )
    assert "| all sets | 16 | 16 | 16 | 16 | 16 |" in text


@pytest.mark.parametrize(
    ("other", "words"),
    [
        ([evaluation([{}], "else")], "sets differ"),
        ([evaluation([{}, {}])], "1 entries of per_pair stand in one evaluation only"),
        ([{"name": "set"}], "not an evaluation of this version"),
        ([{"name": "set", "per_pair": [3], "per_frame": []}], "not an evaluation of this version"),
        ([], "sets differ"),
    ],
)
def test_what_does_not_belong_together_is_refused(other, words):
    with pytest.raises(ComparisonError, match=words):
        compare([evaluation([{}])], other)

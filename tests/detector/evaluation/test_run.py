"""A method run over a set: what it is told, which pairs count, and how verdicts add up."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from detector.camera_model import CameraModel
from detector.evaluation.dataset import (
    DatasetError,
    Depth,
    Frame,
    ImageSet,
    Motion,
    Pair,
    load_truth,
    pairs_by_baseline,
)
from detector.evaluation.methods import Answer
from detector.evaluation.run import Settings, count_steps, enough_depth, evaluate, summary
from detector.flow import derotate
from detector.params import DetectorParams

PAIRS = Path(__file__).parents[2] / "data" / "pairs"
PARAMS = DetectorParams.preset("default")
CAMERA = CameraModel(64, 48, 60.0, 60.0, 31.5, 23.5)
POSE_A = ((1.0, 0, 0, 0), (0, 1.0, 0, 0), (0, 0, 1.0, 0), (0, 0, 0, 1.0))
POSE_B = ((0.8, 0, 0.6, 0), (0, 1.0, 0, 0), (-0.6, 0, 0.8, 0.5), (0, 0, 0, 1.0))


class Told:
    """A method that writes down what it was given, and answers from a list."""

    def __init__(self, answers):
        self.answers = list(answers)
        self.given = []
        self.resets = 0

    def answer(self, pair):
        self.given.append(pair)
        return self.answers.pop(0)

    def vanishing_point(self, image):
        return (10.0 + image[0, 0], 10.0)

    def reset(self):
        self.resets += 1


def images_of(frames, pairs=(), camera=None):
    return ImageSet("made", Path("made"), (64, 48), camera, frames, tuple(pairs))


def read(path):
    return np.full((48, 64), len(path.name), np.uint8)


def settings(**changes):
    return Settings(**{"method": "told", "preset": "default", "params": PARAMS, **changes})


def direction(x, y=24.0):
    return Answer("lowest_flow", (x, y))


def moving():
    frames = {"a": Frame(pose=POSE_A), "b": Frame(pose=POSE_B)}
    return images_of(frames, [Pair(a="a", b="b", b_derot="turned")], CAMERA)


def test_what_a_method_is_told_of_the_motion():
    images = moving()
    motion = images.motion_of(images.pairs[0])
    assert isinstance(motion, Motion)
    for poses, derotated, rotation, translation in (
        ("full", False, motion.later_from_earlier, motion.translation_earlier_m),
        ("rotation", False, motion.later_from_earlier, None),
        ("none", False, None, None),
        ("full", True, np.eye(3), motion.translation_earlier_m),
        ("none", True, None, None),
    ):
        method = Told([direction(5.0)])
        done = evaluate(images, images.pairs, settings(poses=poses, derotated=derotated), read, method=method)
        given = method.given[0]
        np.testing.assert_equal(given.later_from_earlier, rotation)
        np.testing.assert_equal(given.translation_earlier_m, translation)
        assert given.camera is CAMERA
        assert given.later[0, 0] == len("turned" if derotated else "b")
        said = summary(done)
        assert said["poses"] == poses
        assert said["images"] == ("derotated" if derotated else "as_taken")
        assert said["per_pair"][0]["baseline_m"] == pytest.approx(0.5)


def test_a_set_without_poses_tells_nothing_whatever_is_asked():
    images = images_of({"a": Frame(), "b": Frame()}, [Pair(a="a", b="b")], CAMERA)
    method = Told([direction(5.0)])
    done = evaluate(images, images.pairs, settings(), read, method=method)
    assert method.given[0].later_from_earlier is None
    assert summary(done)["poses"] == "none"


def test_every_pair_is_a_first_loop_unless_it_is_a_sequence():
    images = images_of({"a": Frame(), "b": Frame()}, [Pair(a="a", b="b")] * 3)
    for sequence, resets in ((False, 3), (True, 0)):
        method = Told([Answer("none", reason="no_motion")] * 3)
        done = evaluate(images, images.pairs, settings(sequence=sequence), read, method=method)
        assert method.resets == resets
        assert summary(done)["loops"] == ("sequence" if sequence else "first")


def test_figures_add_up():
    open_ = {"depth": Depth(column_profile_m=(1.0, 4.0), plane_like=False)}
    wall = {"depth": Depth(column_profile_m=(4.0, 4.0), plane_like=True)}
    frames = {
        "a": Frame(),
        "open": Frame(**open_),
        "wall": Frame(**wall),
        "bare": Frame(),
        "still": Frame(no_motion=True),
    }
    names = ["open", "open", "open", "open", "wall", "wall", "wall", "bare", "still", "still"]
    method_says = [
        direction(40.0), direction(10.0), Answer("single_plane"), Answer("none", reason="blurred"),
        direction(10.0), Answer("single_plane"), Answer("none", reason="no_motion"),
        direction(1.0), Answer("none", reason="no_motion"), direction(2.0),
    ]  # fmt: skip
    method = Told(method_says)
    images = images_of(frames, [Pair(a="a", b=name) for name in names])
    ticks = iter(range(100))
    done = evaluate(images, images.pairs, settings(), read, method=method, timer=lambda: float(next(ticks)))
    said = summary(done)
    assert said["pairs"] == 10
    assert said["kinds"] == {"lowest_flow": 5, "none": 3, "single_plane": 2}
    assert said["reasons"] == {"blurred": 1, "no_motion": 2}
    found = said["direction"]
    assert {key: found[key] for key in ("answered", "with_truth", "right", "in_box", "pairs_with_truth")} == {
        "answered": 5, "with_truth": 3, "right": 2, "in_box": 0, "pairs_with_truth": 7,
    }  # fmt: skip
    assert (found["open_with_truth"], found["open_right"]) == (2, 1)
    assert found["median_profile_ratio"] == 1.0
    low, high = found["right_ci"]
    assert low <= 2 / 3 <= high
    plane = said["single_plane"]
    assert [plane[key] for key in ("tp", "fp", "fn", "tn")] == [1, 1, 2, 3]
    assert (plane["silent_on_planes"], plane["silent_elsewhere"]) == (1, 1)
    assert said["no_motion"] == {"with_truth": 2, "silent": 1}
    assert said["seconds"] == {"median": 1.0, "p95": 1.0}
    assert len(said["per_pair"]) == 10
    assert said["per_pair"][3] == {**said["per_pair"][3], "kind": "none", "reason": "blurred", "right": None}


def test_stills_are_judged_by_their_lines_alone():
    frames = {"1": Frame(vp=(11.0, 10.0)), "2": Frame(), "3": Frame(vp=(40.0, 10.0))}
    method = Told([])
    images = images_of(frames)
    assert count_steps(images, ()) == 2
    said = summary(evaluate(images, (), settings(), read, method=method))
    assert said["pairs"] == 0
    lines = said["vanishing_point"]
    assert (lines["with_truth"], lines["found"], lines["within_tenth_width"]) == (2, 2, 1)
    assert [frame["error_width"] for frame in said["per_frame"]] == [0.0, pytest.approx(29 / 64)]
    assert said["direction"]["right_ci"] is None


def test_lines_of_pairs_are_judged_on_each_later_frame_once():
    frames = {"a": Frame(vp=(1.0, 1.0)), "b": Frame(vp=(11.0, 10.0))}
    method = Told([Answer("none")] * 2)
    images = images_of(frames, [Pair(a="a", b="b"), Pair(a="b", b="b")])
    steps = []
    said = summary(
        evaluate(images, images.pairs, settings(), read, method=method, on_step=lambda: steps.append(1))
    )
    assert [frame["frame"] for frame in said["per_frame"]] == ["b"]
    assert len(steps) == count_steps(images, images.pairs) == 3


def test_pairs_whose_depth_is_hardly_known_can_be_left_out():
    frames = {
        "a": Frame(),
        "little": Frame(depth=Depth(valid_frac=0.5)),
        "much": Frame(depth=Depth(valid_frac=0.6)),
    }
    images = images_of(frames, [Pair(a="a", b=name) for name in ("little", "much", "a")])
    assert [pair.b for pair in enough_depth(images, images.pairs, 0.6)] == ["much", "a"]


def test_images_of_another_size_and_missing_turned_images_are_refused():
    images = images_of({"a": Frame(), "b": Frame()}, [Pair(a="a", b="b")])
    method = Told([direction(1.0)])
    with pytest.raises(DatasetError, match="found 20 x 10 px, image_size says 64 x 48"):
        evaluate(images, images.pairs, settings(), lambda path: np.zeros((10, 20), np.uint8), method=method)
    with pytest.raises(DatasetError, match="has no b_derot"):
        evaluate(images, images.pairs, settings(derotated=True), read, method=method)


def grey(path):
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    assert image is not None, path
    return image


def real(name, images=None, pairs=None, **changes):
    images = images or load_truth(PAIRS / name / "groundtruth.json")
    told = Settings(**{"method": "paper", "preset": "default", "params": PARAMS, **changes})
    return summary(evaluate(images, images.pairs if pairs is None else pairs, told, grey))


def test_the_brick_wall_is_a_wall_at_the_right_time():
    said = real("brickwall")
    assert said["single_plane"]["fp"] == 0
    assert said["single_plane"]["tp"] >= 2
    assert said["time_to_contact"]["sources"] == {"time_to_contact_s": said["time_to_contact"]["n"]}
    assert said["time_to_contact"]["median_relative_error"] < 0.15
    assert said["foe"]["median_px"] < 10.0


def test_the_rotation_brings_the_focus_to_where_it_is():
    without, with_rotation = real("office", poses="none"), real("office", poses="rotation")
    assert with_rotation["foe"]["n"] >= 3
    assert with_rotation["foe"]["median_px"] < 30.0
    assert without["foe"]["n"] < 3 or without["foe"]["median_px"] > 3 * with_rotation["foe"]["median_px"]


def test_images_turned_back_give_the_same_focus_as_the_rotation(tmp_path):
    office = load_truth(PAIRS / "office" / "groundtruth.json")
    assert office.camera is not None
    pairs = []
    for pair in office.pairs[1:4]:
        motion = office.motion_of(pair)
        assert motion is not None
        grid = np.stack(np.meshgrid(np.arange(540.0), np.arange(360.0)), axis=-1).reshape(-1, 2)
        source = derotate(grid, office.camera, motion.later_from_earlier).reshape(360, 540, 2)
        later = grey(office.folder / pair.b)
        turned = cv2.remap(later, source.astype(np.float32), None, cv2.INTER_LINEAR)
        cv2.imwrite(str(tmp_path / f"turned_{pair.b}.png"), turned)
        for name in (pair.a, pair.b):
            (tmp_path / name).write_bytes((office.folder / name).read_bytes())
        pairs.append(pair.model_copy(update={"b_derot": f"turned_{pair.b}.png"}))
    images = ImageSet("turned", tmp_path, office.image_size_px, office.camera, office.frames, tuple(pairs))
    said = real("", images, derotated=True, poses="none")
    assert said["images"] == "derotated"
    assert said["foe"]["n"] >= 2
    assert said["foe"]["median_px"] < 35.0  # at steps of 0.1 m, three pairs


def test_pairs_formed_from_poses_have_their_focus_from_the_poses():
    office = load_truth(PAIRS / "office" / "groundtruth.json")
    formed = pairs_by_baseline(office, 0.05)
    assert {(pair.a, pair.b) for pair in formed} >= {("00184.jpg", "00185.jpg")}
    said = real("office", office, formed, poses="rotation")
    assert said["foe"]["n"] >= 3
    assert said["foe"]["median_px"] < 30.0

"""Sets of images: what files say, motion from poses, pairs of a sequence, and one clear line for files that cannot be used."""

import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from detector.evaluation.dataset import (
    DatasetError,
    Frame,
    ImageSet,
    Pair,
    load_truth,
    pairs_by_baseline,
    with_truth_of,
)

PAIRS = Path(__file__).parents[2] / "data" / "pairs"
OFFICE = PAIRS / "office" / "groundtruth.json"


def pose(x_m=0.0, z_m=0.0, yaw_deg=0.0):
    c, s = math.cos(math.radians(yaw_deg)), math.sin(math.radians(yaw_deg))
    return ((c, 0.0, s, x_m), (0.0, 1.0, 0.0, 0.0), (-s, 0.0, c, z_m), (0.0, 0.0, 0.0, 1.0))


def walk(*poses):
    frames = {f"{index}.png": Frame(pose=each) for index, each in enumerate(poses)}
    return ImageSet("walk", Path("walk"), (64, 48), None, frames)


def test_a_real_set_is_read_with_its_camera_pairs_and_truth():
    office = load_truth(OFFICE)
    assert office.name == "office"
    assert len(office.frames) == 10
    assert [pair.b for pair in office.pairs] == [
        "00069.jpg", "00185.jpg", "00190.jpg", "00194.jpg", "00298.jpg",
    ]  # fmt: skip
    assert office.camera is not None
    assert (office.camera.width_px, office.camera.cx_px) == (540, pytest.approx(269.503, abs=1e-3))
    truth = office.truth_of(office.pairs[1])
    assert truth.depth is not None
    assert truth.depth.plane_like is True
    assert truth.depth.column_profile_m is not None
    assert len(truth.depth.column_profile_m) == 18


def test_the_focus_that_follows_from_the_poses_is_the_files():
    office = load_truth(OFFICE)
    for pair in office.pairs:
        derived = office.focus_of(pair.model_copy(update={"foe": None}))
        assert derived == pytest.approx(pair.foe, abs=0.5)
        assert office.focus_of(pair) == pair.foe


def test_motion_is_that_of_the_files_own_figures():
    office = load_truth(OFFICE)
    table = json.loads(OFFICE.read_text())["pairs"]
    for pair, said in zip(office.pairs, table, strict=True):
        motion = office.motion_of(pair)
        assert motion is not None
        assert motion.baseline_m == pytest.approx(said["trans"], abs=1e-4)
        assert math.degrees(motion.rotation_rad) == pytest.approx(said["rot_deg"], abs=0.01)
        # The focus in the second frame is the first one's, turned.
        assert office.camera is not None
        moved = office.camera.matrix @ motion.translation_later_m
        assert tuple(moved[:2] / moved[2]) == pytest.approx(tuple(said["foe_in_second"]), abs=0.5)


def test_a_turn_to_the_right_takes_what_was_ahead_to_the_left():
    images = walk(pose(), pose(z_m=1.0, yaw_deg=10.0))
    motion = images.motion_of(Pair(a="0.png", b="1.png"))
    assert motion is not None
    assert (motion.later_from_earlier @ [0.0, 0.0, 1.0])[0] == pytest.approx(-math.sin(math.radians(10.0)))
    assert motion.translation_earlier_m == pytest.approx([0.0, 0.0, 1.0])
    assert math.degrees(motion.rotation_rad) == pytest.approx(10.0)


def test_level_is_what_the_cameras_agree_on():
    images = load_truth(OFFICE)
    for pair in images.pairs:
        level = images.level_from_later(pair)
        assert level @ level.T == pytest.approx(np.eye(3), abs=1e-4)
        assert np.linalg.det(level) == pytest.approx(1.0, abs=1e-4)
        assert level[2, 1] > 0.7  # the camera's lower edge is below
        # A head looks down rather than up while it walks.
        assert -0.2 < level[2, 2] < 0.7


def test_cameras_that_agree_on_no_vertical_have_no_level():
    about = [pose(yaw_deg=0.0), pose(z_m=1.0)]
    images = walk(*about)
    assert images.level_from_later(Pair(a="0.png", b="1.png")) is not None
    leaning = np.eye(4)
    leaning[:3, :3] = (
        cv2.Rodrigues(np.array([0.0, 0.0, np.pi / 4]))[0] @ cv2.Rodrigues(np.array([0.7, 0.0, 0.0]))[0]
    )
    images = walk(leaning.tolist(), leaning.tolist())  # on its edge and looking down: near no axis
    assert images.level_from_later(Pair(a="0.png", b="1.png")) is None


def test_what_is_said_of_a_pair_goes_before_what_is_said_of_its_frame():
    frames = {"a": Frame(), "b": Frame(single_plane=True, best_free_distance_m=2.0)}
    images = ImageSet("s", Path(), None, None, frames)
    truth = images.truth_of(Pair(a="a", b="b", single_plane=False, wall_ahead=True))
    assert (truth.single_plane, truth.wall_ahead, truth.best_free_distance_m) == (False, True, 2.0)
    assert images.motion_of(Pair(a="a", b="b")) is None
    assert not images.has_poses


def test_the_latest_frame_that_is_far_enough_away_is_the_partner():
    images = walk(*(pose(z_m=0.1 * step) for step in range(6)))
    found = [(pair.a, pair.b) for pair in pairs_by_baseline(images, 0.25)]
    assert found == [("0.png", "3.png"), ("1.png", "4.png"), ("2.png", "5.png")]


def test_gaps_and_large_turns_make_no_pair():
    gap = walk(pose(), pose(z_m=0.3), pose(z_m=2.0), pose(z_m=2.3))
    assert [(pair.a, pair.b) for pair in pairs_by_baseline(gap, 0.25)] == [
        ("0.png", "1.png"),
        ("2.png", "3.png"),
    ]
    turning = walk(pose(), pose(z_m=0.3, yaw_deg=17.0), pose(z_m=0.6, yaw_deg=36.0))
    assert [pair.b for pair in pairs_by_baseline(turning, 0.25)] == ["1.png"]
    assert pairs_by_baseline(walk(pose(), pose()), 0.25) == ()


def test_pairs_from_poses_need_every_pose():
    images = ImageSet("s", Path("s"), None, None, {"a": Frame(pose=pose()), "b": Frame()})
    with pytest.raises(DatasetError, match="needs the pose of every frame"):
        pairs_by_baseline(images, 0.2)


def test_a_walk_lists_its_frames_in_order(tmp_path):
    table = {
        "image_size": [64, 48],
        "K": [[60, 0, 31.5], [0, 60, 23.5], [0, 0, 1]],
        "frames": [{"file": f"{name}.png", "pose": pose()} for name in ("9", "10", "2")],
    }
    (tmp_path / "poses.json").write_text(json.dumps(table))
    images = load_truth(tmp_path / "poses.json")
    assert list(images.frames) == ["9.png", "10.png", "2.png"]
    assert images.name == tmp_path.name
    assert images.has_poses
    assert images.pairs == ()


def test_a_walk_takes_the_truth_of_frames_that_another_set_knows():
    images = walk(pose(), pose(z_m=0.3))
    labelled = Frame(single_plane=True, pose=pose(x_m=5.0))
    other = ImageSet("o", Path("o"), None, None, {"1.png": labelled, "7.png": labelled})
    joined = with_truth_of(images, other)
    assert joined.frames["1.png"].single_plane is True
    assert joined.frames["1.png"].pose == pose(z_m=0.3)
    assert joined.frames["0.png"] == images.frames["0.png"]
    assert list(joined.frames) == ["0.png", "1.png"]
    with pytest.raises(DatasetError, match="no frame of the same name"):
        with_truth_of(images, ImageSet("o", Path("o"), None, None, {"7.png": labelled}))


def minimal(**changes):
    table = {
        "image_size": [64, 48],
        "frames": {"a.png": {}, "b.png": {}},
        "pairs": [{"a": "a.png", "b": "b.png"}],
    }
    return {key: value for key, value in {**table, **changes}.items() if value is not ...}


@pytest.mark.parametrize(
    ("table", "words"),
    [
        (minimal(frames=...), "frames: missing"),
        (minimal(image_size=...), "image_size: missing"),
        (minimal(image_size=[64]), "image_size"),
        (minimal(pairs=[{"a": "a.png"}]), "pairs.0.b: missing"),
        (minimal(pairs=[{"a": "a.png", "b": "c.png"}]), "pairs.0.b: found 'c.png', which is not among the frames"),
        (minimal(frames={"a.png": {"vp": [1]}, "b.png": {}}), "frames.a.png.vp"),
        (minimal(frames={"a.png": {"pose": [[2, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}, "b.png": {}}), "not a rotation"),
        (minimal(frames={"a.png": {"depth": {"valid_frac": 7}}, "b.png": {}}), "frames.a.png.depth.valid_frac"),
        (minimal(K=[[60, 0, 31], [0, 60, 23]]), "K"),
        (minimal(K=[[-60, 0, 31], [0, 60, 23], [0, 0, 1]]), "K: fx_px: found -60"),
        (minimal(K=[[60, 0, 31], [0, 60, 23], [0, 0, 1]], distortion=[0.1]), "distortion: found 1 coefficients"),
        (minimal(frames=[{"pose": None}]), "frames.0: found no file name"),
        ([1, 2], "found a list"),
    ],
)  # fmt: skip
def test_a_file_that_cannot_be_used_is_one_clear_line(tmp_path, table, words):
    path = tmp_path / "groundtruth.json"
    path.write_text(json.dumps(table))
    with pytest.raises(DatasetError) as caught:
        load_truth(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert words in message
    assert "\n" not in message


def test_files_that_cannot_be_read_name_the_cause(tmp_path):
    with pytest.raises(DatasetError, match="cannot be read: No such file"):
        load_truth(tmp_path / "groundtruth.json")
    path = tmp_path / "broken.json"
    path.write_text('{"frames": ')
    with pytest.raises(DatasetError, match="is not valid JSON"):
        load_truth(path)
    path.write_bytes(b"\xff\xfe{")
    with pytest.raises(DatasetError, match="UTF-8"):
        load_truth(path)


def test_figures_that_are_not_numbers_are_refused(tmp_path):
    path = tmp_path / "groundtruth.json"
    path.write_text(json.dumps(minimal(frames={"a.png": {"vp": [np.nan, 1.0]}, "b.png": {}})))
    with pytest.raises(DatasetError, match=r"frames\.a\.png\.vp\.0"):
        load_truth(path)

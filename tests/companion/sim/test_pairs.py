from __future__ import annotations

import argparse
import itertools
import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from companion.errors import CompanionError
from companion.guidance.coordinates import heading_rad, r_body_from_camera, r_from_euler
from companion.guidance.observation import Pose
from companion.sim.depth_truth import column_profile_m, depth_truth, dominant_plane, is_single_plane
from companion.sim.image_effects import ImageEffects
from companion.sim.pair_poses import DrawnMotion, draw_sequence
from companion.sim.pairs import PairsError, PairsSpec, add_pairs_parser, frame_truth, make_pairs, pair_truth
from companion.sim.world.clearance import Obstacles
from companion.sim.world.file import load_world
from companion.sim.world.model import Goal, Start, Wall, World
from detector.camera_model import CameraModel
from detector.evaluation.dataset import load_truth

CAMERA = CameraModel.from_hfov(180, 120, 75.0)
FORWARD = r_body_from_camera(0.0, 0.0, 0.0)
SMALL = PairsSpec(
    pairs=3,
    worlds=("room",),
    width_px=320,
    height_px=240,
    frames=3,
    effects=ImageEffects.none(),
    depth=True,
    derotated=True,
)


def plane_depth(angle_deg: float, distance_m: float) -> NDArray[np.float32]:
    """Depth of a plane whose normal is turned to the side."""
    x, y = np.meshgrid(np.arange(180.0), np.arange(120.0))
    rays = CAMERA.pixel_to_ray(np.column_stack((x.ravel(), y.ravel())))
    normal = np.array([math.sin(math.radians(angle_deg)), 0.0, math.cos(math.radians(angle_deg))])
    return (distance_m / (rays @ normal) * rays[:, 2]).reshape(120, 180).astype(np.float32)


@pytest.mark.parametrize("angle_deg", [0.0, 25.0, 40.0])
def test_a_plane_is_found_among_other_things(angle_deg: float) -> None:
    depth = plane_depth(angle_deg, 2.5)
    depth[:, :30] = np.random.default_rng(1).uniform(0.5, 9.0, (120, 30))
    share, (found_deg, found_m) = dominant_plane(depth, CAMERA, np.random.default_rng(2))
    assert share == pytest.approx(150 / 180, abs=0.03)
    assert found_deg == pytest.approx(angle_deg, abs=0.5)
    assert found_m == pytest.approx(2.5, rel=0.01)


def test_a_plane_is_one_only_when_it_fills_the_view_and_is_met_squarely() -> None:
    rng = np.random.default_rng(0)
    squarely = depth_truth(plane_depth(10.0, 2.0), CAMERA, rng)
    assert squarely["plane_like"]
    assert is_single_plane(squarely)
    along = depth_truth(plane_depth(50.0, 2.0), CAMERA, rng)
    assert not along["plane_like"]
    assert not is_single_plane(along)
    half = plane_depth(0.0, 2.0)
    half[:, 90:] = plane_depth(0.0, 4.0)[:, 90:]
    assert not depth_truth(half, CAMERA, rng)["plane_like"]


def test_the_deepest_columns_are_where_the_gap_is() -> None:
    depth = np.full((120, 180), 2.0, np.float32)
    depth[:, 120:150] = 7.0  # columns 12 to 14 of 18
    depth[20:24, 100:110] = 30.0  # too small to count
    profile = column_profile_m(depth)
    np.testing.assert_allclose(profile, [2.0] * 12 + [7.0] * 3 + [2.0] * 3)
    truth = depth_truth(depth, CAMERA, np.random.default_rng(0))
    assert truth["free_column"]["bins_within_10pct"] == [12, 13, 14]
    assert truth["free_column"]["x"] == pytest.approx(134.5)
    expected_deg = math.degrees(math.atan((134.5 - CAMERA.cx_px) / CAMERA.fx_px))
    assert truth["free_column"]["bearing_deg"] == pytest.approx(expected_deg, abs=0.01)
    assert truth["deep_region"]["bbox"] == [120, 0, 150, 120]
    assert truth["valid_frac"] == 1.0


def test_poses_are_free_and_steps_as_long_as_asked_for() -> None:
    world = load_world("room")
    obstacles = Obstacles.of(world)
    start = (world.start.north_m, world.start.east_m, -world.start.height_m)
    motion = DrawnMotion()
    rng = np.random.default_rng(3)
    sideways = 0
    places = []
    for _ in range(60):
        poses = draw_sequence(obstacles, start, rng, frames=3, motion=motion)
        assert poses is not None
        for earlier, later in itertools.pairwise(poses):
            moved = np.array([later.north_m - earlier.north_m, later.east_m - earlier.east_m])
            assert motion.step_m[0] <= np.hypot(*moved) <= motion.step_m[1]
            track = math.atan2(moved[1], moved[0]) - heading_rad(earlier.q_ned_from_body)
            sideways += abs(math.remainder(track, math.tau)) > math.radians(24.0)
        for pose in poses:
            place = (pose.north_m, pose.east_m, pose.down_m)
            assert obstacles.clearance_m(place) > 0.0
            # Inside the room: a wall is hit in every direction.
            assert obstacles.free_distances_m(place, np.linspace(-3, 3, 24), limit_m=90.0).max() < 90.0
        places.append((poses[0].north_m, poses[0].east_m))
    assert 6 <= sideways <= 36  # of 120 steps; 15 % are expected
    assert np.ptp(places, axis=0).min() > 2.0


def test_where_there_is_no_room_no_poses_come() -> None:
    cell = World(
        name="cell",
        start=Start(north_m=0.0, east_m=0.0),
        goal=Goal(north_m=0.0, east_m=0.1),
        walls=tuple(
            Wall(from_m=a, to_m=b)
            for a, b in [
                ((-0.5, -0.5), (0.5, -0.5)),
                ((0.5, -0.5), (0.5, 0.5)),
                ((0.5, 0.5), (-0.5, 0.5)),
                ((-0.5, 0.5), (-0.5, -0.5)),
            ]
        ),
    )
    assert draw_sequence(Obstacles.of(cell), (0.0, 0.0, -1.2), np.random.default_rng(0)) is None


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("pairs") / "set"
    assert list(make_pairs(SMALL, folder)) == [2, 3]
    return folder


def test_the_evaluation_reads_what_was_made(made: Path) -> None:
    image_set = load_truth(made / "groundtruth.json")
    assert len(image_set.pairs) == 3
    truth = json.loads((made / "groundtruth.json").read_text())
    assert len(truth["frames"]) == 5
    for name, frame in truth["frames"].items():
        assert cv2.imread(str(made / name), cv2.IMREAD_UNCHANGED).shape == (240, 320)
        assert len(frame["depth"]["column_profile_m"]) == len(frame["free_distance_profile_m"]) == 18
        assert frame["wall_ahead"] == (frame["best_free_distance_m"] < 3.0)
        # No way through what is seen: the disc is stopped before, or beside, the nearest thing of a column.
        assert max(frame["free_distance_profile_m"]) <= frame["best_free_distance_m"] + 1e-3


def test_every_pixel_of_a_pair_is_found_again_by_depth_and_poses(made: Path) -> None:
    truth = json.loads((made / "groundtruth.json").read_text())
    k = np.array(truth["K"])
    for pair in truth["pairs"]:
        first, second = (truth["frames"][pair[key]] for key in ("a", "b"))
        image_a, image_b = (
            cv2.imread(str(made / pair[key]), cv2.IMREAD_GRAYSCALE).astype(np.float32) for key in ("a", "b")
        )
        depth = cv2.imread(str(made / first["depth_file"]), cv2.IMREAD_UNCHANGED) / 1e3
        x, y = np.meshgrid(np.arange(320.0), np.arange(240.0))
        rays = np.stack([(x - k[0, 2]) / k[0, 0], (y - k[1, 2]) / k[1, 1], np.ones_like(x)], axis=-1)
        a, b = np.array(first["pose"]), np.array(second["pose"])
        world = (rays * depth[..., None]) @ a[:3, :3].T + a[:3, 3]
        in_b = (world - b[:3, 3]) @ b[:3, :3]
        u = (in_b[..., 0] / in_b[..., 2] * k[0, 0] + k[0, 2]).astype(np.float32)
        v = (in_b[..., 1] / in_b[..., 2] * k[1, 1] + k[1, 2]).astype(np.float32)
        seen = (u > 1) & (u < 318) & (v > 1) & (v < 238) & (in_b[..., 2] > 0.1)
        found = cv2.remap(image_b, u, v, cv2.INTER_LINEAR)
        off = np.abs(found - image_a)[seen]
        still = np.abs(image_b - image_a)[seen]
        assert np.median(off) < 3.0
        assert off.mean() < 0.6 * still.mean()
        # Flow without the rotation runs away from the focus of expansion.
        if "foe" not in pair:
            continue
        derotated = in_b @ b[:3, :3].T @ a[:3, :3]
        flow = np.stack(
            [
                derotated[..., 0] / derotated[..., 2] * k[0, 0] + k[0, 2] - x,
                derotated[..., 1] / derotated[..., 2] * k[1, 1] + k[1, 2] - y,
            ],
            axis=-1,
        )
        out = np.stack([x - pair["foe"][0], y - pair["foe"][1]], axis=-1)
        cosine = (flow * out).sum(axis=-1) / (
            np.linalg.norm(flow, axis=-1) * np.linalg.norm(out, axis=-1) + 1e-9
        )
        assert np.median(cosine) > 0.999


def test_the_image_turned_back_has_no_rotation_left(made: Path) -> None:
    truth = json.loads((made / "groundtruth.json").read_text())
    for pair in truth["pairs"]:
        a, b, derotated = (
            cv2.imread(str(made / pair[key]), cv2.IMREAD_GRAYSCALE).astype(np.float64)
            for key in ("a", "b", "b_derot")
        )
        focus = pair.get("foe", [160.0, 120.0])
        if not (60 < focus[0] < 260 and 60 < focus[1] < 180) or pair["rot_deg"] < 1.0:
            continue
        # Around the focus of expansion nothing moves but by rotation.
        x, y = round(focus[0]), round(focus[1])
        window = np.s_[y - 30 : y + 30, x - 40 : x + 40]
        assert np.abs(derotated[window] - a[window]).mean() < np.abs(b[window] - a[window]).mean()


def test_the_same_seed_makes_the_same_files(made: Path, tmp_path: Path) -> None:
    again = tmp_path / "set"
    list(make_pairs(SMALL, again))
    files = sorted(path.relative_to(made) for path in made.rglob("*.*"))
    assert files == sorted(path.relative_to(again) for path in again.rglob("*.*"))
    for file in files:
        assert (made / file).read_bytes() == (again / file).read_bytes()


def test_the_truth_of_a_frame_before_a_wall() -> None:
    world = World(
        name="wall",
        start=Start(north_m=0.0, east_m=0.0),
        goal=Goal(north_m=1.0, east_m=0.0),
        walls=(Wall(from_m=(2.5, -30.0), to_m=(2.5, 30.0), thickness_m=0.2),),
    )
    pose = Pose(0, 0.0, 0.0, -1.2, (1.0, 0.0, 0.0, 0.0))
    truth = frame_truth(plane_depth(0.0, 2.4), CAMERA, pose, Obstacles.of(world), np.random.default_rng(0))
    # 2.4 m to the wall less the radius of 0.35 m, further at an angle.
    assert min(truth["free_distance_profile_m"]) == pytest.approx(2.05, abs=0.01)
    assert truth["best_free_distance_m"] == pytest.approx(2.05 / math.cos(math.radians(37.5)), rel=0.01)
    assert truth["wall_ahead"]
    assert truth["single_plane"]
    np.testing.assert_allclose(np.array(truth["pose"])[:3, :3], FORWARD)


def test_the_truth_of_a_pair() -> None:
    r0 = r_from_euler(0.0, 0.0, 0.3) @ FORWARD
    r1 = r_from_euler(0.0, 0.0, 0.3 + math.radians(2.0)) @ FORWARD
    ahead = pair_truth((np.zeros(3), r0), (0.2 * r0[:, 2], r1), CAMERA)
    assert ahead["trans"] == pytest.approx(0.2)
    assert ahead["rot_deg"] == pytest.approx(2.0, abs=1e-3)
    np.testing.assert_allclose(ahead["foe"], (CAMERA.cx_px, CAMERA.cy_px), atol=0.01)
    backwards = pair_truth((np.zeros(3), r0), (-0.2 * r0[:, 2], r0), CAMERA)
    assert "foe" not in backwards


def parsed(*words: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    add_pairs_parser(parser.add_subparsers())
    return parser.parse_args(["pairs", *words])


def test_the_command_makes_a_folder(tmp_path: Path) -> None:
    arguments = parsed("--n", "1", "-o", str(tmp_path / "new"), "--size", "160x120", "--worlds", "corridor")
    assert arguments.command(arguments) == 0
    assert len(load_truth(tmp_path / "new" / "groundtruth.json").pairs) == 1
    with pytest.raises(PairsError, match="an empty or a new folder"):
        arguments.command(arguments)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--n", "0"), "pairs: found 0"),
        (("--frames", "1"), "frames: found 1"),
        (("--hfov", "500"), "hfov_deg"),
        (("--worlds", "attic"), "attic"),
        (("--size", "8x8"), "width_px"),
    ],
)
def test_what_cannot_be_made_is_one_clear_line(tmp_path: Path, words: tuple[str, ...], message: str) -> None:
    arguments = parsed("-o", str(tmp_path / "new"), *words)
    with pytest.raises(CompanionError, match=message) as raised:
        arguments.command(arguments)
    assert "\n" not in str(raised.value)

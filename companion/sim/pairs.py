"""``companion sim pairs``: rendered pairs of frames with everything about them known, for ``detector evaluate``."""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Literal, cast, get_args

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track

from companion.errors import CompanionError
from companion.guidance.coordinates import heading_rad, r_body_from_camera, r_ned_from_body
from companion.guidance.observation import Pose
from companion.sim.depth_truth import COLUMNS, depth_truth, is_single_plane
from companion.sim.flight_arguments import image_size
from companion.sim.image_effects import CameraMotion, ImageEffects
from companion.sim.pair_poses import DrawnMotion, draw_sequence
from companion.sim.panda_camera import PandaCamera
from companion.sim.sensor_camera import photograph
from companion.sim.world.clearance import VEHICLE_RADIUS_M, Obstacles
from companion.sim.world.file import load_world
from companion.sim.world.model import World
from companion.sim.world.random import Difficulty, random_world
from detector.camera_model import CameraError, CameraModel

WALL_LIMIT_M: Final = 3.0
"""With less than this free in every direction in view there is a wall ahead."""
RANDOM: Final = "random"
_IMAGES, _DEROTATED, _DEPTHS = "images", "derot", "depth"
_BEARING_STEP_RAD: Final = math.radians(1.0)
_DEPTH_LIMIT_M: Final = 65.0
_FORWARD: Final = r_body_from_camera(0.0, 0.0, 0.0)


class PairsError(CompanionError):
    """Pairs cannot be made as they were asked for."""


@dataclass(frozen=True, slots=True)
class PairsSpec:
    """Which pairs to make. The same specification gives the same files.

    Attributes
    ----------
    pairs
        How many.
    worlds
        Names of built-in worlds, world files, or ``random``; taken in turn.
    difficulty
        Of random worlds.
    seed
        Of everything that is drawn.
    width_px, height_px, hfov_deg
        Of the camera.
    frames
        In a row; each is a pair with the one before it.
    pairs_a_world
        Then the next world is drawn.
    motion
        How far apart frames lie.
    effects
        What the camera does to a picture.
    derotated
        Also write each later frame turned back into the orientation of the earlier one.
    depth
        Also write depth images (uint16, mm).
    """

    pairs: int = 200
    worlds: tuple[str, ...] = (RANDOM,)
    difficulty: Difficulty = "medium"
    seed: int = 0
    width_px: int = 640
    height_px: int = 480
    hfov_deg: float = 75.0
    frames: int = 2
    pairs_a_world: int = 8
    motion: DrawnMotion = field(default_factory=DrawnMotion)
    effects: ImageEffects = field(default_factory=ImageEffects)
    derotated: bool = False
    depth: bool = False

    def __post_init__(self) -> None:
        limits = {
            "pairs": (1, 100_000),
            "seed": (0, 2**32 - 1),
            "frames": (2, 50),
            "pairs_a_world": (1, 10_000),
        }
        for name, (least, most) in limits.items():
            value = getattr(self, name)
            if not least <= value <= most:
                raise PairsError(f"{name}: found {value}; allowed: {least} to {most}")
        if not self.worlds:
            raise PairsError("worlds: found none; allowed: names of worlds, world files, or random")

    @property
    def camera(self) -> CameraModel:
        """The camera.

        Raises
        ------
        PairsError
            When there is no such camera.
        """
        try:
            return CameraModel.from_hfov(self.width_px, self.height_px, self.hfov_deg)
        except CameraError as error:
            raise PairsError(str(error)) from error


def make_pairs(spec: PairsSpec, folder: Path) -> Iterator[int]:
    """Make the pairs, and yield how many there are after each sequence; ``groundtruth.json`` is written last.

    Raises
    ------
    companion.errors.CompanionError
        When a world cannot be used, has no room, or a file cannot be written.
    """
    camera = spec.camera
    rng = np.random.default_rng([spec.seed, 0])
    truth: dict[str, Any] = {
        "name": folder.resolve().name,
        "image_size": [camera.width_px, camera.height_px],
        "K": camera.matrix.tolist(),
        "pose_convention": "T_cam_to_world 4x4, camera x right y down z forward, world local NED, metres",
        "depth": "along the optical axis, m",
        "frames": {},
        "pairs": [],
    }
    number = 0
    for world in _worlds(spec):
        obstacles = Obstacles.of(world)
        start = (world.start.north_m, world.start.east_m, -world.start.height_m)
        with PandaCamera(world) as eye:
            in_world = 0
            while in_world < spec.pairs_a_world and len(truth["pairs"]) < spec.pairs:
                poses = draw_sequence(obstacles, start, rng, frames=spec.frames, motion=spec.motion)
                if poses is None:
                    raise PairsError(f"{world.name}: no room for {spec.frames} frames in a row")
                poses = poses[: spec.pairs - len(truth["pairs"]) + 1]
                _add_sequence(truth, spec, world, obstacles, eye, poses, folder, number, rng)
                number += 1
                in_world += len(poses) - 1
                yield len(truth["pairs"])
        if len(truth["pairs"]) >= spec.pairs:
            break
    _write(folder / "groundtruth.json", json.dumps(truth, indent=1).encode())


def _worlds(spec: PairsSpec) -> Iterator[World]:
    """Give the worlds in turn, for ever; each ``random`` is a new one."""
    drawn = 0
    while True:
        for name in spec.worlds:
            if name == RANDOM:
                yield random_world((spec.seed * 100_003 + drawn) % 2**32, spec.difficulty)
                drawn += 1
            else:
                yield load_world(name)


def _add_sequence(
    truth: dict[str, Any],
    spec: PairsSpec,
    world: World,
    obstacles: Obstacles,
    eye: PandaCamera,
    poses: Sequence[Pose],
    folder: Path,
    number: int,
    rng: np.random.Generator,
) -> None:
    """Render one sequence, and add its frames and pairs to the truth."""
    camera = spec.camera
    placed = [_camera_pose(pose) for pose in poses]
    time_s = (poses[1].time_ns - poses[0].time_ns) / 1e9
    names, images = [], []
    for index, (pose, (position, rotation)) in enumerate(zip(poses, placed, strict=True)):
        # The first frame moves as the second one did.
        motion = CameraMotion.between(placed[max(0, index - 1)], placed[max(1, index)], time_s)
        image = photograph(eye, camera, position, rotation, motion, spec.effects, rng)
        name = f"{_IMAGES}/{number:05d}_{index}.png"
        _write_image(folder / name, image)
        depth_m = eye.depth(camera, position, rotation)
        entry = frame_truth(depth_m, camera, pose, obstacles, rng)
        entry["world"] = world.name
        if spec.depth:
            entry["depth_file"] = f"{_DEPTHS}/{number:05d}_{index}.png"
            _write_image(folder / entry["depth_file"], _millimetres(depth_m))
        truth["frames"][name] = entry
        names.append(name)
        images.append(image)
    for index in range(1, len(poses)):
        pair = pair_truth(placed[index - 1], placed[index], camera)
        pair |= {"a": names[index - 1], "b": names[index]}
        if spec.derotated:
            pair["b_derot"] = f"{_DEROTATED}/{number:05d}_{index}_to_{index - 1}.png"
            turned = turned_back(images[index], placed[index - 1][1], placed[index][1], camera)
            _write_image(folder / pair["b_derot"], turned)
        truth["pairs"].append(pair)


def frame_truth(
    depth_m: NDArray[np.float32],
    camera: CameraModel,
    pose: Pose,
    obstacles: Obstacles,
    rng: np.random.Generator,
) -> dict[str, Any]:
    """Return what is known about a frame; plain values.

    Parameters
    ----------
    depth_m
        (height, width) along the optical axis.
    camera
        Which looks along the body's forward axis.
    pose
        Of the vehicle.
    obstacles
        Of the world: free distances are those of the vehicle's disc, swept level through them.
    rng
        For the search for a plane.
    """
    position, rotation = _camera_pose(pose)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, position
    half_rad = 0.5 * camera.hfov_rad
    place = (pose.north_m, pose.east_m, pose.down_m)
    heading = heading_rad(pose.q_ned_from_body)
    x_px = (np.arange(COLUMNS) + 0.5) * camera.width_px / COLUMNS - 0.5
    columns = np.arctan((x_px - camera.cx_px) / camera.fx_px)
    fine = np.linspace(-half_rad, half_rad, 1 + 2 * round(half_rad / _BEARING_STEP_RAD))
    bearings = np.concatenate([columns, fine])
    free_m = obstacles.free_distances_m(place, heading + bearings)
    depth = depth_truth(depth_m, camera, rng)
    best_m = float(free_m.max())
    return {
        "pose": matrix.round(6).tolist(),
        "depth": depth,
        "single_plane": is_single_plane(depth),
        "best_free_distance_m": round(best_m, 3),
        "best_free_bearing_deg": round(math.degrees(float(bearings[free_m.argmax()])), 1),
        "free_distance_profile_m": free_m[:COLUMNS].round(3).tolist(),
        "vehicle_radius_m": VEHICLE_RADIUS_M,
        "wall_ahead": best_m < WALL_LIMIT_M,
    }


_Placed = tuple[NDArray[np.float64], NDArray[np.float64]]


def pair_truth(earlier: _Placed, later: _Placed, camera: CameraModel) -> dict[str, Any]:
    """Return what is known about a pair from its two camera poses, each a position (3,) and r_ned_from_camera (3, 3)."""
    (p0, r0), (p1, r1) = earlier, later
    translation = r0.T @ (p1 - p0)
    turn = cv2.Rodrigues(r1.T @ r0)[0].ravel()
    truth: dict[str, Any] = {
        "trans": round(float(np.linalg.norm(translation)), 4),
        "rot_deg": round(math.degrees(float(np.linalg.norm(turn))), 4),
        "t_dir": (translation / np.linalg.norm(translation)).round(6).tolist(),
    }
    focus = camera.ray_to_pixel([translation])[0]
    if np.isfinite(focus).all():
        truth["foe"] = focus.round(2).tolist()
    return truth


def turned_back(
    image: NDArray[np.uint8],
    r_ned_from_earlier: NDArray[np.float64],
    r_ned_from_later: NDArray[np.float64],
    camera: CameraModel,
) -> NDArray[np.uint8]:
    """Return the later image as it would be in the orientation of the earlier one; black where it does not reach."""
    k = camera.matrix
    homography = k @ r_ned_from_earlier.T @ r_ned_from_later @ np.linalg.inv(k)
    size = (camera.width_px, camera.height_px)
    return np.asarray(cv2.warpPerspective(image, homography, size, flags=cv2.INTER_LINEAR), dtype=np.uint8)


def _camera_pose(pose: Pose) -> _Placed:
    position = np.array([pose.north_m, pose.east_m, pose.down_m])
    return position, r_ned_from_body(pose.q_ned_from_body) @ _FORWARD


def _millimetres(depth_m: NDArray[np.float32]) -> NDArray[np.uint16]:
    known = np.isfinite(depth_m) & (depth_m < _DEPTH_LIMIT_M)
    return np.asarray(np.where(known, np.rint(1e3 * np.where(known, depth_m, 0.0)), 0.0), dtype=np.uint16)


def _write_image(path: Path, image: NDArray[Any]) -> None:
    done, data = cv2.imencode(path.suffix, image)
    if not done:
        raise PairsError(f"{path}: the image cannot be encoded")
    _write(path, data.tobytes())


def _write(path: Path, data: bytes) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
    except OSError as error:
        raise PairsError(f"{path}: cannot be written: {error.strerror}") from error


_DESCRIPTION = """\
Render pairs of frames in simulated worlds, with groundtruth.json beside them: poses, depth, planes, focus of expansion,
and how far the vehicle could really fly. `detector evaluate DIR` judges the detector by it."""


def add_pairs_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``pairs`` to the sub-commands of ``companion sim``."""
    default = PairsSpec()
    parser = commands.add_parser(
        "pairs", help="frame pairs with truth", description=_DESCRIPTION, allow_abbrev=False
    )
    parser.add_argument(
        "--n", type=int, default=default.pairs, dest="pairs", help="pairs (default: %(default)s)"
    )
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="DIR", help="an empty or new folder"
    )
    parser.add_argument("--seed", type=int, default=default.seed, metavar="N", help="default: %(default)s")
    parser.add_argument(
        "--size",
        type=image_size,
        default=(default.width_px, default.height_px),
        metavar="WxH",
        help=f"of the images in pixels (default: {default.width_px}x{default.height_px})",
    )
    parser.add_argument(
        "--hfov",
        type=float,
        default=default.hfov_deg,
        metavar="DEG",
        help="of the camera (default: %(default)g)",
    )
    parser.add_argument(
        "--worlds",
        nargs="+",
        default=list(default.worlds),
        metavar="NAME|FILE|random",
        help="default: random",
    )
    parser.add_argument(
        "--difficulty",
        choices=get_args(Difficulty),
        default=default.difficulty,
        help="of random worlds (default: %(default)s)",
    )
    parser.add_argument(
        "--frames", type=int, default=default.frames, metavar="N", help="in a row (default: %(default)s)"
    )
    parser.add_argument("--derotated", action="store_true", help="also write the later frames turned back")
    parser.add_argument("--depth", action="store_true", help="also write depth images (uint16, mm)")
    parser.set_defaults(command=_make)


def _make(arguments: argparse.Namespace) -> int:
    folder: Path = arguments.output
    width_px, height_px = arguments.size
    spec = PairsSpec(
        pairs=arguments.pairs,
        worlds=tuple(arguments.worlds),
        difficulty=cast(Literal["easy", "medium", "hard"], arguments.difficulty),
        seed=arguments.seed,
        width_px=width_px,
        height_px=height_px,
        hfov_deg=arguments.hfov,
        frames=arguments.frames,
        derotated=arguments.derotated,
        depth=arguments.depth,
    )
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise PairsError(f"{folder}: found something there; allowed: an empty or a new folder")
    console = Console(stderr=True)
    made = make_pairs(spec, folder)
    for _ in track(
        made, "pairs", total=None, console=console, transient=True, disable=not console.is_terminal
    ):
        pass
    console.print(f"{spec.pairs} pairs in {folder}; judge with: detector evaluate {folder}")
    return 0

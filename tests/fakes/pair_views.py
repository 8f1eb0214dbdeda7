"""Pairs of views of ray-cast scenes, in which every distance and motion is known."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from companion.guidance.coordinates import r_body_from_camera, r_from_euler
from companion.sim.scene import Scene, corridor, empty_room, room_with_wall, square_wall
from detector.camera_model import CameraModel

CAMERA = CameraModel.from_hfov(320, 240, 75.0)
START_M = np.array([0.0, 0.2, -1.3])


@dataclass(frozen=True)
class View:
    """Two frames, and how the camera moved between them."""

    earlier: NDArray[np.uint8]
    later: NDArray[np.uint8]
    camera: CameraModel
    later_from_earlier: NDArray[np.float64]
    translation_earlier_m: NDArray[np.float64]
    translation_later_m: NDArray[np.float64]
    level_from_later: NDArray[np.float64]
    depth_m: NDArray[np.float32]


def attitude(roll_deg: float = 0.0, pitch_deg: float = 0.0, yaw_deg: float = 0.0) -> NDArray[np.float64]:
    euler = math.radians(roll_deg), math.radians(pitch_deg), math.radians(yaw_deg)
    return r_from_euler(*euler) @ r_body_from_camera(0.0, 0.0, 0.0)


def rotation_deg(*vector_deg: float) -> NDArray[np.float64]:
    from detector.rotation import rotation_matrix

    return rotation_matrix(np.radians(np.array(vector_deg)))


def noisy(image: NDArray[np.uint8], seed: int, sigma: float = 2.0) -> NDArray[np.uint8]:
    noise = np.random.default_rng(seed).normal(0.0, sigma, image.shape)
    return np.clip(image + noise, 0, 255).astype(np.uint8)


def view(
    scene: Scene,
    *,
    step_m: tuple[float, float, float] = (0.25, 0.0, 0.0),
    turn_deg: tuple[float, float, float] = (0.0, 0.0, 0.0),
    start_m: NDArray[np.float64] = START_M,
    camera: CameraModel = CAMERA,
) -> View:
    """A step (north, east, down) with a turn (roll, pitch, yaw) on the way."""
    step, before, after = np.array(step_m), attitude(), attitude(*turn_deg)
    end_m = start_m + step
    return View(
        noisy(scene.render(camera, start_m, before), 1),
        noisy(scene.render(camera, end_m, after), 2),
        camera,
        after.T @ before,
        before.T @ step,
        after.T @ step,
        after,
        scene.depth(camera, end_m, after),
    )


@cache
def corridor_view(turn_deg: tuple[float, float, float] = (2.0, -1.5, 3.0)) -> View:
    return view(corridor(seed=4), turn_deg=turn_deg)


@cache
def wall_view(distance_m: float = 2.0, angle_deg: float = 0.0) -> View:
    """A textured wall that fills the view, this far from the later camera."""
    return view(square_wall(distance_m + 0.25, angle_deg, seed=3), start_m=np.array([0.0, 0.0, -1.3]))


@cache
def room_view() -> View:
    """A room with a partition 4 m ahead and an opening on its right."""
    return view(room_with_wall(wall_north_m=4.0, seed=2), start_m=np.array([0.0, 0.0, -1.3]))


@cache
def large_room_view() -> View:
    return view(empty_room(seed=5), turn_deg=(0.0, 0.0, 2.0))

"""The void map's rules on true depth of rendered worlds: how right they are when nothing is measured wrongly."""

from __future__ import annotations

import math

import numpy as np

from companion.guidance.coordinates import heading_rad, r_body_from_camera, r_ned_from_body
from companion.sim.pair_poses import DrawnMotion, draw_sequence
from companion.sim.pairs import frame_truth
from companion.sim.panda_camera import PandaCamera
from companion.sim.world.clearance import Obstacles
from companion.sim.world.random import random_world
from detector.camera_model import CameraModel
from detector.parallax.samples import RangedSamples
from detector.parallax.void_map import VoidMapParams, choose_gap, void_map

_CAMERA = CameraModel.from_hfov(320, 240, 75.0)
_STEP_PX = 4


def test_with_true_depth_the_direction_is_right_nearly_always() -> None:
    columns, rows = np.meshgrid(np.arange(2, 320, _STEP_PX), np.arange(2, 240, _STEP_PX))
    pixels = np.column_stack([columns.ravel(), rows.ravel()]).astype(np.float64)
    rays = _CAMERA.pixel_to_ray(pixels)
    bearings = np.arctan(((np.arange(18) + 0.5) * 320 / 18 - 0.5 - _CAMERA.cx_px) / _CAMERA.fx_px)
    rng = np.random.default_rng(5)
    right = []
    for seed in range(5):
        world = random_world(300 + seed, "medium")
        obstacles = Obstacles.of(world)
        start = (world.start.north_m, world.start.east_m, -world.start.height_m)
        with PandaCamera(world) as eye:
            poses = draw_sequence(obstacles, start, rng, frames=4, motion=DrawnMotion())
            assert poses is not None
            for pose in poses:
                rotation = r_ned_from_body(pose.q_ned_from_body) @ r_body_from_camera(0.0, 0.0, 0.0)
                position = np.array([pose.north_m, pose.east_m, pose.down_m])
                depth_m = eye.depth(_CAMERA, position, rotation)
                truth = frame_truth(depth_m, _CAMERA, pose, obstacles, rng)
                if truth["wall_ahead"]:
                    continue
                range_m = depth_m[rows, columns].ravel() / rays[:, 2]
                samples = RangedSamples(
                    rays @ rotation.T,
                    np.where(np.isfinite(range_m), 1.0 / range_m, 0.0),
                    np.full(len(rays), 0.005),
                    pixels,
                    True,
                    np.ones(len(rays), np.bool_),
                )
                gap = choose_gap(void_map(samples, VoidMapParams()), VoidMapParams())
                assert gap is not None
                off = (gap.azimuth_rad - heading_rad(pose.q_ned_from_body) + math.pi) % math.tau - math.pi
                profile = np.array(truth["free_distance_profile_m"])
                right.append(float(np.interp(off, bearings, profile)) >= 0.9 * profile.max())
    assert len(right) >= 10
    assert np.mean(right) >= 0.75, f"{sum(right)} of {len(right)}"

from __future__ import annotations

import math
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from companion.guidance.coordinates import r_body_from_camera
from companion.sim.scene import corridor, empty_room, room_with_wall, square_wall
from detector.camera_model import CameraModel
from detector.clusters import seeded_starts
from detector.params import DetectorParams, PresetName
from detector.pipeline import VoidDetector
from detector.results import Direction, NoDetection, SinglePlane
from tests.reference.pairs import approach, window
from tests.reference.paper import Answer, Kept, settings_of, void_of_pair

DATA = Path(__file__).parents[1] / "data" / "pairs"
CAMERA = CameraModel.from_hfov(480, 320, 80.0)
STEP_M = 0.3
LOOKING_NORTH = r_body_from_camera(0.0, 0.0, 0.0)

REAL = {
    "office 68": ("office/00068.jpg", "office/00069.jpg"),
    "office 184": ("office/00184.jpg", "office/00185.jpg"),
    "office 189": ("office/00189.jpg", "office/00190.jpg"),
    "office 193": ("office/00193.jpg", "office/00194.jpg"),
    "office 297": ("office/00297.jpg", "office/00298.jpg"),
    "bricks 1": ("brickwall/001.jpg", "brickwall/003.jpg"),
    "bricks 33": ("brickwall/033.jpg", "brickwall/035.jpg"),
    "bricks 61": ("brickwall/061.jpg", "brickwall/063.jpg"),
}
RENDERED = {
    "corridor": (corridor, {"seed": 4}, -1.3),
    "narrow corridor": (corridor, {"width_m": 1.8, "seed": 8}, -1.3),
    "room": (empty_room, {"seed": 2}, -1.3),
    "room with a wall": (room_with_wall, {"wall_north_m": 3.0, "seed": 3}, -1.3),
    "square wall": (square_wall, {"distance_m": 3.0, "seed": 5}, 0.0),
}
MADE = {"approach": approach, "window": window}
NAMES = (*REAL, *RENDERED, *MADE)


@cache
def pair_of(name: str) -> tuple[np.ndarray, np.ndarray]:
    if name in REAL:
        earlier, later = (cv2.imread(str(DATA / file), cv2.IMREAD_GRAYSCALE) for file in REAL[name])
        return earlier, later
    if name in MADE:
        return MADE[name]()
    make, arguments, down_m = RENDERED[name]
    scene = make(**arguments)
    first, second = (scene.render(CAMERA, (north_m, 0.0, down_m), LOOKING_NORTH) for north_m in (0.0, STEP_M))
    return first, second


def params_of(preset: PresetName) -> DetectorParams:
    """Return a preset with what the oracle has no word for taken out."""
    return DetectorParams.preset(
        preset,
        plane_test="deviation_px" if preset == "paper" else "deviation_ratio",
        lines_wanted=0,
        rotation_check=False,
        depth_cue="flow",
        blur_limit=1.0,
        speed="exact",
        # The paper's, in both: so that the pairs reach every end of the method.
        sift_contrast=0.04,
        min_features=100,
        min_flow_vectors=100,
        kmeans_restarts=2 if preset == "paper" else 1,
    )


@cache
def oracle_of(name: str, preset: PresetName) -> Answer:
    params = params_of(preset)
    starts = seeded_starts(params.seed, params.kmeans_restarts)
    return void_of_pair(*pair_of(name), starts, settings_of(params))


def kind_of(detection: Direction | SinglePlane | NoDetection) -> str:
    if isinstance(detection, Direction):
        return detection.kind.value
    return "single_plane" if isinstance(detection, SinglePlane) else detection.reason.value


@pytest.mark.parametrize("preset", ["paper", "default"])
@pytest.mark.parametrize("name", NAMES)
def test_the_detector_and_the_oracle_agree_step_by_step(name: str, preset: PresetName) -> None:
    oracle = oracle_of(name, preset)
    params = params_of(preset)
    detector = VoidDetector(params, starts=seeded_starts(params.seed, params.kmeans_restarts))
    found = detector.detect(*pair_of(name)).detection
    seen = found.diagnostics

    assert kind_of(found) == oracle.kind
    assert seen.n_tracks == oracle.n_tracks
    assert seen.n_after_distribution == oracle.n_after_distribution
    assert seen.n_after_length == oracle.n_after_length
    assert seen.n_after_angle == oracle.n_after_angle
    assert (seen.p, seen.n, seen.k) == (oracle.p, oracle.n, oracle.k)
    assert sorted(seen.centre_magnitudes_px) == pytest.approx(sorted(oracle.centre_magnitudes_px), abs=1e-6)
    assert seen.lmcc_px == (None if oracle.lmcc_px is None else pytest.approx(oracle.lmcc_px, abs=1e-3))
    assert seen.n_lines == oracle.n_lines
    assert sorted(seen.candidates_px) == sorted(oracle.candidates_px)
    if isinstance(found, Direction):
        assert math.dist((found.x_px, found.y_px), (oracle.x_px, oracle.y_px)) < 1e-3


@pytest.mark.parametrize(
    ("first", "other"), [("corridor", "narrow corridor"), ("narrow corridor", "window"), ("window", "room")]
)
def test_the_other_loops_agree_too_with_p_n_and_k_of_the_first(first: str, other: str) -> None:
    params = params_of("default")
    starts = seeded_starts(params.seed, params.kmeans_restarts)
    detector = VoidDetector(params, starts=starts)
    before = detector.detect(*pair_of(first)).detection.diagnostics
    kept = Kept(before.p, before.n, before.k)
    oracle = void_of_pair(*pair_of(other), starts, settings_of(params), kept)
    found = detector.detect(*pair_of(other)).detection
    seen = found.diagnostics

    assert kept != (
        oracle_of(other, "default").p,
        oracle_of(other, "default").n,
        oracle_of(other, "default").k,
    )
    assert (seen.p, seen.n, seen.k) == (oracle.p, oracle.n, oracle.k) == kept
    assert kind_of(found) == oracle.kind
    assert seen.n_after_angle == oracle.n_after_angle
    assert sorted(seen.centre_magnitudes_px) == pytest.approx(sorted(oracle.centre_magnitudes_px), abs=1e-6)
    if isinstance(found, Direction):
        assert math.dist((found.x_px, found.y_px), (oracle.x_px, oracle.y_px)) < 1e-3


def test_the_pairs_reach_every_end_of_the_method() -> None:
    kinds = {oracle_of(name, preset).kind for name in NAMES for preset in ("paper", "default")}
    assert kinds >= {
        "vanishing_point",
        "lowest_flow",
        "single_plane",
        "too_little_flow",
        "too_few_features_earlier",
    }

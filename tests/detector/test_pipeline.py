"""The steps joined: every way to end without an answer, what is kept between calls, and rotations taken out."""

from __future__ import annotations

import dataclasses
import itertools
import math
from functools import cache

import cv2
import numpy as np
import pytest

from companion.guidance.coordinates import r_body_from_camera, r_from_euler
from companion.sim.scene import Scene, corridor, square_wall
from detector.camera_model import CameraModel
from detector.params import DetectorParams, PresetName
from detector.pipeline import VoidDetector
from detector.results import Detection, Direction, NoDetection, NoDetectionReason, SinglePlane

CAMERA = CameraModel.from_hfov(480, 320, 80.0)
LEVEL = r_body_from_camera(0.0, 0.0, 0.0)
STEP_M = 0.3
PAPER = DetectorParams.preset("paper")
DEFAULT = DetectorParams.preset("default")


@cache
def long_corridor() -> Scene:
    return corridor(seed=4)


def turned(yaw_deg: float, pitch_deg: float = 0.0, roll_deg: float = 0.0) -> np.ndarray:
    return r_from_euler(math.radians(roll_deg), math.radians(pitch_deg), math.radians(yaw_deg)) @ LEVEL


@cache
def corridor_frame(
    north_m: float, attitude_deg: tuple[float, float, float] = (0.0, 0.0, 0.0), noise_seed: int | None = None
) -> np.ndarray:
    image = long_corridor().render(CAMERA, (north_m, 0.0, -1.3), turned(*attitude_deg))
    if noise_seed is not None:
        noise = np.random.default_rng(noise_seed).normal(0.0, 2.0, image.shape)
        image = np.clip(image + noise, 0, 255).astype(np.uint8)
    image.flags.writeable = False
    return image


@cache
def wall_frame(north_m: float) -> np.ndarray:
    return square_wall(3.0, seed=5).render(CAMERA, (north_m, 0.0, 0.0), LEVEL)


def dots(rows: int, columns: int, shape: tuple[int, int] = (320, 480)) -> np.ndarray:
    """Return so many bright spots of different sizes on grey: about as many key points."""
    rng = np.random.default_rng(0)
    image = np.full(shape, 70, np.uint8)
    for row, column in itertools.product(range(rows), range(columns)):
        at = (round((column + 0.5) * shape[1] / columns), round((row + 0.5) * shape[0] / rows))
        cv2.circle(image, at, int(rng.integers(3, 6)), int(rng.integers(150, 250)), cv2.FILLED)
    return image


def without_times(found: Detection) -> Detection:
    return dataclasses.replace(found, diagnostics=dataclasses.replace(found.diagnostics, seconds={}))


def refused(
    earlier: np.ndarray, later: np.ndarray, params: DetectorParams = PAPER, camera: CameraModel | None = None
) -> NoDetection:
    found = VoidDetector(params).detect(earlier, later, camera=camera).detection
    assert isinstance(found, NoDetection)
    assert found.detail
    return found


# ---------------------------------------------------------------------- answers


def test_a_corridor_gives_a_direction_inside_the_image_and_a_wall_a_single_plane() -> None:
    found = VoidDetector(PAPER).detect(corridor_frame(0.0), corridor_frame(STEP_M)).detection
    assert isinstance(found, Direction)
    assert 0 <= found.x_px < 480
    assert 0 <= found.y_px < 320
    assert found.diagnostics.n_lines > 0
    assert set(found.diagnostics.seconds) == {
        "frames",
        "features",
        "flow",
        "contact",
        "clusters",
        "lines",
        "vote",
    }
    wall = VoidDetector(PAPER).detect(wall_frame(0.0), wall_frame(STEP_M)).detection
    assert isinstance(wall, SinglePlane)
    assert wall.time_to_contact is not None
    assert wall.time_to_contact.frames == pytest.approx((3.0 - STEP_M) / STEP_M, rel=0.1)
    assert wall.diagnostics.n_lines == 0  # nobody looked


def test_the_lmcc_is_the_centre_of_least_magnitude() -> None:
    seen = VoidDetector(PAPER).detect(corridor_frame(0.0), corridor_frame(STEP_M)).detection.diagnostics
    lowest = seen.centre_magnitudes_px.index(min(seen.centre_magnitudes_px))
    assert seen.lmcc_px == seen.centre_points_px[lowest]
    assert seen.lmcc_magnitude_px == min(seen.centre_magnitudes_px)
    assert len(seen.centre_points_px) == len(seen.centre_magnitudes_px) == seen.n


def test_the_literal_threshold_is_scaled_by_the_width_and_the_ratio_is_not() -> None:
    pair = corridor_frame(0.0), corridor_frame(STEP_M)
    literal = VoidDetector(PAPER).detect(*pair).detection.diagnostics
    assert literal.plane_threshold == pytest.approx(8.73 * 480 / 1280)
    assert literal.plane_statistic == pytest.approx(np.std(literal.centre_magnitudes_px))
    ratio = VoidDetector(DetectorParams.preset("paper", plane_test="deviation_ratio", plane_ratio=0.3))
    seen = ratio.detect(*pair).detection.diagnostics
    assert seen.plane_threshold == 0.3
    assert seen.plane_statistic == pytest.approx(
        np.std(seen.centre_magnitudes_px) / np.median(seen.centre_magnitudes_px)
    )


# ---------------------------------------------------------------------- reasons


def test_two_sizes_are_refused() -> None:
    found = refused(corridor_frame(0.0), corridor_frame(STEP_M)[:-2])
    assert found.reason is NoDetectionReason.WRONG_SIZE
    assert "480 x 320 px and 480 x 318 px" in found.detail


def test_another_size_than_the_camera_models_is_refused() -> None:
    other = CameraModel.from_hfov(320, 480, 80.0)
    found = refused(corridor_frame(0.0), corridor_frame(STEP_M), camera=other)
    assert found.reason is NoDetectionReason.WRONG_SIZE
    assert "320 x 480" in found.detail


@pytest.mark.parametrize("shape", [(1, 1), (1, 480), (320, 1), (47, 64), (48, 63)])
@pytest.mark.parametrize("params", [PAPER, DEFAULT], ids=["paper", "default"])
def test_images_too_small_to_judge_are_refused(shape: tuple[int, int], params: DetectorParams) -> None:
    image = np.random.default_rng(0).integers(0, 255, shape, dtype=np.uint8)
    assert refused(image, image, params).reason is NoDetectionReason.WRONG_SIZE


@pytest.mark.parametrize("which", ["earlier", "later"])
@pytest.mark.parametrize(
    ("grey", "reason"), [(3, NoDetectionReason.BLACK), (255, NoDetectionReason.SATURATED)]
)
def test_either_frame_black_or_saturated(which: str, grey: int, reason: NoDetectionReason) -> None:
    good, bad = corridor_frame(0.0), np.full((320, 480), grey, np.uint8)
    found = refused(*((bad, good) if which == "earlier" else (good, bad)))
    assert found.reason is reason
    assert found.detail.startswith(which)


@pytest.mark.parametrize("params", [PAPER, DEFAULT], ids=["paper", "default"])
def test_a_blurred_frame_is_refused(params: DetectorParams) -> None:
    blurred = cv2.blur(corridor_frame(STEP_M), (31, 1))
    assert refused(corridor_frame(0.0), blurred, params).reason is NoDetectionReason.BLURRED


def test_too_few_features_in_either_frame_tell_which() -> None:
    many, few = dots(12, 16), dots(3, 4)
    found = refused(few, many)
    assert found.reason is NoDetectionReason.TOO_FEW_FEATURES_EARLIER
    assert 0 < found.diagnostics.n_features_earlier < 100
    found = refused(many, few)
    assert found.reason is NoDetectionReason.TOO_FEW_FEATURES_LATER
    assert found.diagnostics.n_features_earlier >= 100 > found.diagnostics.n_features_later > 0


def test_as_many_features_as_needed_are_enough() -> None:
    earlier, later = dots(12, 16), np.roll(dots(12, 16), 8, axis=1)
    seen = VoidDetector(PAPER).detect(earlier, later).detection.diagnostics
    exact = min(seen.n_features_earlier, seen.n_features_later)
    enough = DetectorParams.preset("paper", min_features=exact)
    found = VoidDetector(enough).detect(earlier, later).detection
    assert found.diagnostics.n_tracks > 0
    one_more = DetectorParams.preset("paper", min_features=exact + 1)
    assert refused(earlier, later, one_more).diagnostics.n_tracks == 0


def test_frames_of_two_places_leave_too_little_flow() -> None:
    rng = np.random.default_rng(1)
    earlier, later = (
        cv2.GaussianBlur(rng.integers(0, 255, (320, 480), dtype=np.uint8), (0, 0), 1.6) for _ in range(2)
    )
    found = refused(earlier, later, DetectorParams.preset("paper", round_trip_px=0.001))
    assert found.reason is NoDetectionReason.TOO_LITTLE_FLOW
    assert found.diagnostics.n_after_distribution < 10 < found.diagnostics.n_tracks


def test_fewer_vectors_than_asked_for_are_too_little_flow() -> None:
    pair = corridor_frame(0.0), corridor_frame(STEP_M)
    left = VoidDetector(PAPER).detect(*pair).detection.diagnostics.n_after_angle
    enough = VoidDetector(DetectorParams.preset("paper", min_flow_vectors=left)).detect(*pair)
    assert isinstance(enough.detection, Direction)
    found = refused(*pair, DetectorParams.preset("paper", min_flow_vectors=left + 1))
    assert found.reason is NoDetectionReason.TOO_LITTLE_FLOW
    assert found.diagnostics.n_after_angle == left


@pytest.mark.parametrize("params", [PAPER, DEFAULT], ids=["paper", "default"])
def test_a_standing_camera_is_neither_a_wall_nor_a_direction(params: DetectorParams) -> None:
    found = refused(corridor_frame(0.0, noise_seed=1), corridor_frame(0.0, noise_seed=2), params)
    assert found.reason is NoDetectionReason.NO_MOTION
    assert found.diagnostics.median_flow_px is not None
    assert found.diagnostics.median_flow_px < 0.5


@pytest.mark.parametrize("attitude_deg", [(4.0, 0.0, 0.0), (0.0, 3.0, 0.0), (3.0, -2.0, 4.0)])
@pytest.mark.parametrize("camera", [CAMERA, None], ids=["camera known", "no camera known"])
def test_a_turn_alone_is_no_motion_however_large_its_flow(
    attitude_deg: tuple[float, float, float], camera: CameraModel | None
) -> None:
    later = corridor_frame(0.0, attitude_deg)
    found = refused(corridor_frame(0.0), later, DEFAULT, camera)
    assert found.reason is NoDetectionReason.NO_MOTION
    assert found.diagnostics.median_flow_px is not None
    assert found.diagnostics.median_flow_px > 5.0


def test_the_reasons_end_the_pair_before_anything_is_remembered() -> None:
    detector = VoidDetector(PAPER)
    detector.detect(corridor_frame(0.0), corridor_frame(0.0))
    fresh = VoidDetector(PAPER).detect(corridor_frame(0.0), corridor_frame(STEP_M)).detection
    after = detector.detect(corridor_frame(0.0), corridor_frame(STEP_M)).detection
    assert without_times(after) == without_times(fresh)


# ---------------------------------------------------------------------- bad input


@pytest.mark.parametrize(
    "bad",
    [
        np.zeros((320, 480), np.float32),
        np.zeros((320, 480), np.uint16),
        np.zeros((320, 480), np.bool_),
        np.zeros((320, 480, 3), np.uint8),
        np.zeros((320, 480, 1), np.uint8),
        np.zeros(480, np.uint8),
    ],
    ids=lambda image: f"{image.shape} {image.dtype}",
)
@pytest.mark.parametrize("which", ["earlier", "later"])
def test_what_is_no_grey_image_is_an_error_that_says_what_was_given(bad: np.ndarray, which: str) -> None:
    good = corridor_frame(0.0)
    pair = (bad, good) if which == "earlier" else (good, bad)
    with pytest.raises(ValueError, match=rf"{which}: expected \(H, W\) uint8, got .*{bad.dtype}"):
        VoidDetector(PAPER).detect(*pair)


def test_a_rotation_or_translation_without_a_camera_is_an_error() -> None:
    pair = corridor_frame(0.0), corridor_frame(STEP_M)
    with pytest.raises(ValueError, match="needs a camera model"):
        VoidDetector(PAPER).detect(*pair, later_from_earlier=np.eye(3))
    with pytest.raises(ValueError, match="needs a camera model"):
        VoidDetector(PAPER).detect(*pair, translation_earlier=np.array([0.0, 0.0, 1.0]))


def test_a_read_only_view_of_a_larger_image_will_do() -> None:
    frames = [np.pad(corridor_frame(north_m), 7)[7:-7, 7:-7] for north_m in (0.0, STEP_M)]
    for frame in frames:
        frame.flags.writeable = False
    plain = VoidDetector(PAPER).detect(corridor_frame(0.0), corridor_frame(STEP_M)).detection
    assert without_times(VoidDetector(PAPER).detect(*frames).detection) == without_times(plain)


# ---------------------------------------------------------------------- memory


@pytest.mark.parametrize("preset", ["paper", "default"])
def test_same_input_and_seed_same_answer_other_seed_other_starts(preset: PresetName) -> None:
    pair = corridor_frame(0.0), corridor_frame(STEP_M)
    first, second = (VoidDetector(DetectorParams.preset(preset)).detect(*pair) for _ in range(2))
    assert without_times(first.detection) == without_times(second.detection)
    np.testing.assert_array_equal(first.tracks.end_px, second.tracks.end_px)
    seen = [
        VoidDetector(DetectorParams.preset(preset, seed=seed, kmeans_restarts=1))
        .detect(*pair)
        .detection.diagnostics.centre_points_px
        for seed in range(2)
    ]
    assert len(set(seen)) > 1


def test_p_n_and_k_are_kept_until_reset() -> None:
    def chosen(found: Detection) -> tuple[int | None, int | None, int | None]:
        return found.diagnostics.p, found.diagnostics.n, found.diagnostics.k

    params = DetectorParams.preset(
        "paper", angle_gain=0.02, kmeans_restarts=1, speed="exact"
    )  # of this gain the two differ in p
    first_pair = corridor_frame(0.0), corridor_frame(STEP_M)
    other_pair = wall_frame(0.0), wall_frame(STEP_M)
    of_other = VoidDetector(params).detect(*other_pair).detection
    detector = VoidDetector(params)
    of_first = detector.detect(*first_pair).detection
    assert None not in chosen(of_first)
    assert all(a != b for a, b in zip(chosen(of_first), chosen(of_other), strict=True))

    kept = detector.detect(*other_pair).detection
    assert chosen(kept) == chosen(of_first)
    assert len(kept.diagnostics.centre_points_px) == of_first.diagnostics.n
    detector.reset()
    assert without_times(detector.detect(*other_pair).detection) == without_times(of_other)


@pytest.mark.parametrize("preset", ["paper", "default"])
def test_renewing_between_two_frames_saves_the_next_pair_the_work_and_changes_no_answer(
    preset: PresetName,
) -> None:
    images = [corridor_frame(i * STEP_M) for i in range(4)]

    def answers(between: bool) -> list[Detection]:
        detector = VoidDetector(DetectorParams.preset(preset, fast_first_points=400, fast_points=300))
        earlier, found = detector.prepare(images[0]), []
        for image in images[1:]:
            later = detector.prepare(image)
            found.append(detector.detect(earlier, later).detection)
            assert later.seeds_px is None
            if between:
                detector.renew(later)
                assert later.seeds_px is not None
            earlier = later
        return found

    found = answers(between=True)
    assert any(not isinstance(one, NoDetection) for one in found)
    assert [without_times(one) for one in found] == [without_times(one) for one in answers(between=False)]


# ---------------------------------------------------------------------- rotation

TURN_DEG = (3.0, -2.0, 2.5)


@pytest.mark.parametrize("preset", ["paper", "default"])
def test_a_known_turn_leaves_the_flow_of_the_straight_flight(preset: PresetName) -> None:
    earlier, later = corridor_frame(0.0), corridor_frame(STEP_M, TURN_DEG)
    rotation = turned(*TURN_DEG).T @ turned(0.0)
    pair = VoidDetector(DetectorParams.preset(preset)).detect(
        earlier, later, camera=CAMERA, later_from_earlier=rotation
    )
    tracks = pair.tracks
    # Where each end's point of the scene stood in a camera of the same attitude, one step back: exact, from the depth.
    depth_m = long_corridor().depth(CAMERA, (STEP_M, 0.0, -1.3), turned(*TURN_DEG))
    column, row = np.rint(tracks.end_px).astype(int).T
    column, row = np.clip(column, 0, 479), np.clip(row, 0, 319)
    rays = CAMERA.pixel_to_ray(tracks.end_px)
    points = rays / rays[:, 2:] * depth_m[row, column][:, None]
    step = turned(*TURN_DEG).T @ np.array([STEP_M, 0.0, 0.0])
    truth = CAMERA.ray_to_pixel(points + step)
    error_px = np.linalg.norm(tracks.start_px - truth, axis=1)
    assert len(tracks) > 300
    # The same as without a turn: 0.28 px; Lucas-Kanade is that good on these textures.
    assert np.median(error_px) < 0.4
    assert np.percentile(error_px, 80) < 0.8
    assert np.abs(np.median(tracks.start_px - truth, axis=0)).max() < 0.05


@pytest.mark.parametrize("scene", ["corridor", "wall"])
def test_a_known_turn_does_not_change_the_answer(scene: str) -> None:
    params = DetectorParams.preset("paper", kmeans_restarts=4)
    world = long_corridor() if scene == "corridor" else square_wall(3.0, seed=5)
    down_m = -1.3 if scene == "corridor" else 0.0

    def answer(attitude_deg: tuple[float, float, float]) -> tuple[Detection, np.ndarray]:
        earlier = world.render(CAMERA, (0.0, 0.0, down_m), turned(0.0))
        later = world.render(CAMERA, (STEP_M, 0.0, down_m), turned(*attitude_deg))
        rotation = turned(*attitude_deg).T @ turned(0.0)
        found = VoidDetector(params).detect(earlier, later, camera=CAMERA, later_from_earlier=rotation)
        at = found.detection.diagnostics.lmcc_px
        assert at is not None
        return found.detection, turned(*attitude_deg) @ CAMERA.pixel_to_ray(np.array([at]))[0]

    straight, bearing = answer((0.0, 0.0, 0.0))
    derotated, bearing_after = answer((2.0, 0.0, 0.0))
    assert type(derotated) is type(straight)
    assert type(straight) is (Direction if scene == "corridor" else SinglePlane)
    if isinstance(straight, Direction) and isinstance(derotated, Direction):
        assert derotated.kind is straight.kind
        assert math.degrees(math.acos(min(1.0, float(bearing @ bearing_after)))) < 6.0
    a, b = straight.diagnostics.median_flow_px, derotated.diagnostics.median_flow_px
    assert a is not None
    assert b == pytest.approx(a, rel=0.1)


def test_an_identity_rotation_changes_nothing() -> None:
    pair = corridor_frame(0.0), corridor_frame(STEP_M)
    without = VoidDetector(PAPER).detect(*pair, camera=CAMERA).detection
    given = VoidDetector(PAPER).detect(*pair, camera=CAMERA, later_from_earlier=np.eye(3)).detection
    assert given.diagnostics.n_after_angle == without.diagnostics.n_after_angle
    assert given.diagnostics.lmcc_px == pytest.approx(without.diagnostics.lmcc_px, abs=1e-6)


def test_a_turn_that_is_told_of_is_taken_for_no_motion_where_nothing_else_moved() -> None:
    later = corridor_frame(0.0, TURN_DEG)
    found = (
        VoidDetector(DEFAULT)
        .detect(
            corridor_frame(0.0), later, camera=CAMERA, later_from_earlier=turned(*TURN_DEG).T @ turned(0.0)
        )
        .detection
    )
    assert isinstance(found, NoDetection)
    assert found.reason is NoDetectionReason.NO_MOTION
    assert found.diagnostics.median_flow_px is not None
    assert found.diagnostics.median_flow_px < 0.5

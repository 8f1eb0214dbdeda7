from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
import pytest

from companion.guidance.coordinates import r_body_from_camera, r_from_euler
from companion.sim.scene import Scene, room_with_wall
from detector.camera_model import CameraModel
from detector.flow import Tracks, derotate, distribution_filter, track
from detector.frame import Frame
from detector.observer import CameraPose, ObserverParams, VoidObserver
from detector.params import DetectorParams
from detector.results import Diagnostics, NoDetection, NoDetectionReason, SinglePlane

CAMERA = CameraModel.from_hfov(320, 240, 80.0)
PARAMS = DetectorParams.preset("default")
SECOND_NS = 1_000_000_000


@dataclass(frozen=True)
class _Result:
    detection: Any
    tracks: Tracks


@dataclass
class _Tracker:
    """Stands in for the detector: follows corners, always answers "single plane", and notes what it was given."""

    calls: list[dict[str, Any]] = field(default_factory=list)
    resets: int = 0
    reason: NoDetectionReason | None = None

    def detect(self, earlier_frame: Frame, later_frame: Frame, **given: Any) -> _Result:
        earlier, later = earlier_frame.image, later_frame.image
        self.calls.append({"earlier": earlier, "later": later, **given})
        start = cv2.goodFeaturesToTrack(earlier, 500, 0.005, 4).reshape(-1, 2)
        rotation, camera = given["later_from_earlier"], given["camera"]
        guess = None if rotation is None else derotate(start, camera, rotation)
        there, found = track(earlier, later, start, guess_px=guess)
        back, returned = track(later, earlier, there, guess_px=start)
        kept = found & returned & distribution_filter(start, back)
        start = start if guess is None else guess
        tracks = Tracks(start[kept].astype(float), there[kept].astype(float))
        if self.reason is not None:
            return _Result(NoDetection(self.reason, "", Diagnostics()), tracks)
        return _Result(SinglePlane(None, Diagnostics()), tracks)

    def reset(self) -> None:
        self.resets += 1


@pytest.fixture(scope="module")
def scene() -> Scene:
    return room_with_wall(seed=4)


def _pose(
    north_m: float, east_m: float = 0.0, yaw_deg: float = 0.0, pitch_deg: float = 0.0, roll_deg: float = 0.0
) -> CameraPose:
    attitude = r_from_euler(math.radians(roll_deg), math.radians(pitch_deg), math.radians(yaw_deg))
    return CameraPose(attitude @ r_body_from_camera(0, 0, 0), np.array([north_m, east_m, -1.3]))


def _view(scene: Scene, pose: CameraPose, camera: CameraModel = CAMERA) -> np.ndarray:
    return scene.render(camera, pose.position_m, pose.world_from_camera)


def _observer(**changes: Any) -> tuple[VoidObserver, _Tracker]:
    tracker = _Tracker()
    return VoidObserver(PARAMS, CAMERA, observer_params=ObserverParams(**changes), detector=tracker), tracker


def _reason(observation: Any) -> NoDetectionReason | None:
    return observation.detection.reason if isinstance(observation.detection, NoDetection) else None


def test_the_partner_is_chosen_by_distance_flown(scene: Scene) -> None:
    observer, tracker = _observer()
    answers = [
        observer.observe(_view(scene, _pose(0.04 * i)), i * SECOND_NS // 25, _pose(0.04 * i))
        for i in range(16)
    ]
    assert _reason(answers[0]) is NoDetectionReason.NO_EARLIER_FRAME
    assert _reason(answers[1]) is NoDetectionReason.NO_MOTION
    assert "moved 0.040 m" in answers[1].detection.detail
    assert [answer.earlier_time_ns is not None for answer in answers[:4]] == [False, False, False, True]
    for answer in answers[7:]:
        assert answer.baseline_m == pytest.approx(0.25, abs=0.021)
        assert (answer.time_ns - answer.earlier_time_ns) / SECOND_NS == pytest.approx(0.25, abs=0.03)
    np.testing.assert_allclose(
        tracker.calls[-1]["translation_earlier"], (0, 0, answers[-1].baseline_m), atol=1e-9
    )
    np.testing.assert_allclose(tracker.calls[-1]["later_from_earlier"], np.eye(3), atol=1e-12)


def test_slow_flight_is_still_paired(scene: Scene) -> None:
    observer, _ = _observer()
    step_m = 0.1 / 30  # 0.1 m/s at 30 frames/s
    for i in range(90):
        answer = observer.observe(_view(scene, _pose(0)), i * SECOND_NS // 30, _pose(step_m * i))
    assert answer.baseline_m == pytest.approx(0.25, abs=0.03)


def test_rotation_and_translation_are_given_in_the_stated_axes(scene: Scene) -> None:
    observer, tracker = _observer()
    earlier, later = _pose(0.0, 0.0, yaw_deg=10.0, pitch_deg=2.0), _pose(0.2, 0.1, yaw_deg=14.0, roll_deg=3.0)
    observer.observe(_view(scene, earlier), 0, earlier)
    observer.observe(_view(scene, later), SECOND_NS // 4, later)
    call = tracker.calls[-1]
    point = np.array([4.0, 0.5, -1.0])
    in_earlier = earlier.world_from_camera.T @ (point - earlier.position_m)
    in_later = later.world_from_camera.T @ (point - later.position_m)
    np.testing.assert_allclose(
        call["later_from_earlier"] @ (in_earlier - call["translation_earlier"]), in_later, atol=1e-12
    )


def test_of_two_baselines_the_one_with_less_turn(scene: Scene) -> None:
    observer, _ = _observer()
    for i, pose in enumerate((_pose(0.0, yaw_deg=0.0), _pose(0.03, yaw_deg=15.0), _pose(0.27, yaw_deg=0.0))):
        answer = observer.observe(_view(scene, pose), i * SECOND_NS // 4, pose)
    assert answer.earlier_time_ns == 0


def test_a_turn_or_a_jump_leaves_no_partner(scene: Scene) -> None:
    for other in (_pose(0.3, yaw_deg=60.0), _pose(2.0)):
        observer, tracker = _observer()
        observer.observe(_view(scene, _pose(0)), 0, _pose(0))
        answer = observer.observe(_view(scene, other), SECOND_NS // 2, other)
        assert _reason(answer) is NoDetectionReason.NO_EARLIER_FRAME
        assert not tracker.calls


def test_a_minute_of_hover_is_no_motion_and_memory_stays_bounded(scene: Scene) -> None:
    observer, tracker = _observer()
    image = _view(scene, _pose(0))
    for i in range(600):
        wobble = 0.01 * math.sin(i)
        answer = observer.observe(image, i * SECOND_NS // 10, _pose(wobble))
        assert i == 0 or _reason(answer) is NoDetectionReason.NO_MOTION
        assert len(observer._kept) <= ObserverParams().max_frames
    assert len(observer._kept) < 10
    assert not tracker.calls
    moved = observer.observe(_view(scene, _pose(0.2)), 60 * SECOND_NS, _pose(0.2))
    assert moved.baseline_m == pytest.approx(0.2, abs=0.02)


def test_frames_of_long_ago_are_no_partners(scene: Scene) -> None:
    observer, _ = _observer()
    observer.observe(_view(scene, _pose(0)), 0, _pose(0))
    answer = observer.observe(_view(scene, _pose(0.25)), 5 * SECOND_NS, _pose(0.25))
    assert _reason(answer) is NoDetectionReason.NO_EARLIER_FRAME


@pytest.mark.parametrize("width_px", [320, 640])
def test_without_poses_the_partner_is_chosen_by_flow(scene: Scene, width_px: int) -> None:
    camera = CAMERA.scaled_to(width_px, width_px * 3 // 4)
    observer = VoidObserver(PARAMS, None, detector=(tracker := _Tracker()))
    times = {}
    for i in range(14):
        answer = observer.observe(_view(scene, _pose(0.05 * i), camera), (i + 1) * SECOND_NS // 10)
        times[(i + 1) * SECOND_NS // 10] = 0.05 * i
    assert _reason(answer) is None
    assert answer.earlier_time_ns is not None
    flown_m = 0.05 * 13 - times[answer.earlier_time_ns]
    # 1.5 % of the width at half a unit of radius and 4 m of depth is roughly 0.25 m.
    assert 0.1 <= flown_m <= 0.5
    assert tracker.calls[-1]["later_from_earlier"] is None
    assert answer.baseline_m is None
    assert answer.range_along((0, 0, 1)) is None


def test_without_poses_a_still_camera_is_no_motion(scene: Scene) -> None:
    observer = VoidObserver(PARAMS, CAMERA, detector=(tracker := _Tracker()))
    rng = np.random.default_rng(0)
    image = _view(scene, _pose(0)).astype(float)
    for i in range(6):
        noisy = np.clip(image + rng.normal(0, 2, image.shape), 0, 255).astype(np.uint8)
        answer = observer.observe(noisy, i * SECOND_NS // 5)
    assert _reason(answer) is NoDetectionReason.NO_MOTION
    assert not tracker.calls


def test_without_poses_another_scene_is_no_partner(scene: Scene) -> None:
    observer = VoidObserver(PARAMS, CAMERA, detector=_Tracker())
    observer.observe(_view(scene, _pose(0)), 0)
    answer = observer.observe(_view(scene, _pose(0, yaw_deg=150)), SECOND_NS // 5)
    assert _reason(answer) is NoDetectionReason.NO_EARLIER_FRAME


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (lambda image: cv2.blur(image, (25, 1)), NoDetectionReason.BLURRED),
        (np.zeros_like, NoDetectionReason.BLACK),
        (lambda image: np.full_like(image, 255), NoDetectionReason.SATURATED),
    ],
)
def test_a_bad_frame_is_named_and_never_a_partner(
    scene: Scene, spoil: Any, reason: NoDetectionReason
) -> None:
    observer, _ = _observer()
    observer.observe(_view(scene, _pose(0)), 0, _pose(0))
    bad = observer.observe(spoil(_view(scene, _pose(0.1))), 100, _pose(0.1))
    assert _reason(bad) is reason
    after = observer.observe(_view(scene, _pose(0.35)), 200, _pose(0.35))
    assert after.earlier_time_ns == 0  # 0.25 m from the bad one would have been better


def test_another_size_starts_anew(scene: Scene) -> None:
    observer, tracker = _observer()
    observer.observe(_view(scene, _pose(0)), 0, _pose(0))
    double = CAMERA.scaled_to(640, 480)
    changed = observer.observe(_view(scene, _pose(0.25), double), 100, _pose(0.25))
    assert _reason(changed) is NoDetectionReason.WRONG_SIZE
    after = observer.observe(_view(scene, _pose(0.5), double), 200, _pose(0.5))
    assert after.earlier_time_ns == 100
    assert tracker.calls[-1]["camera"] == double
    cut = observer.observe(np.ascontiguousarray(_view(scene, _pose(0.7), double)[:300]), 300, _pose(0.7))
    assert _reason(cut) is NoDetectionReason.WRONG_SIZE
    assert "640 x 300" in cut.detection.detail


def test_misuse_is_named() -> None:
    observer, _ = _observer()
    with pytest.raises(ValueError, match="uint8"):
        observer.observe(np.zeros((240, 320, 3), np.uint8), 0)
    with pytest.raises(ValueError, match="expected"):
        CameraPose(np.eye(4), np.zeros(3))
    with pytest.raises(ValueError, match="baseline_min_m"):
        ObserverParams(baseline_min_m=0.3)
    with pytest.raises(ValueError, match="flow_min"):
        ObserverParams(flow_min=0.3)
    with pytest.raises(ValueError, match="max_frames"):
        ObserverParams(max_frames=1)


def test_a_recording_that_starts_over_begins_anew(scene: Scene) -> None:
    observer, _ = _observer()
    observer.observe(_view(scene, _pose(0)), SECOND_NS, _pose(0))
    again = observer.observe(_view(scene, _pose(0.25)), SECOND_NS // 2, _pose(0.25))
    assert _reason(again) is NoDetectionReason.NO_EARLIER_FRAME


def test_reset_forgets_all(scene: Scene) -> None:
    observer, tracker = _observer()
    observer.observe(_view(scene, _pose(0)), 0, _pose(0))
    before = tracker.resets
    observer.reset()
    assert tracker.resets == before + 1
    answer = observer.observe(_view(scene, _pose(0.25)), 100, _pose(0.25))
    assert _reason(answer) is NoDetectionReason.NO_EARLIER_FRAME


def test_the_detector_learns_anew_when_the_scene_changes(scene: Scene) -> None:
    def resets_after(poses: list[CameraPose], step_ns: int, reason: NoDetectionReason | None = None) -> int:
        observer, tracker = _observer()
        tracker.reason = reason
        for i, pose in enumerate(poses):
            observer.observe(_view(scene, pose), i * step_ns, pose)
        return tracker.resets

    straight = [_pose(0.2 * i) for i in range(8)]
    assert resets_after(straight, SECOND_NS // 5) == 0
    assert resets_after([_pose(0.05 * i, yaw_deg=5.0 * i) for i in range(10)], SECOND_NS // 5) == 1
    assert resets_after([_pose(0.3 * i) for i in range(12)], SECOND_NS // 5) == 1
    assert resets_after(straight, 3 * SECOND_NS) == 7
    assert resets_after(straight[:2], SECOND_NS // 5, NoDetectionReason.TOO_LITTLE_FLOW) == 1


@pytest.mark.parametrize(
    ("earlier", "later"),
    [
        (_pose(1.0), _pose(1.25)),
        (_pose(1.0), _pose(1.25, yaw_deg=4.0, pitch_deg=-2.0, roll_deg=2.0)),
        (_pose(1.0, 0.0), _pose(1.1, 0.22)),
        (_pose(2.5, -1.0), _pose(2.75, -1.0, yaw_deg=-3.0)),
    ],
    ids=["straight", "turning", "sideways", "near"],
)
def test_ranges_are_those_of_the_scene(scene: Scene, earlier: CameraPose, later: CameraPose) -> None:
    observer, _ = _observer()
    observer.observe(_view(scene, earlier), 0, earlier)
    answer = observer.observe(_view(scene, later), SECOND_NS // 4, later)
    known, errors, too_far = 0, [], []
    for azimuth_deg in range(-30, 31, 5):
        azimuth = math.radians(azimuth_deg)
        towards = np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
        side = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
        true_m, bare_m = (
            min(
                scene.range_along(later.position_m + offset * side, towards)
                for offset in np.linspace(-half_width_m, half_width_m, 15)
            )
            for half_width_m in (0.35, 0.2)
        )
        found = answer.range_along(later.world_from_camera.T @ towards)
        if found is None:
            continue
        known += 1
        errors.append(found.distance_m / true_m - 1.0)
        too_far.append(found.distance_m / bare_m - 1.0)
    assert known >= 8
    # Short is allowed: what stands just beside the way may reach into it where nothing farther is seen between.
    assert np.median(np.abs(errors)) < 0.25
    # Too far is what hurts. A sliver of wall at the very edge of the margin may hold no three points.
    assert max(too_far) < 0.2


def test_an_error_of_the_attitude_does_not_reach_the_ranges(scene: Scene) -> None:
    observer, _ = _observer()
    earlier, later = _pose(1.0), _pose(1.25)
    observer.observe(_view(scene, earlier), 0, earlier)
    wrong = _pose(1.25, yaw_deg=0.3, pitch_deg=-0.2)
    answer = observer.observe(_view(scene, later), SECOND_NS // 4, wrong)
    for azimuth_deg in (-12, 12):
        found = answer.range_along(
            (math.sin(math.radians(azimuth_deg)), 0.0, math.cos(math.radians(azimuth_deg)))
        )
        assert found is not None
        assert found.distance_m == pytest.approx(3.8, rel=0.12)  # uncorrected: 5.1 and 2.2


def test_time_to_contact_and_focus(scene: Scene) -> None:
    observer, _ = _observer()
    earlier, later = _pose(1.0), _pose(1.25)
    observer.observe(_view(scene, earlier), 0, earlier)
    answer = observer.observe(_view(scene, later), SECOND_NS // 4, later)
    np.testing.assert_allclose(answer.focus_px, (159.5, 119.5), atol=1e-6)
    contact = answer.time_to_contact_along((0.1, 0.0, 1.0))
    assert contact is not None
    assert contact.frames == pytest.approx(3.75 / 0.25, rel=0.2)
    assert answer.time_to_contact_along((0.0, 0.0, -1.0)) is None
    assert answer.range_along((0.0, 1.0, 0.0)) is None  # straight down


def test_without_poses_the_focus_is_fitted(scene: Scene) -> None:
    observer = VoidObserver(PARAMS, CAMERA, detector=_Tracker())
    observer.observe(_view(scene, _pose(1.0)), 0)
    answer = observer.observe(_view(scene, _pose(1.3, 0.03)), SECOND_NS // 4)
    assert answer.focus_px is not None
    expected = (159.5 + CAMERA.fx_px * 0.1, 119.5)
    assert math.dist(answer.focus_px, expected) < 12.0
    contact = answer.time_to_contact_along((0.1, 0.05, 1.0))
    assert contact is not None
    assert contact.frames == pytest.approx(3.7 / 0.3, rel=0.25)

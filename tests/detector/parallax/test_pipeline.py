"""The method end to end on pairs: what it answers, and why it does not."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from companion.sim.scene import Rectangle, Scene, corridor
from detector.parallax.params import ParallaxParams
from detector.parallax.pipeline import Intrinsics, ParallaxDetector, ParallaxResult
from detector.results import (
    Direction,
    DirectionKind,
    NoDetection,
    NoDetectionReason,
    SinglePlane,
)
from tests.fakes.pair_views import CAMERA, View, corridor_view, noisy, room_view, view, wall_view


def answered(seen: View, *, told: str = "poses", **more: Any) -> ParallaxResult:
    given: dict[str, Any] = {"intrinsics": Intrinsics(seen.camera, "calibration")}
    if told != "nothing":
        given["later_from_earlier"] = seen.later_from_earlier
        given["level_from_later"] = seen.level_from_later
    if told == "poses":
        given["translation_earlier_m"] = seen.translation_earlier_m
    return ParallaxDetector().detect(seen.earlier, seen.later, **(given | more))


@pytest.mark.parametrize("told", ["poses", "rotation", "nothing"])
def test_the_end_of_a_corridor_is_the_gap(told: str) -> None:
    seen = corridor_view()
    result = answered(seen, told=told)
    detection = result.detection
    assert isinstance(detection, Direction)
    assert detection.kind is DirectionKind.GAP
    ray = seen.camera.pixel_to_ray([(detection.x_px, detection.y_px)])[0]
    north, east, _ = seen.level_from_later @ ray
    assert abs(math.degrees(math.atan2(east, north))) < 5.0  # the corridor runs north, from wherever in it
    motion = detection.diagnostics.motion
    assert motion is not None
    assert motion.rotation_source == ("flow" if told == "nothing" else "attitude_refined")
    assert motion.focus_sigma_px is not None
    assert result.geometry is not None
    assert result.geometry.samples.metric is (told == "poses")


@pytest.mark.parametrize("told", ["poses", "nothing"])
def test_a_wall_ahead_is_a_single_plane_with_its_time_to_contact(told: str) -> None:
    detection = answered(wall_view(2.0), told=told).detection
    assert isinstance(detection, SinglePlane)
    assert detection.time_to_contact is not None
    assert detection.time_to_contact.frames == pytest.approx(8.0, rel=0.1)


def test_a_far_wall_is_not_one_where_metres_are_known() -> None:
    detection = answered(wall_view(6.0)).detection
    assert not isinstance(detection, SinglePlane)


def test_the_opening_beside_a_partition_is_found() -> None:
    seen = room_view()
    detection = answered(seen).detection
    assert isinstance(detection, Direction)
    assert np.median(seen.depth_m[100:140, round(detection.x_px)]) > 5.0  # the partition stands 3.75 m ahead


@pytest.mark.parametrize("told", ["rotation", "nothing"])
def test_a_turn_on_the_spot_is_no_motion_and_no_wall(told: str) -> None:
    seen = view(corridor(seed=4), step_m=(0.0, 0.0, 0.0), turn_deg=(0.5, 1.0, 3.0))
    detection = answered(seen, told=told).detection
    assert isinstance(detection, NoDetection)
    assert detection.reason is NoDetectionReason.NO_MOTION


def test_a_plain_wall_is_too_little_texture() -> None:
    plain = np.full((240, 320), 120, np.uint8)
    seen = replace(wall_view(2.0), earlier=noisy(plain, 1), later=noisy(plain, 2))
    detector = ParallaxDetector(frame_params=_any_frame())
    detection = detector.detect(
        seen.earlier,
        seen.later,
        intrinsics=Intrinsics(CAMERA, "calibration"),
        later_from_earlier=seen.later_from_earlier,
        translation_earlier_m=seen.translation_earlier_m,
    ).detection
    assert isinstance(detection, NoDetection)
    assert detection.reason is NoDetectionReason.TOO_LITTLE_TEXTURE


def test_what_is_far_all_over_is_free_and_not_a_lack_of_motion() -> None:
    far = Scene((Rectangle((60.0, -80.0, 40.0), (0.0, 160.0, 0.0), (0.0, 0.0, -80.0), seed=1),))
    seen = view(far, start_m=np.array([0.0, 0.0, -1.3]))
    detection = answered(seen).detection
    assert isinstance(detection, Direction)
    # Without a pose nobody can tell how far, and it is no wall all the same.
    assert not isinstance(answered(seen, told="nothing").detection, SinglePlane)


def test_frames_that_cannot_be_used_say_why() -> None:
    seen = corridor_view()
    black = np.zeros_like(seen.later)
    detection = answered(replace(seen, later=black)).detection
    assert isinstance(detection, NoDetection)
    assert detection.reason is NoDetectionReason.BLACK
    small = answered(replace(seen, earlier=seen.earlier[:200])).detection
    assert isinstance(small, NoDetection)
    assert small.reason is NoDetectionReason.WRONG_SIZE


def test_a_translation_without_a_rotation_is_misuse() -> None:
    seen = corridor_view()
    with pytest.raises(ValueError, match="needs a rotation"):
        ParallaxDetector().detect(seen.earlier, seen.later, translation_earlier_m=np.array([0.0, 0.0, 1.0]))


def test_without_a_camera_a_field_of_view_is_assumed_and_said_so() -> None:
    seen = corridor_view()
    detection = ParallaxDetector().detect(seen.earlier, seen.later).detection
    assert detection.diagnostics.motion is not None
    assert detection.diagnostics.motion.intrinsics_source == "assumed"


def test_the_same_pair_gives_the_same_answer() -> None:
    first, second = (answered(corridor_view(), told="nothing").detection for _ in range(2))
    assert isinstance(first, Direction)
    assert isinstance(second, Direction)
    assert (first.x_px, first.y_px) == (second.x_px, second.y_px)


def _any_frame() -> Any:
    from detector.params import DetectorParams

    return DetectorParams.preset("default", blur_limit=1.0)


def test_params_are_frozen_and_refuse_what_they_do_not_know() -> None:
    with pytest.raises(ValueError, match="frozen"):
        ParallaxParams().step_px = 4  # type: ignore[misc]
    with pytest.raises(ValueError, match="extra"):
        ParallaxParams(step=4)  # type: ignore[call-arg]

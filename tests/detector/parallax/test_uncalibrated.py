"""Where nobody gave a camera, the answer says whether its focal length was estimated or assumed, and why."""

from __future__ import annotations

import math

import pytest

from companion.sim.scene import corridor
from detector.camera_model import CameraModel
from detector.parallax.params import ParallaxParams
from detector.parallax.stream import ParallaxObserver
from detector.parallax.uncalibrated import UncalibratedCamera
from detector.results import MotionEstimate
from tests.detector.parallax.test_focal import WRONG, fields
from tests.fakes.pair_views import attitude

PARAMS = ParallaxParams()


def motions(camera: CameraModel, frames: int, turn_deg: float) -> list[MotionEstimate]:
    """What is said of the motion, frame by frame, on a walk through a corridor by a camera that nobody describes."""
    observer, scene = ParallaxObserver(), corridor()
    found = []
    for index in range(frames):
        turned = attitude(0.0, 0.5 * turn_deg * math.sin(1.7 * index), turn_deg * math.sin(0.9 * index))
        image = scene.render(camera, (0.2 * index, 0.1 * math.sin(index), -1.3), turned)
        seen = observer.observe(image, 1_000_000_000 + 200_000_000 * index)
        if seen.detection.diagnostics.motion is not None:
            found.append(seen.detection.diagnostics.motion)
    return found


def test_a_walk_that_turns_ends_with_the_focal_length_of_its_camera() -> None:
    true = CameraModel.from_hfov(320, 240, 55.0)
    found = motions(true, PARAMS.focal_least_pairs + 3, 8.0)
    assert found[0].intrinsics_source == "assumed"
    assert "70 degrees" in found[0].intrinsics_detail
    assert found[-1].intrinsics_source == "estimated"
    share = float(found[-1].intrinsics_detail.split()[2])
    assert share == pytest.approx(true.fx_px / 320, rel=0.1)


def test_an_estimate_that_is_refused_leaves_the_assumed_view_and_says_why() -> None:
    camera = UncalibratedCamera(PARAMS)
    for field in fields(WRONG, 0.05):
        camera.learn(field)
    found = camera.intrinsics(320, 240)
    assert found is not None
    assert found.source == "assumed"
    assert "refused" in found.detail
    assert found.camera.fx_px == pytest.approx(CameraModel.from_hfov(320, 240, PARAMS.assumed_hfov_deg).fx_px)


def test_frames_of_another_size_are_another_camera() -> None:
    camera = UncalibratedCamera(PARAMS)
    for field in fields(CameraModel.from_hfov(320, 240, 55.0), 6.0):
        camera.learn(field)
    estimated, other = camera.intrinsics(320, 240), camera.intrinsics(640, 480)
    assert estimated is not None
    assert other is not None
    assert (estimated.source, other.source) == ("estimated", "assumed")
    assert camera.intrinsics(8, 8) is None

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from companion.guidance.coordinates import r_body_from_camera, r_from_euler
from companion.guidance.observation import Pose
from companion.sim.camera_feed import Renderer, render_at
from companion.sim.image_effects import CameraMotion, ImageEffects, exposed, sensed, sub_frames
from companion.sim.panda_camera import PandaCamera
from companion.sim.sensor_camera import SensorCamera
from companion.sim.world.model import Goal, Light, Start, Wall, World
from detector.camera_model import CameraModel

FORWARD = r_body_from_camera(0.0, 0.0, 0.0)
CAMERA = CameraModel.from_hfov(320, 240, 75.0)
WORLD = World(
    name="edge",
    start=Start(north_m=0.0, east_m=0.0),
    goal=Goal(north_m=2.0, east_m=0.0),
    floor_texture="plain:#000000",
    ceiling_texture="plain:#000000",
    light=Light(ambient=1.0),
    walls=(
        # White from the middle to the right, 4 m ahead; black behind it.
        Wall(from_m=(4.0, 0.0), to_m=(4.0, 8.0), thickness_m=0.02, texture="plain:#c8c8c8"),
        Wall(from_m=(4.1, -8.0), to_m=(4.1, 8.0), thickness_m=0.02, texture="plain:#000000"),
    ),
)
EYE = np.array([0.0, 0.0, -1.3])


@pytest.fixture(scope="module")
def ideal() -> Iterator[PandaCamera]:
    with PandaCamera(WORLD) as camera:
        yield camera


def edge(row: NDArray[np.float32] | NDArray[np.uint8]) -> tuple[float, float]:
    """Middle and width of the step from black to white along a row, px."""
    share = np.clip(row.astype(float) / row[-20:].mean(), 0.0, 1.0)
    slope = np.diff(share).clip(0.0)
    at = np.arange(len(slope)) + 0.5
    middle = float((slope * at).sum() / slope.sum())
    return middle, float(np.sqrt(12.0 * (slope * (at - middle) ** 2).sum() / slope.sum()))


def blurred(ideal: PandaCamera, motion: CameraMotion, exposure_s: float) -> NDArray[np.float32]:
    frames = sub_frames(motion.blur_px(CAMERA, exposure_s), exposure_s)
    return exposed(
        lambda p, r, frame: ideal.render(CAMERA, p, r, supersample=1, shift_px=frame.shift_px),
        EYE,
        FORWARD,
        motion,
        frames,
    )


def test_turning_smears_an_edge_by_as_much_as_it_moves(ideal: PandaCamera) -> None:
    rate, exposure_s = 1.5, 0.02
    picture = blurred(ideal, CameraMotion(rate_ned_rad_s=(0.0, 0.0, rate)), exposure_s)
    middle, width = edge(picture[120])
    sharp_middle, sharp_width = edge(ideal.render(CAMERA, EYE, FORWARD)[120])
    assert sharp_width < 2.0
    assert middle == pytest.approx(sharp_middle, abs=0.15)
    expected = np.hypot(rate * exposure_s * CAMERA.fx_px, sharp_width)
    assert width == pytest.approx(expected, rel=0.12)


def test_flying_sideways_smears_what_is_near(ideal: PandaCamera) -> None:
    speed, exposure_s = 4.0, 0.02
    motion = CameraMotion(velocity_ned_m_s=(0.0, speed, 0.0))
    middle, width = edge(blurred(ideal, motion, exposure_s)[120])
    sharp_middle, sharp_width = edge(ideal.render(CAMERA, EYE, FORWARD)[120])
    assert middle == pytest.approx(sharp_middle, abs=0.2)
    expected = np.hypot(speed * exposure_s / 4.0 * CAMERA.fx_px, sharp_width)
    assert width == pytest.approx(expected, rel=0.2)


def test_samples_beside_each_other_make_a_smooth_picture(ideal: PandaCamera) -> None:
    # A standing camera whose exposure is divided all the same: the picture of a sharp one, within a few grey values.
    frames = sub_frames(4.0, 0.01)
    picture = exposed(
        lambda p, r, frame: ideal.render(CAMERA, p, r, supersample=1, shift_px=frame.shift_px),
        EYE,
        r_from_euler(0.05, 0.0, 0.02) @ FORWARD,
        CameraMotion(),
        frames,
    )
    sharp = ideal.render(CAMERA, EYE, r_from_euler(0.05, 0.0, 0.02) @ FORWARD).astype(np.float64)
    shift_px, _ = cv2.phaseCorrelate(np.float64(picture), sharp)
    assert np.abs(picture - sharp).mean() < 0.4
    assert np.hypot(*shift_px) < 0.1


def test_a_shift_moves_the_samples_to_the_right_and_down(ideal: PandaCamera) -> None:
    still = edge(ideal.render(CAMERA, EYE, FORWARD)[120])[0]
    # Samples half a pixel further right see the edge half a pixel further left.
    moved = edge(ideal.render(CAMERA, EYE, FORWARD, shift_px=(0.5, 0.0))[120])[0]
    assert moved - still == pytest.approx(-0.5, abs=0.05)
    rolled = r_from_euler(np.pi / 2, 0.0, 0.0) @ FORWARD  # the edge now lies level
    still = edge(ideal.render(CAMERA, EYE, rolled)[:, 160][::-1])[0]
    moved = edge(ideal.render(CAMERA, EYE, rolled, shift_px=(0.0, 0.5))[:, 160][::-1])[0]
    assert moved - still == pytest.approx(0.5, abs=0.05)


def test_the_number_of_renderings_follows_the_blur() -> None:
    assert sub_frames(0.2, 0.01) == ()
    counts = [len(sub_frames(blur, 0.01)) for blur in (0.6, 4.0, 6.5, 100.0)]
    assert counts == [4, 4, 7, 12]
    for count_px in (4.0, 7.0):
        frames = sub_frames(count_px, 0.01)
        np.testing.assert_allclose(np.mean([f.time_s for f in frames]), 0.0, atol=1e-9)
        np.testing.assert_allclose(np.mean([f.shift_px for f in frames], axis=0), 0.0, atol=1e-9)
        assert np.ptp([f.time_s for f in frames]) == pytest.approx(0.01 * (1 - 1 / len(frames)))


def test_motion_between_two_poses() -> None:
    r0 = r_from_euler(0.1, -0.2, 0.7) @ FORWARD
    turned = r_from_euler(0.0, 0.0, 0.3) @ r0
    motion = CameraMotion.between(((1, 2, 3), r0), ((1.5, 2, 2.9), turned), 0.1)
    np.testing.assert_allclose(motion.velocity_ned_m_s, (5.0, 0.0, -1.0), atol=1e-9)
    np.testing.assert_allclose(motion.rate_ned_rad_s, (0.0, 0.0, 3.0), atol=1e-9)


def test_noise_has_the_variance_asked_for() -> None:
    effects = replace(ImageEffects.none(), read_noise_grey=2.0, shot_noise_grey=0.05)
    for grey in (40, 160):
        image = sensed(np.full((240, 320), grey, np.uint8), effects, np.random.default_rng(3)).astype(float)
        expected = np.sqrt(4.0 + 0.05 * grey + 1.0 / 12.0)  # and that of rounding
        assert image.std() == pytest.approx(expected, rel=0.03)
        assert image.mean() == pytest.approx(grey, abs=0.05)


def test_brightness_and_vignetting() -> None:
    ideal = ImageEffects.none()
    grey = np.full((120, 160), 100, np.uint8)
    rng = np.random.default_rng(0)
    np.testing.assert_array_equal(sensed(grey, ideal, rng), grey)
    bright = replace(ideal, brightness=3.0, vignetting=0.5)
    image = sensed(grey, bright, rng)
    assert image[60, 80] == 255
    assert image[0, 0] == image[-1, -1] == 150


@pytest.mark.parametrize(
    "wrong", [{"brightness": 0.0}, {"vignetting": 1.5}, {"read_noise_grey": -1.0}, {"exposure_s": 1.0}]
)
def test_effects_out_of_range_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        ImageEffects(**wrong)


class Counted:
    """A renderer that notes what it is asked for."""

    def __init__(self) -> None:
        self.asked: list[int | None] = []

    def render(
        self,
        camera: CameraModel,
        position_ned_m: ArrayLike,
        r_ned_from_camera: ArrayLike,
        *,
        supersample: int | None = None,
        shift_px: tuple[float, float] = (0.0, 0.0),
    ) -> NDArray[np.uint8]:
        self.asked.append(supersample)
        return np.full((camera.height_px, camera.width_px), 90, np.uint8)


def flight(seed: int, effects: ImageEffects, renderer: Counted | None = None) -> list[NDArray[np.uint8]]:
    camera: Renderer = SensorCamera(
        renderer if renderer is not None else Counted(), effects=effects, seed=seed, frame_period_s=0.1
    )
    half = 0.5 * np.array([0.0, 0.05, 0.15])  # half yaw angles
    poses = [Pose(k, 0.0, 0.0, -1.0, (np.cos(a), 0.0, 0.0, np.sin(a))) for k, a in enumerate(half)]
    return [render_at(camera, CAMERA, pose) for pose in poses]


def test_the_same_seed_gives_the_same_frames_and_each_its_own_noise() -> None:
    first, again, other = (flight(seed, ImageEffects()) for seed in (4, 4, 5))
    for a, b in zip(first, again, strict=True):
        np.testing.assert_array_equal(a, b)
    assert (first[0] != first[1]).mean() > 0.3
    assert (first[0] != other[0]).mean() > 0.3


def test_a_frame_is_rendered_once_unless_it_moves_enough_to_blur() -> None:
    renderer = Counted()
    flight(0, ImageEffects(exposure_s=0.01), renderer)
    # 0.5 rad/s and 1 rad/s for 10 ms at 208 px: 1.04 px and 2.1 px of blur.
    assert renderer.asked == [None, *[1] * 8]
    renderer = Counted()
    flight(0, ImageEffects(exposure_s=0.0), renderer)
    assert renderer.asked == [None] * 3


def test_a_camera_that_is_put_elsewhere_does_not_blur() -> None:
    renderer = Counted()
    camera = SensorCamera(renderer, effects=ImageEffects(exposure_s=0.02), seed=0, frame_period_s=0.1)
    camera.render(CAMERA, (0, 0, -1), FORWARD)
    camera.render(CAMERA, (50, 0, -1), FORWARD)
    assert renderer.asked == [None, None]


def test_a_sensor_in_a_world_sees_it(ideal: PandaCamera) -> None:
    effects = replace(ImageEffects.none(), brightness=0.5, read_noise_grey=1.0)
    with SensorCamera.in_world(WORLD, effects=effects, seed=1, frame_period_s=0.1) as camera:
        image = camera.render(CAMERA, EYE, FORWARD).astype(float)
    assert np.abs(image - 0.5 * ideal.render(CAMERA, EYE, FORWARD)).mean() < 1.2


@pytest.mark.parametrize("wrong", [{"seed": -1}, {"frame_period_s": 0.0}])
def test_a_sensor_refuses_what_makes_no_sense(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        SensorCamera(Counted(), **{"effects": ImageEffects(), "seed": 0, "frame_period_s": 0.1, **wrong})


def test_automatic_exposure_brings_a_dark_picture_to_its_mean_and_spares_bright_parts() -> None:
    effects = ImageEffects(metered_grey=130.0, vignetting=0.0, read_noise_grey=0.0, shot_noise_grey=0.0)
    rng = np.random.default_rng(0)
    dark = np.full((60, 80), 50, np.uint8)
    assert sensed(dark, effects, rng).mean() == pytest.approx(130.0, abs=1.0)
    with_window = dark.copy()
    with_window[:, :16] = 200  # a fifth of the picture: metering the mean alone would burn it out
    assert sensed(with_window, effects, rng).max() == pytest.approx(240, abs=1)
    nearly_black = np.full((60, 80), 4, np.uint8)
    assert sensed(nearly_black, effects, rng).max() == 16  # four times is all the gain there is
    black = np.zeros((60, 80), np.uint8)
    assert sensed(black, effects, rng).max() == 0

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from detector.camera_model import CameraError, CameraModel

BARREL = (-0.2834, 0.0740, 0.00019, 1.8e-5)  # a common machine-vision lens of 90 degrees
MODELS = {
    "hfov": CameraModel.from_hfov(640, 480, 80.0),
    "barrel": CameraModel(752, 480, 458.0, 457.0, 367.0, 248.0, BARREL),
    "five": CameraModel(640, 480, 500.0, 505.0, 310.0, 250.0, (0.12, -0.3, 0.001, -0.002, 0.15)),
    "rational": CameraModel(
        1280, 720, 640.0, 640.0, 630.0, 370.0, (0.5, 0.05, 1e-4, 2e-4, 0.002, 0.85, 0.2, 0.01)
    ),
}


@pytest.mark.parametrize("name", MODELS)
@settings(max_examples=60, deadline=None)
@given(u=st.floats(0, 1), v=st.floats(0, 1))
def test_pixel_to_ray_to_pixel_is_the_identity(name: str, u: float, v: float) -> None:
    camera = MODELS[name]
    pixel = np.array([[u * (camera.width_px - 1), v * (camera.height_px - 1)]])
    ray = camera.pixel_to_ray(pixel)
    assert np.linalg.norm(ray) == pytest.approx(1.0, abs=1e-12)
    assert ray[0, 2] > 0
    np.testing.assert_allclose(camera.ray_to_pixel(7.5 * ray), pixel, atol=1e-6)


@pytest.mark.parametrize("name", MODELS)
def test_projection_is_that_of_opencv(name: str) -> None:
    camera = MODELS[name]
    grid = np.stack(np.meshgrid(np.linspace(-0.5, 0.5, 7), np.linspace(-0.4, 0.4, 5)), axis=-1).reshape(-1, 2)
    rays = np.column_stack((grid, np.ones(len(grid))))
    expected, _ = cv2.projectPoints(
        rays, np.zeros(3), np.zeros(3), camera.matrix, np.array(camera.distortion or (0.0,) * 4)
    )
    np.testing.assert_allclose(camera.ray_to_pixel(rays), expected.reshape(-1, 2), atol=1e-9)


def test_axes_are_right_down_forward() -> None:
    camera = MODELS["hfov"]
    np.testing.assert_allclose(camera.pixel_to_ray([[319.5, 239.5]]), [[0, 0, 1]], atol=1e-12)
    right_down = camera.pixel_to_ray([[400.0, 300.0]])[0]
    assert right_down[0] > 0
    assert right_down[1] > 0


@pytest.mark.parametrize("ray", [[0, 0, -1], [1, 0, 0], [0.3, 0.1, -0.2], [0, 0, 0]])
@pytest.mark.parametrize("name", MODELS)
def test_nothing_behind_the_camera_is_in_the_image(name: str, ray: list[float]) -> None:
    assert np.isnan(MODELS[name].ray_to_pixel([ray])).all()


def test_rays_beyond_the_fold_are_not_thrown_into_the_image() -> None:
    camera = CameraModel(640, 480, 900.0, 900.0, 320.0, 240.0, (-0.4, 0.0, 0.0, 0.0))
    fold = math.sqrt(1 / 1.2)  # d/dr (r - 0.4 r^3) = 0
    assert np.isfinite(camera.ray_to_pixel([[0.99 * fold, 0, 1]])).all()
    assert np.isnan(camera.ray_to_pixel([[1.01 * fold, 0, 1]])).all()


def test_a_distortion_that_folds_inside_the_image_is_refused() -> None:
    with pytest.raises(CameraError, match="folds over"):
        CameraModel(640, 480, 400.0, 400.0, 320.0, 240.0, (-0.4, 0.0, 0.0, 0.0))


def test_field_of_view() -> None:
    camera = CameraModel.from_hfov(640, 480, 90.0)
    assert camera.fx_px == pytest.approx(320.0)
    assert camera.hfov_rad == pytest.approx(math.radians(90.0))
    assert camera.vfov_rad == pytest.approx(2 * math.atan(240 / 320))
    assert not camera.is_distorted
    assert MODELS["barrel"].is_distorted
    # A barrel lens sees more than its focal length says.
    assert MODELS["barrel"].hfov_rad > 2 * math.atan(376 / 458)


@pytest.mark.parametrize("name", MODELS)
def test_scaling_keeps_the_rays(name: str) -> None:
    camera = MODELS[name]
    half = camera.scaled_to(camera.width_px // 2, camera.height_px // 2)
    pixels = np.array([[10.0, 20.0], [200.0, 100.0], [300.0, 230.0]])
    # The middle of pixel (x, y) of the half image is (2 x + 0.5, 2 y + 0.5) of the full one.
    np.testing.assert_allclose(half.pixel_to_ray(pixels), camera.pixel_to_ray(2 * pixels + 0.5), atol=1e-9)


def test_shapes_are_checked() -> None:
    with pytest.raises(ValueError, match=r"expected \(N, 2\), got \(2,\)"):
        MODELS["hfov"].pixel_to_ray([1.0, 2.0])
    assert MODELS["barrel"].pixel_to_ray(np.empty((0, 2))).shape == (0, 3)
    assert MODELS["barrel"].ray_to_pixel(np.empty((0, 3))).shape == (0, 2)


def test_files(tmp_path: Path) -> None:
    path = tmp_path / "camera.toml"
    path.write_text("width_px = 640\nheight_px = 480\nhfov_deg = 80\n")
    assert CameraModel.from_file(path) == MODELS["hfov"]
    path.write_text(
        "width_px = 752\nheight_px = 480\nfx_px = 458\nfy_px = 457.0\ncx_px = 367.0\ncy_px = 248.0\n"
        "distortion = [-0.2834, 0.0740, 0.00019, 1.8e-5]\n"
    )
    assert CameraModel.from_file(str(path)) == MODELS["barrel"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("width_px = 640\nheight_px = 480\nhfov = 80\n", "hfov: unknown key, allowed width_px"),
        ("width_px = 640\nheight_px = 480\n", "fx_px: missing"),
        (
            "width_px = 640.5\nheight_px = 480\nhfov_deg = 80\n",
            "width_px: found 640.5, allowed a whole number",
        ),
        ("width_px = 'a'\nheight_px = 480\nhfov_deg = 80\n", "width_px: found 'a', allowed a finite number"),
        ("width_px = 640\nheight_px = 480\nhfov_deg = true\n", "hfov_deg: found True"),
        ("width_px = 640\nheight_px = 480\nhfov_deg = nan\n", "hfov_deg: found nan"),
        ("width_px = 640\nheight_px = 480\nhfov_deg = 179\n", "hfov_deg: found 179.0, allowed 1 to 170"),
        ("width_px = 640\nheight_px = 480\nhfov_deg = 80\nfx_px = 3\n", "fx_px: found beside hfov_deg"),
        ("width_px = 1\nheight_px = 1\nhfov_deg = 80\n", "width_px: found 1, allowed 16"),
        (
            "width_px = 640\nheight_px = 480\nfx_px = 5e9\nfy_px = 1\ncx_px = 1\ncy_px = 1\n",
            "fx_px: found 5000000000.0",
        ),
        (
            "width_px = 640\nheight_px = 480\nfx_px = 500\nfy_px = 500\ncx_px = -1\ncy_px = 1\n",
            "cx_px: found -1.0",
        ),
        (
            "width_px = 640\nheight_px = 480\nfx_px = 500\nfy_px = 500\ncx_px = 320\ncy_px = 240\ndistortion = [1, 2]\n",
            "distortion: found 2 coefficients",
        ),
        (
            "width_px = 640\nheight_px = 480\nfx_px = 500\nfy_px = 500\ncx_px = 320\ncy_px = 240\ndistortion = 'x'\n",
            "distortion: found 'x', allowed a list",
        ),
        ("width_px = \n", "not valid TOML"),
    ],
)
def test_a_bad_file_is_refused_with_file_key_found_and_allowed(
    tmp_path: Path, text: str, message: str
) -> None:
    path = tmp_path / "camera.toml"
    path.write_text(text)
    with pytest.raises(CameraError) as caught:
        CameraModel.from_file(path)
    assert str(caught.value).startswith(str(path))
    assert message in str(caught.value)


def test_a_missing_or_binary_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CameraError, match="cannot be read"):
        CameraModel.from_file(tmp_path / "none.toml")
    path = tmp_path / "camera.toml"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(CameraError, match="UTF-8"):
        CameraModel.from_file(path)

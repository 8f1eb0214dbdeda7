"""What exposure, gain and a rolling shutter do to what a detector finds: pictures and figures for docs/cameras/README.md.

    .venv/bin/python -m benchmarks.camera_advice docs/images

Needs the extra ``sim``. The camera stands in the built-in corridor and turns at 45 deg/s while it flies at 1 m/s.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.sim.flight_worlds import find_world, place_in
from companion.sim.image_effects import CameraMotion, ImageEffects
from companion.sim.panda_camera import PandaCamera
from companion.sim.sensor_camera import photograph
from detector.camera_model import CameraModel

CAMERA = CameraModel.from_hfov(640, 480, 80.0)
SPEED_M_S = 1.0
TURN_DEG_S = 45.0
PERIOD_S = 1 / 30
READOUT_S = (0.0, 0.010, 0.030)
BANDS = 24
SETTINGS = (
    ("1 ms, dim: gain x8", 0.001, 8.0),
    ("4 ms, dim: gain x2", 0.004, 2.0),
    ("8 ms", 0.008, 1.0),
    ("16 ms", 0.016, 1.0),
    ("33 ms", 0.033, 1.0),
)


def pose(time_s: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Where the camera is at a time: forward along its start heading, turning to the right."""
    place = place_in(WORLD)
    heading = place.start_heading_rad
    north_m, east_m = place.start_ned_m[:2]
    yaw = heading + math.radians(TURN_DEG_S) * (time_s - PERIOD_S / 2)
    travelled = 0.8 + SPEED_M_S * time_s
    position = np.array(
        [north_m + travelled * math.cos(heading), east_m + travelled * math.sin(heading), -1.2]
    )
    right, forward = (-math.sin(yaw), math.cos(yaw), 0.0), (math.cos(yaw), math.sin(yaw), 0.0)
    return position, np.column_stack((right, (0.0, 0.0, 1.0), forward))


def picture(time_s: float, exposure_s: float, gain: float, seed: int) -> NDArray[np.uint8]:
    position, rotation = pose(time_s)
    motion = CameraMotion.between(pose(time_s - 0.01), pose(time_s + 0.01), 0.02)
    standard = ImageEffects()
    effects = ImageEffects(
        exposure_s=exposure_s,
        read_noise_grey=standard.read_noise_grey
        * gain,  # gain makes the noise of the sensor larger with the picture
        shot_noise_grey=standard.shot_noise_grey * gain,
    )
    return photograph(RENDERER, CAMERA, position, rotation, motion, effects, np.random.default_rng(seed))


def rolling(time_s: float, readout_s: float) -> NDArray[np.uint8]:
    """A picture whose rows are exposed one after another, the middle one at ``time_s``."""
    rows = []
    for band in range(BANDS):
        position, rotation = pose(time_s + readout_s * ((band + 0.5) / BANDS - 0.5))
        whole = RENDERER.render(CAMERA, position, rotation)
        rows.append(whole[band * 480 // BANDS : (band + 1) * 480 // BANDS])
    return np.vstack(rows)


def found(first: NDArray[np.uint8], second: NDArray[np.uint8]) -> tuple[int, int]:
    """SIFT key points of the first picture, and how many are tracked to the second one and back to half a pixel."""
    points = cv2.SIFT_create().detect(first, None)
    corners = np.array([point.pt for point in points], np.float32).reshape(-1, 1, 2)
    there, ok, _ = cv2.calcOpticalFlowPyrLK(first, second, corners, None)
    back, ok_back, _ = cv2.calcOpticalFlowPyrLK(second, first, there, None)
    good = (ok & ok_back).ravel().astype(bool) & (np.linalg.norm(back - corners, axis=2).ravel() < 0.5)
    return len(points), int(good.sum())


def skew_px(flat: NDArray[np.uint8], bent: NDArray[np.uint8]) -> float:
    """How much further right the top of one picture is than the bottom, against the other one, px."""
    shifts = []
    for rows in (slice(0, 96), slice(384, 480)):
        (x, _), _ = cv2.phaseCorrelate(flat[rows].astype(np.float64), bent[rows].astype(np.float64))
        shifts.append(x)
    return (shifts[0] - shifts[1]) * 480 / 384


def labelled(image: NDArray[np.uint8], text: str) -> NDArray[np.uint8]:
    crop = image[140:340, 220:480].copy()
    cv2.rectangle(crop, (0, 0), (crop.shape[1], 18), 0, -1)
    cv2.putText(crop, text, (5, 13), cv2.FONT_HERSHEY_SIMPLEX, 0.42, 255, 1, cv2.LINE_AA)
    return crop


def main(folder: Path) -> None:
    print(
        f"turning at {TURN_DEG_S:g} deg/s, {SPEED_M_S:g} m/s, {CAMERA.width_px} x {CAMERA.height_px}, 80 deg"
    )
    print("| exposure | blur | SIFT key points | tracked to the next frame |\n|---|---|---|---|")
    crops = []
    for name, exposure_s, gain in SETTINGS:
        first, second = picture(0.0, exposure_s, gain, 1), picture(PERIOD_S, exposure_s, gain, 2)
        blur_px = math.radians(TURN_DEG_S) * exposure_s * CAMERA.fx_px
        points, tracked = found(first, second)
        print(f"| {name} | {blur_px:.1f} px | {points} | {tracked} |")
        crops.append(labelled(first, f"{name}: {blur_px:.1f} px"))
    cv2.imwrite(str(folder / "camera-exposure.webp"), np.hstack(crops), [cv2.IMWRITE_WEBP_QUALITY, 80])
    print("| readout | skew, calculated | skew, measured |\n|---|---|---|")
    pictures = [rolling(0.5, readout_s) for readout_s in READOUT_S]
    for readout_s, bent in zip(READOUT_S, pictures, strict=True):
        expected_px = math.radians(TURN_DEG_S) * readout_s * CAMERA.fx_px
        print(f"| {readout_s * 1e3:g} ms | {expected_px:.1f} px | {skew_px(pictures[0], bent):.1f} px |")
    marked = [
        labelled(bent, "global shutter" if not readout_s else f"rolling, {readout_s * 1e3:g} ms")
        for readout_s, bent in zip(READOUT_S, pictures, strict=True)
    ]
    cv2.imwrite(str(folder / "camera-shutter.webp"), np.hstack(marked), [cv2.IMWRITE_WEBP_QUALITY, 80])


WORLD = find_world("corridor")
RENDERER = PandaCamera(WORLD)

if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "docs/images"))
    RENDERER.close()

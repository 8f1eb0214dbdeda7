"""The demo's annotated videos: what the camera saw, what was decided, what was sent."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.errors import CompanionError
from companion.guidance.coordinates import heading_rad, r_body_from_camera, r_ned_from_body
from companion.guidance.observation import Pose
from companion.sim.annotated_video import (
    BLUE,
    FRAME_NS,
    GREEN,
    GREY,
    ORANGE,
    WHITE,
    Image,
    Story,
    annotated,
    write_text,
    write_video,
)
from companion.sim.scene import Rectangle, Scene
from detector.camera_model import CameraModel


class FootageVideo:
    """The recorded frames with the answers to each."""

    def __init__(self, folder: Path, path: Path) -> None:
        self._images = sorted((folder / "images").iterdir())
        self._path = path
        self.story = Story()
        self.started_ns = 0

    def write(self) -> str:
        """Write the video and return its path."""
        return write_video(self._path, self._pictures())

    def _pictures(self) -> Iterable[Image]:
        for number, file in enumerate(self._images):
            grey = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
            if grey is None:
                raise CompanionError(f"cannot read {file}")
            time_ns = self.started_ns + number * FRAME_NS + 1_000_000
            yield annotated(
                np.asarray(grey, dtype=np.uint8), self.story, time_ns, f"real footage, frame {number}"
            )


class RoomVideo:
    """The simulated camera beside a map of the room; rendered again from the poses flown."""

    def __init__(
        self, scene: Scene, camera: CameraModel, goal_ned_m: tuple[float, float, float], path: Path
    ) -> None:
        self._scene = scene
        self._camera = camera
        self._goal = goal_ned_m
        self._path = path
        self._poses: list[Pose] = []
        self.story = Story()

    def on_pose(self, pose: Pose) -> None:
        """Take the vehicle's true pose; one is kept for each frame of the video."""
        if not self._poses or pose.time_ns - self._poses[-1].time_ns >= FRAME_NS:
            self._poses.append(pose)

    def write(self) -> str:
        """Write the video and return its path."""
        return write_video(self._path, self._pictures())

    def _pictures(self) -> Iterable[Image]:
        for number, pose in enumerate(self._poses):
            grey = self._scene.render(
                self._camera,
                (pose.north_m, pose.east_m, pose.down_m),
                r_ned_from_body(pose.q_ned_from_body) @ r_body_from_camera(0.0, 0.0, 0.0),
            )
            view = annotated(grey, self.story, pose.time_ns, "closed loop, ray-cast room")
            yield np.hstack([view, self._map(view.shape[0], number)])

    def _map(self, height_px: int, number: int) -> Image:
        """Draw the room from above: north is up."""
        corners = np.concatenate([_corners_m(rectangle)[:, :2] for rectangle in self._scene.rectangles])
        low, high = corners.min(axis=0), corners.max(axis=0)
        scale = (height_px - 60) / (high[0] - low[0])
        width_px = round(((high[1] - low[1]) * scale + 40) / 2) * 2
        canvas = np.empty((height_px, width_px, 3), dtype=np.uint8)
        canvas[:] = (32, 32, 32)

        def px(north_m: float, east_m: float) -> tuple[int, int]:
            return round(20 + (east_m - low[1]) * scale), round(height_px - 30 - (north_m - low[0]) * scale)

        for rectangle in self._scene.rectangles:
            points = _corners_m(rectangle)
            if np.ptp(points[:, 2]) > 0.5:  # walls; floor and ceiling are flat
                flat = points[:, :2]
                ends = flat[np.argsort(flat @ (np.ptp(flat, axis=0) + 1e-9))][[0, -1]]
                cv2.line(canvas, px(*ends[0]), px(*ends[1]), WHITE, 3, cv2.LINE_AA)
        flown = np.array([px(p.north_m, p.east_m) for p in self._poses[: number + 1]], dtype=np.int32)
        cv2.polylines(canvas, [flown.reshape(-1, 1, 2)], False, GREEN, 2, cv2.LINE_AA)
        cv2.drawMarker(canvas, px(self._goal[0], self._goal[1]), ORANGE, cv2.MARKER_STAR, 18, 2)
        pose = self._poses[number]
        _, _, setpoint = self.story.at(pose.time_ns)
        if setpoint is not None and setpoint.get("sent"):
            cv2.circle(canvas, px(setpoint["sent"][0], setpoint["sent"][1]), 6, BLUE, 2, cv2.LINE_AA)
        self._draw_vehicle(canvas, px(pose.north_m, pose.east_m), pose)
        write_text(canvas, "* goal   o setpoint sent", (14, height_px - 8), 0.42, GREY)
        return canvas

    @staticmethod
    def _draw_vehicle(canvas: Image, at_px: tuple[int, int], pose: Pose) -> None:
        heading = heading_rad(pose.q_ned_from_body)
        tip = (round(at_px[0] + 18 * math.sin(heading)), round(at_px[1] - 18 * math.cos(heading)))
        cv2.arrowedLine(canvas, at_px, tip, GREEN, 3, cv2.LINE_AA, tipLength=0.5)
        cv2.circle(canvas, at_px, 7, GREEN, -1, cv2.LINE_AA)


def _corners_m(rectangle: Rectangle) -> NDArray[np.float64]:
    corner = np.asarray(rectangle.corner_m, dtype=np.float64)
    along, across = np.asarray(rectangle.along_m), np.asarray(rectangle.across_m)
    return np.stack([corner, corner + along, corner + along + across, corner + across])

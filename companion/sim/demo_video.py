"""The demo's annotated videos: what the camera saw, what was decided, what was sent."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.errors import CompanionError
from companion.guidance.coordinates import heading_rad, r_body_from_camera, r_ned_from_body
from companion.guidance.observation import Pose
from companion.sim.companion_process import Event
from companion.sim.scene import Rectangle, Scene
from detector.camera_model import CameraModel

Image = NDArray[np.uint8]
Colour = tuple[int, int, int]

_WIDTH_PX = 640
_BAR_PX = 58
_FPS_HZ = 10.0
_FRAME_NS = round(1e9 / _FPS_HZ)
_OLD_NS = 1_500_000_000
"""An answer older than this is not drawn at all."""

_WHITE: Colour = (240, 240, 240)
_GREY: Colour = (150, 150, 150)
_GREEN: Colour = (90, 220, 90)
_ORANGE: Colour = (60, 165, 255)
_RED: Colour = (80, 80, 255)
_BLUE: Colour = (255, 170, 60)
_STATE_COLOURS: dict[str, Colour] = {
    "FOLLOW": _GREEN,
    "STEER": _BLUE,
    "PROBE": _BLUE,
    "ALIGN": _ORANGE,
    "TURN": _ORANGE,
    "HOLD": _RED,
}


@dataclass
class Story:
    """What the service said, by our monotonic time."""

    detections: list[tuple[int, Event]] = field(default_factory=list)
    states: list[tuple[int, Event]] = field(default_factory=list)
    setpoints: list[tuple[int, Event]] = field(default_factory=list)

    def take(self, event: Event, now_ns: int) -> None:
        """Take one event of the service's log, which arrived at ``now_ns``."""
        match event.get("event"):
            case "detection":
                self.detections.append((now_ns - event["age_ms"] * 1_000_000, event))
            case "state":
                self.states.append((event["time_ns"], event))
            case "status" if "setpoint" in event:
                self.setpoints.append((now_ns, event["setpoint"]))

    def at(self, time_ns: int) -> tuple[tuple[int, Event] | None, Event | None, Event | None]:
        """Return the newest detection (with its time), state and setpoint at a time."""
        state, setpoint = _newest(self.states, time_ns), _newest(self.setpoints, time_ns)
        return (
            _newest(self.detections, time_ns),
            None if state is None else state[1],
            None if setpoint is None else setpoint[1],
        )


def _newest(items: list[tuple[int, Event]], time_ns: int) -> tuple[int, Event] | None:
    position = bisect_right(items, time_ns, key=lambda item: item[0])
    return items[position - 1] if position else None


def write_video(path: Path, pictures: Iterable[Image]) -> str:
    """Write pictures of one size as MP4 at 10 frames/s and return the path.

    Raises
    ------
    companion.errors.CompanionError
        When the file cannot be written.
    """
    writer: Any = None
    try:
        for picture in pictures:
            if writer is None:
                height_px, width_px = picture.shape[:2]
                fourcc = cv2.VideoWriter.fourcc(*"mp4v")
                writer = cv2.VideoWriter(str(path), fourcc, _FPS_HZ, (width_px, height_px))
                if not writer.isOpened():
                    raise CompanionError(f"cannot write the video {path}")
            writer.write(picture)
    finally:
        if writer is not None:
            writer.release()
    if writer is None:
        raise CompanionError(f"no pictures for the video {path}")
    return str(path)


def annotated(grey: Image, story: Story, time_ns: int, note: str) -> Image:
    """Return the camera's picture with the answer of that moment, the state and the setpoints."""
    scale = _WIDTH_PX / grey.shape[1]
    height_px = round(grey.shape[0] * scale / 2) * 2
    picture = np.empty((height_px + 2 * _BAR_PX, _WIDTH_PX, 3), dtype=np.uint8)
    picture[:] = (32, 32, 32)
    view = picture[_BAR_PX : _BAR_PX + height_px]
    view[:] = cv2.cvtColor(cv2.resize(grey, (_WIDTH_PX, height_px)), cv2.COLOR_GRAY2BGR)
    detection, state, setpoint = story.at(time_ns)
    if detection is not None and time_ns - detection[0] <= _OLD_NS:
        _draw_answer(view, detection[1], time_ns - detection[0], scale)
    name = "DISENGAGED" if state is None else str(state["state"])
    reason = "" if state is None else str(state["reason"])
    _text(picture, name, (12, 26), 0.75, _STATE_COLOURS.get(name, _GREY), 2)
    _text(picture, reason, (180, 25), 0.5, _WHITE)
    _text(picture, note, (12, 48), 0.42, _GREY)
    if setpoint is not None:
        below = _BAR_PX + height_px
        _text(picture, f"planner  {_place(setpoint['planned'])}", (12, below + 22), 0.48, _GREY)
        sent = setpoint.get("sent")
        words = f"{setpoint['action']}  {_place(sent)}" if sent else str(setpoint["action"])
        yaw = setpoint.get("yaw_deg")
        words += "" if yaw is None else f"  yaw {yaw:.0f} deg"
        _text(picture, words, (12, below + 45), 0.48, _WHITE)
    return picture


def _place(ned: list[float]) -> str:
    return f"x {ned[0]:+.2f}  y {ned[1]:+.2f}  z {ned[2]:+.2f} m"


def _draw_answer(view: Image, event: Event, age_ns: int, scale: float) -> None:
    # Full strength only on the frame that the answer is about: an old answer must not look new.
    fresh = age_ns < 0.6 * _FRAME_NS
    kind = event["kind"]
    if kind == "none":
        _text(view, f"no detection: {event.get('reason', '')}", (12, 24), 0.5, _RED if fresh else _GREY)
        return
    if kind == "single_plane":
        distance_m = event.get("distance_m")
        words = "SINGLE PLANE" + ("" if distance_m is None else f", {distance_m:.1f} m")
        cv2.rectangle(view, (4, 4), (view.shape[1] - 5, view.shape[0] - 5), _ORANGE, 3 if fresh else 1)
        _text(view, words, (12, 28), 0.6, _ORANGE if fresh else _GREY, 2 if fresh else 1)
        return
    x, y = round(event["x_px"] * scale), round(event["y_px"] * scale)
    colour = _GREEN if kind == "vanishing_point" else _BLUE
    cv2.circle(view, (x, y), 16, colour, 3 if fresh else 1, cv2.LINE_AA)
    if fresh:
        cv2.drawMarker(view, (x, y), colour, cv2.MARKER_CROSS, 44, 1, cv2.LINE_AA)
    distance_m = event.get("distance_m")
    words = kind.replace("_", " ") + ("" if distance_m is None else f", {distance_m:.1f} m")
    _text(view, words, (min(x + 22, view.shape[1] - 190), max(20, y - 12)), 0.45, colour)


def _text(
    image: Image, words: str, place: tuple[int, int], size: float, colour: Colour, thickness: int = 1
) -> None:
    # The outline is the same text, moved: a thicker one would be wider since OpenCV 5.
    x, y = place
    for dx, dy in ((-1, 0), (1, 0), (0, -1), (0, 1)):
        at = (x + dx, y + dy)
        cv2.putText(image, words, at, cv2.FONT_HERSHEY_SIMPLEX, size, (0, 0, 0), thickness, cv2.LINE_AA)
    cv2.putText(image, words, place, cv2.FONT_HERSHEY_SIMPLEX, size, colour, thickness, cv2.LINE_AA)


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
            time_ns = self.started_ns + number * _FRAME_NS + 1_000_000
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
        if not self._poses or pose.time_ns - self._poses[-1].time_ns >= _FRAME_NS:
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
                cv2.line(canvas, px(*ends[0]), px(*ends[1]), _WHITE, 3, cv2.LINE_AA)
        flown = np.array([px(p.north_m, p.east_m) for p in self._poses[: number + 1]], dtype=np.int32)
        cv2.polylines(canvas, [flown.reshape(-1, 1, 2)], False, _GREEN, 2, cv2.LINE_AA)
        cv2.drawMarker(canvas, px(self._goal[0], self._goal[1]), _ORANGE, cv2.MARKER_STAR, 18, 2)
        pose = self._poses[number]
        _, _, setpoint = self.story.at(pose.time_ns)
        if setpoint is not None and setpoint.get("sent"):
            cv2.circle(canvas, px(setpoint["sent"][0], setpoint["sent"][1]), 6, _BLUE, 2, cv2.LINE_AA)
        self._draw_vehicle(canvas, px(pose.north_m, pose.east_m), pose)
        _text(canvas, "* goal   o setpoint sent", (14, height_px - 8), 0.42, _GREY)
        return canvas

    @staticmethod
    def _draw_vehicle(canvas: Image, at_px: tuple[int, int], pose: Pose) -> None:
        heading = heading_rad(pose.q_ned_from_body)
        tip = (round(at_px[0] + 18 * math.sin(heading)), round(at_px[1] - 18 * math.cos(heading)))
        cv2.arrowedLine(canvas, at_px, tip, _GREEN, 3, cv2.LINE_AA, tipLength=0.5)
        cv2.circle(canvas, at_px, 7, _GREEN, -1, cv2.LINE_AA)


def _corners_m(rectangle: Rectangle) -> NDArray[np.float64]:
    corner = np.asarray(rectangle.corner_m, dtype=np.float64)
    along, across = np.asarray(rectangle.along_m), np.asarray(rectangle.across_m)
    return np.stack([corner, corner + along, corner + along + across, corner + across])

"""The video of a flight: what the camera saw beside the plan of the world, and a small animated picture of it.

Both are made after the flight from its record: the camera's view is rendered again from the poses flown.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.errors import CompanionError
from companion.guidance.observation import Pose
from companion.sim.annotated_video import (
    BLUE,
    FPS_HZ,
    GREEN,
    ORANGE,
    RED,
    WHITE,
    Image,
    Story,
    annotated,
    write_text,
    write_video,
)
from companion.sim.camera_feed import render_at
from companion.sim.companion_process import Event
from companion.sim.flight_record import FlightRecord
from companion.sim.panda_camera import PandaCamera
from companion.sim.world.clearance import VEHICLE_RADIUS_M
from companion.sim.world.model import World
from companion.sim.world.top_view import TopView, top_view
from detector.camera_model import CameraModel

_PLAN_MARGIN_PX: Final = 10
_LEGEND_PX: Final = 56
_WIDEST_PLAN_PX: Final = 900
_LARGEST_PX_PER_M: Final = 80.0
_BACKGROUND: Final = (32, 32, 32)
_VIEW_M: Final = 1.2
_DARK_GREEN: Final = (40, 130, 30)
_DARK_ORANGE: Final = (20, 110, 225)
_DARK_BLUE: Final = (190, 90, 20)
_ANIMATION_FPS_HZ: Final = 8.0
_QUALITIES: Final = (60, 40, 25)
_SHRINK: Final = 0.8
_SMALLEST_PX: Final = 200


def write_flight_video(record: FlightRecord, world: World, camera: CameraModel, path: Path) -> str:
    """Write the video of a flight as MP4, ten pictures a second, and return its path.

    Parameters
    ----------
    record
        The flight.
    world
        Where it was flown.
    camera
        Of the vehicle; it looks along the body's forward axis.
    path
        Of the file.

    Raises
    ------
    companion.errors.CompanionError
        When the flight has no samples, the world cannot be rendered, or the file cannot be written.
    """
    times_s = np.arange(0.0, record.duration_s + 1e-9, 1.0 / FPS_HZ)
    with closing(_FlightPictures(record, world, camera)) as pictures:
        return write_video(path, (pictures.at(float(time_s)) for time_s in times_s))


def write_flight_animation(
    record: FlightRecord,
    world: World,
    camera: CameraModel,
    path: Path,
    *,
    width_px: int = 720,
    pictures: int = 120,
    max_bytes: int = 1_500_000,
) -> int:
    """Write a small animated picture of a flight, which runs for ever, and return its size in bytes.

    Parameters
    ----------
    record, world, camera
        As for :func:`write_flight_video`.
    path
        ``.webp``, ``.gif`` or ``.png``.
    width_px
        At most; narrower where the file would be too large.
    pictures
        At most, evenly spread over the flight, eight a second: a long flight is shown faster than it was.
    max_bytes
        The file is no larger.

    Raises
    ------
    companion.errors.CompanionError
        When it cannot be made that small, or not be written.
    """
    if path.suffix.lower() not in (".webp", ".gif", ".png"):
        raise CompanionError(f"{path}: found {path.suffix or 'no suffix'}; allowed: .webp, .gif, .png")
    count = max(2, min(pictures, round(record.duration_s * _ANIMATION_FPS_HZ)))
    with closing(_FlightPictures(record, world, camera)) as source:
        large = [source.at(float(time_s)) for time_s in np.linspace(0.0, record.duration_s, count)]
    wide_px = min(width_px, large[0].shape[1])
    while wide_px >= _SMALLEST_PX:
        scale = wide_px / large[0].shape[1]
        small = [
            cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) for picture in large
        ]
        for quality in _QUALITIES if path.suffix.lower() == ".webp" else _QUALITIES[:1]:
            data = _encoded(small, path.suffix.lower(), quality)
            if len(data) <= max_bytes:
                try:
                    path.write_bytes(data)
                except OSError as error:
                    raise CompanionError(f"{path}: cannot be written: {error.strerror}") from error
                return len(data)
        wide_px = round(_SHRINK * wide_px)
    raise CompanionError(f"{path}: {count} pictures do not fit into {max_bytes} bytes")


def _encoded(pictures: Sequence[NDArray[np.integer | np.floating]], suffix: str, quality: int) -> bytes:
    animation = cv2.Animation()
    animation.frames = list(pictures)
    animation.durations = [round(1e3 / _ANIMATION_FPS_HZ)] * len(pictures)
    options = [cv2.IMWRITE_WEBP_QUALITY, quality] if suffix == ".webp" else []
    done, data = cv2.imencodeanimation(suffix, animation, options)
    if not done:
        raise CompanionError(f"the pictures cannot be encoded as {suffix}")
    return bytes(np.asarray(data, dtype=np.uint8).tobytes())


def story_of(record: FlightRecord) -> Story:
    """Return what the service said and the autopilot was sent, by ns since the first sample."""
    story = Story()
    for time_s, kind, reason, (x_px, y_px), distance_m in zip(
        record.answer_frame_time_s,
        record.answer_kind,
        record.answer_reason,
        record.answer_px,
        record.answer_distance_m,
        strict=True,
    ):
        answer: Event = {"kind": str(kind), "reason": str(reason), "x_px": float(x_px), "y_px": float(y_px)}
        if math.isfinite(distance_m):
            answer["distance_m"] = float(distance_m)
        story.detections.append((_ns(time_s), answer))
    story.detections.sort(key=lambda item: item[0])
    if len(record.state):
        for time_s, state, reason in zip(record.state_time_s, record.state, record.state_reason, strict=True):
            story.states.append((_ns(time_s), {"state": str(state), "reason": str(reason)}))
    else:
        story.states.append((0, {"state": "NO SERVICE", "reason": "the planner speaks to the autopilot"}))
    for time_s, planned, sent, yaw_rad in zip(
        record.time_s, record.planned_ned_m, record.sent_ned_m, record.sent_yaw_rad, strict=True
    ):
        if np.isfinite(planned).all() and np.isfinite(sent).all():
            same = np.allclose(planned, sent, atol=1e-4)
            event: Event = {
                "planned": planned.tolist(),
                "sent": sent.tolist(),
                "action": "forwarded" if same else "sent",
                "yaw_deg": math.degrees(yaw_rad) if math.isfinite(yaw_rad) else None,
            }
            story.setpoints.append((_ns(time_s), event))
    return story


def _ns(time_s: float) -> int:
    return round(1e9 * float(time_s))


class _FlightPictures:
    """Draws a flight at any of its times."""

    def __init__(self, record: FlightRecord, world: World, camera: CameraModel) -> None:
        if not len(record.time_s):
            raise CompanionError("a flight without samples has no pictures")
        self._record = record
        self._camera = camera
        self._name = world.name
        self._story = story_of(record)
        self._goal_north_m, self._goal_east_m = world.goal.north_m, world.goal.east_m
        self._eye = PandaCamera(world)
        self._plan: TopView | None = None
        self._world = world

    def close(self) -> None:
        """Give the renderer back."""
        self._eye.close()

    def at(self, time_s: float) -> Image:
        """Return the picture of a time: camera view on the left, plan on the right."""
        sample = self._record.sample_at(time_s)
        pose = self._pose(sample)
        grey = render_at(self._eye, self._camera, pose)
        clearance_m = float(self._record.clearance_m[sample])
        note = f"{self._name}   {time_s:5.1f} s   clearance {clearance_m:.2f} m"
        view = annotated(grey, self._story, pose.time_ns, note)
        return np.hstack([view, self._plan_at(sample, view.shape[0])])

    def _pose(self, sample: int) -> Pose:
        north_m, east_m, down_m = (float(value) for value in self._record.position_ned_m[sample])
        w, x, y, z = (float(value) for value in self._record.q_ned_from_body[sample])
        return Pose(_ns(self._record.time_s[sample]), north_m, east_m, down_m, (w, x, y, z))

    def _plan_at(self, sample: int, height_px: int) -> Image:
        if self._plan is None:
            self._plan = _plan_that_fits(self._world, height_px - _LEGEND_PX - 2 * _PLAN_MARGIN_PX)
        plan = TopView(self._plan.image.copy(), self._plan.px_per_m, self._plan.north_m, self._plan.west_m)
        place = self._record.position_ned_m[sample]
        heading_rad = float(self._record.heading_rad[sample])
        half_rad = 0.5 * self._camera.hfov_rad
        for edge_rad in (heading_rad - half_rad, heading_rad + half_rad):
            tip = place[:2] + _VIEW_M * np.array([math.cos(edge_rad), math.sin(edge_rad)])
            plan.draw_path([place[:2], tip], _DARK_GREEN, 1)
        plan.draw_path(self._record.position_ned_m[: sample + 1], _DARK_GREEN)
        for setpoint, radius_m, colour in (
            (self._record.planned_ned_m[sample], 0.22, _DARK_ORANGE),
            (self._record.sent_ned_m[sample], 0.14, _DARK_BLUE),
        ):
            if np.isfinite(setpoint).all():
                plan.draw_disc(setpoint, radius_m, colour, 2)
        plan.draw_disc(place, VEHICLE_RADIUS_M, _DARK_GREEN, 2)
        nose = place[:2] + 1.5 * VEHICLE_RADIUS_M * np.array([math.cos(heading_rad), math.sin(heading_rad)])
        plan.draw_path([place[:2], nose], _DARK_GREEN, 3)
        return _framed(plan.image, height_px)


def _plan_that_fits(world: World, height_px: int) -> TopView:
    """Draw the plan as large as there is room, without the reference path: the flight did not know it."""
    rough = top_view(world, px_per_m=10.0, with_reference_path=False).image
    scale = min(10.0 * height_px / rough.shape[0], 10.0 * _WIDEST_PLAN_PX / rough.shape[1], _LARGEST_PX_PER_M)
    return top_view(world, px_per_m=0.98 * scale, with_reference_path=False)


def _framed(plan: Image, height_px: int) -> Image:
    """Put the plan into the middle of a dark panel of even width, its legend below."""
    width_px = max(plan.shape[1] + 2 * _PLAN_MARGIN_PX, 300)
    panel: Image = np.empty((height_px, width_px + width_px % 2, 3), dtype=np.uint8)
    panel[:] = _BACKGROUND
    top = max(0, (height_px - _LEGEND_PX - plan.shape[0]) // 2)
    left = (panel.shape[1] - plan.shape[1]) // 2
    panel[top : top + plan.shape[0], left : left + plan.shape[1]] = plan
    base = height_px - _LEGEND_PX
    for row, (colour, words) in enumerate(_legend()):
        x, y = 14 + 140 * (row % 2), base + 20 + 22 * (row // 2)
        cv2.circle(panel, (x, y - 4), 5, colour, 2, cv2.LINE_AA)
        write_text(panel, words, (x + 12, y), 0.42, WHITE)
    return panel


def _legend() -> Iterator[tuple[tuple[int, int, int], str]]:
    yield GREEN, "vehicle, its way"
    yield ORANGE, "setpoint planned"
    yield BLUE, "setpoint sent"
    yield RED, "goal"

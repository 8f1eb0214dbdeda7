"""Pictures of what a camera saw with what was decided and sent written upon them, and videos of such pictures."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.errors import CompanionError
from companion.sim.companion_process import Event

Image = NDArray[np.uint8]
Colour = tuple[int, int, int]

_WIDTH_PX = 640
_BAR_PX = 58
FPS_HZ = 10.0
FRAME_NS = round(1e9 / FPS_HZ)
_OLD_NS = 1_500_000_000
"""An answer older than this is not drawn at all."""

WHITE: Colour = (240, 240, 240)
GREY: Colour = (150, 150, 150)
GREEN: Colour = (90, 220, 90)
ORANGE: Colour = (60, 165, 255)
RED: Colour = (80, 80, 255)
BLUE: Colour = (255, 170, 60)
_STATE_COLOURS: dict[str, Colour] = {
    "FOLLOW": GREEN,
    "STEER": BLUE,
    "PROBE": BLUE,
    "ALIGN": ORANGE,
    "TURN": ORANGE,
    "HOLD": RED,
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
                writer = cv2.VideoWriter(str(path), fourcc, FPS_HZ, (width_px, height_px))
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
    write_text(picture, name, (12, 26), 0.75, _STATE_COLOURS.get(name, GREY), 2)
    write_text(picture, reason, (180, 25), 0.5, WHITE)
    write_text(picture, note, (12, 48), 0.42, GREY)
    if setpoint is not None:
        below = _BAR_PX + height_px
        write_text(picture, f"planner  {_place(setpoint['planned'])}", (12, below + 22), 0.48, GREY)
        sent = setpoint.get("sent")
        words = f"{setpoint['action']}  {_place(sent)}" if sent else str(setpoint["action"])
        yaw = setpoint.get("yaw_deg")
        words += "" if yaw is None else f"  yaw {yaw:.0f} deg"
        write_text(picture, words, (12, below + 45), 0.48, WHITE)
    return picture


def _place(ned: list[float]) -> str:
    return f"x {ned[0]:+.2f}  y {ned[1]:+.2f}  z {ned[2]:+.2f} m"


def _draw_answer(view: Image, event: Event, age_ns: int, scale: float) -> None:
    # Full strength only on the frame that the answer is about: an old answer must not look new.
    fresh = age_ns < 0.6 * FRAME_NS
    kind = event["kind"]
    if kind == "none":
        write_text(view, f"no detection: {event.get('reason', '')}", (12, 24), 0.5, RED if fresh else GREY)
        return
    if kind == "single_plane":
        distance_m = event.get("distance_m")
        words = "SINGLE PLANE" + ("" if distance_m is None else f", {distance_m:.1f} m")
        cv2.rectangle(view, (4, 4), (view.shape[1] - 5, view.shape[0] - 5), ORANGE, 3 if fresh else 1)
        write_text(view, words, (12, 28), 0.6, ORANGE if fresh else GREY, 2 if fresh else 1)
        return
    x, y = round(event["x_px"] * scale), round(event["y_px"] * scale)
    colour = GREEN if kind == "vanishing_point" else BLUE
    cv2.circle(view, (x, y), 16, colour, 3 if fresh else 1, cv2.LINE_AA)
    if fresh:
        cv2.drawMarker(view, (x, y), colour, cv2.MARKER_CROSS, 44, 1, cv2.LINE_AA)
    distance_m = event.get("distance_m")
    words = kind.replace("_", " ") + ("" if distance_m is None else f", {distance_m:.1f} m")
    write_text(view, words, (min(x + 22, view.shape[1] - 190), max(20, y - 12)), 0.45, colour)


def write_text(
    image: Image, words: str, place: tuple[int, int], size: float, colour: Colour, thickness: int = 1
) -> None:
    """Write words with a dark outline, from their lower left corner."""
    # The outline is the same text, moved: a thicker one would be wider since OpenCV 5.
    x, y = place
    for dx, dy in ((-1, 0), (1, 0), (0, -1), (0, 1)):
        at = (x + dx, y + dy)
        cv2.putText(image, words, at, cv2.FONT_HERSHEY_SIMPLEX, size, (0, 0, 0), thickness, cv2.LINE_AA)
    cv2.putText(image, words, place, cv2.FONT_HERSHEY_SIMPLEX, size, colour, thickness, cv2.LINE_AA)

"""What the page shows, made from what the flight publishes: snapshots for who comes, increments for who is there (pure)."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from companion.guidance.coordinates import heading_rad
from companion.io.messages import Kind, Message
from companion.web.overlay import Projection, details_view, detection_view

KEPT: Final[Mapping[str, int]] = {"log": 200, "states": 300, "series": 600, "trail": 1500}
"""What is kept of each list, here and for each viewer: the newest."""

_TRAIL_STEP_M: Final = 0.05
_AT_THE_GOAL_M: Final = 0.2
"""Nearer than this a goal has no direction worth drawing."""
_SHOWN_STATUS: Final = (
    "state",
    "reason",
    "not_ready",
    "armed",
    "engaged",
    "autopilot",
    "autopilot_age_ms",
    "mode",
    "frames_hz",
    "reports_hz",
    "setpoints_hz",
    "pose_age_ms",
    "heading_deg",
    "worker",
    "worker_restarts",
    "clock_round_trip_ms",
    "links",
    "report",
)
_DRAWN_SETPOINT: Final = (
    "planner",
    "state",
    "action",
    "dropped",
    "yaw_deg",
    "goal_ned",
    "decided_ned",
    "z_m",
)


@dataclass
class Increment:
    """What is new.

    Attributes
    ----------
    latest
        Values by name, each in place of the one before.
    appended
        Entries by name of a list, oldest first.
    """

    latest: dict[str, Any] = field(default_factory=dict)
    appended: dict[str, list[Any]] = field(default_factory=dict)

    def __bool__(self) -> bool:
        return bool(self.latest or self.appended)


class LiveState:
    """Takes the feed's messages in order; times are the service's monotonic time in s.

    Parameters
    ----------
    projection
        Puts bearings into the picture.
    """

    def __init__(self, projection: Projection) -> None:
        self._projection = projection
        self._latest: dict[str, Any] = {}
        self._lists: dict[str, deque[Any]] = {name: deque(maxlen=kept) for name, kept in KEPT.items()}
        self._new = Increment()
        self._size_px: tuple[int, int] | None = None
        self._pose: Mapping[str, Any] | None = None
        self._links: dict[str, dict[str, Any]] = {}
        self._confidence: float | None = None
        self._attitude: tuple[int, list[float] | None] = (-1, None)

    @property
    def state(self) -> str:
        """The state of the switch S; "" before it is known."""
        switch = self._latest.get("switch")
        return "" if switch is None else str(switch["state"])

    def take(self, message: Message) -> None:
        """Take one message of the feed; kinds that the page does not show are passed over."""
        fields, time_s = message.fields, message.time_ns / 1e9
        match message.kind:
            case Kind.FRAME:
                self._size_px = (int(fields["width_px"]), int(fields["height_px"]))
            case Kind.POSE:
                self._take_pose(fields, time_s)
            case Kind.SETPOINT:
                self._set("setpoint", self._setpoint_view(fields, time_s))
            case Kind.DETECTION:
                self._confidence = fields.get("confidence")
                if (pose := fields.get("pose")) is not None:
                    self._attitude = (int(fields["frame_seq"]), pose["q_ned_from_body"])
                self._set("detection", detection_view(fields, self._projection, self._size_px))
            case Kind.DETAILS:
                seq, attitude = self._attitude
                of_frame = attitude if seq == fields["frame_seq"] else None
                self._set(
                    "details",
                    details_view(fields, message.arrays(), self._projection, of_frame, self._size_px),
                )
            case Kind.STATE:
                entry = {"t": time_s, **_only(fields, ("previous", "state", "reason"))}
                self._set("switch", entry)
                self._append("states", entry)
            case Kind.STATUS:
                self._take_status(fields, time_s)
            case Kind.LINK:
                self._links[str(fields["link"])] = {"url": fields["url"], "state": fields["state"]}
                self._set("links", dict(self._links))
            case Kind.LOG:
                self._append("log", _log_line(fields))
            case Kind.CONFIG:
                self._set("config_seq", message.seq)
            case _:
                return

    def put(self, name: str, value: Any) -> None:
        """Set a value of the server's own, such as how many look."""
        self._set(name, value)

    def snapshot(self) -> Increment:
        """Return all that is known."""
        return Increment(dict(self._latest), {name: list(kept) for name, kept in self._lists.items() if kept})

    def increment(self) -> Increment:
        """Return what is new since the last call."""
        new, self._new = self._new, Increment()
        return new

    def _take_pose(self, fields: Mapping[str, Any], time_s: float) -> None:
        q = fields["q_ned_from_body"]
        north_m, east_m = float(fields["north_m"]), float(fields["east_m"])
        self._pose = fields
        self._set(
            "pose",
            {
                "t": time_s,
                "ned_m": [round(north_m, 3), round(east_m, 3), round(float(fields["down_m"]), 3)],
                "heading_deg": round(math.degrees(heading_rad((q[0], q[1], q[2], q[3]))), 1),
                "speed_m_s": _rounded(fields.get("speed_m_s"), 2),
            },
        )
        trail = self._lists["trail"]
        if not trail or math.hypot(trail[-1][0] - north_m, trail[-1][1] - east_m) >= _TRAIL_STEP_M:
            self._append("trail", [round(north_m, 2), round(east_m, 2)])

    def _setpoint_view(self, fields: Mapping[str, Any], time_s: float) -> dict[str, Any]:
        """Return a setpoint with where the planner's goal lies in the picture (``goal_px``), where it does."""
        view: dict[str, Any] = {"t": time_s, **_only(fields, _DRAWN_SETPOINT)}
        goal, pose = fields.get("goal_ned"), self._pose
        if goal is None or pose is None or self._size_px is None:
            return view
        north_m, east_m = goal[0] - pose["north_m"], goal[1] - pose["east_m"]
        if math.hypot(north_m, east_m) < _AT_THE_GOAL_M:
            return view
        azimuth_rad = math.atan2(east_m, north_m)
        (point,) = self._projection.points_px([azimuth_rad], pose["q_ned_from_body"], self._size_px)
        if point is not None:
            view["goal_px"] = point
        return view

    def _take_status(self, fields: Mapping[str, Any], time_s: float) -> None:
        self._set("status", {"t": time_s, **_only(fields, _SHOWN_STATUS)})
        if (switch := self._latest.get("switch")) is None or switch["state"] != fields.get("state"):
            # The change itself was not seen: the page was started, or it was dropped on the way.
            self._set(
                "switch", {"t": time_s, "state": fields.get("state", ""), "reason": fields.get("reason", "")}
            )
        report = fields.get("report") or {}
        self._append(
            "series",
            {
                "t": round(time_s, 2),
                "frames_hz": fields.get("frames_hz"),
                "reports_hz": fields.get("reports_hz"),
                "setpoints_hz": fields.get("setpoints_hz"),
                "answer_age_ms": report.get("age_ms"),
                "pose_age_ms": fields.get("pose_age_ms"),
                "detector_ms": report.get("detector_ms"),
                "confidence": _rounded(self._confidence, 3),
                "state": fields.get("state"),
            },
        )

    def _set(self, name: str, value: Any) -> None:
        self._latest[name] = value
        self._new.latest[name] = value

    def _append(self, name: str, entry: Any) -> None:
        self._lists[name].append(entry)
        new = self._new.appended.setdefault(name, [])
        new.append(entry)
        if len(new) > KEPT[name]:
            del new[0]


def _only(fields: Mapping[str, Any], names: Iterable[str]) -> dict[str, Any]:
    return {name: fields[name] for name in names if name in fields}


def _rounded(value: Any, digits: int) -> float | None:
    return round(float(value), digits) if isinstance(value, int | float) and math.isfinite(value) else None


def _log_line(fields: Mapping[str, Any]) -> dict[str, Any]:
    """Return a line of the log as the page shows it: its time, level, event, and the rest as text."""
    rest = {key: value for key, value in fields.items() if key not in ("event", "level", "time", "timestamp")}
    text = " ".join(f"{key}={value}" for key, value in rest.items())
    return {
        "time": str(fields.get("time") or fields.get("timestamp") or ""),
        "level": str(fields.get("level", "info")),
        "event": str(fields.get("event", ""))[:200],
        "text": text if len(text) <= 600 else text[:600] + "...",
    }
